#include "optimize/acquisition.h"

#include <algorithm>
#include <cmath>

#include "optimize/proxy_file.h"
#include "stream/base/error.h"
#include "stream/base/file.h"

namespace chiaro::optimize {
namespace {

std::vector<surfels::View> views_of(const AcquisitionInput& input) {
  std::vector<surfels::View> views;
  for (const ObserveInput& p : input.photographs)
    views.push_back({p.camera.lens, p.camera.pose, {0, 0, p.camera.lens.width_px, p.camera.lens.height_px}, {}});
  return views;
}

}  // namespace

std::filesystem::path floor_flash_path(const std::filesystem::path& folder, std::size_t k) { return folder / concat("floor_", k, ".bin"); }
std::filesystem::path gathered_path(const std::filesystem::path& folder, std::size_t k) { return folder / concat("gathered_", k, ".bin"); }
std::filesystem::path proxy_albedo_path(const std::filesystem::path& folder) { return folder / "albedo.bin"; }

std::uint64_t proxy_surfels_within(std::uint64_t bytes, int rays) {
  // hits, sky, floor, smoother, kd-tree, geometry, blocks and tree, one observation, gathered light, means, samples
  const std::uint64_t per_surfel = static_cast<std::uint64_t>(rays) * 4 + 36 + 36 + 4 + 128 + 24 + 33 + 20 + 74 + 24 + 40 + 40;
  return bytes / per_surfel;
}

namespace {

/// What the cloud can see of a floor below this share does not matter.
constexpr float kLeastFloorShare = 0.005f;

void write_floor_of(const Proxy& proxy, const Transport& transport, const Smoother& smoother, const AcquisitionInput& input, const std::filesystem::path& path) {
  std::optional<Floor> floor;
  std::vector<float> hidden;
  if (input.floor_plane) {
    const Vec3d n((*input.floor_plane)[0], (*input.floor_plane)[1], (*input.floor_plane)[2]);
    floor = Floor{n.normalized().cast<float>(), static_cast<float>((*input.floor_plane)[3] / n.norm() - n.normalized().dot(proxy.origin_in_world))};
  } else if (input.try_floor) {
    std::vector<Mat3d> rotations;
    for (const ObserveInput& p : input.photographs) rotations.push_back(p.camera.pose.rotation_camera_from_world);
    floor = find_floor(proxy, rotations);
  }
  if (floor) {
    hidden = hidden_by_floor(proxy, transport, smoother, *floor);
    double mean = 0;
    for (std::size_t i = 0; i < proxy.size(); ++i) mean += static_cast<double>(hidden[i * kSkyTerms]) / (3.14159265 * static_cast<double>(proxy.size()));
    if (mean < static_cast<double>(kLeastFloorShare)) floor.reset();
  }
  write_floor(floor, hidden, path);
}

constexpr const char *kProxyFile = "proxy.bin", *kTransportFile = "transport.bin";

/// What was gathered over the same surfels, turned the same way, by the same rays.
std::optional<Transport> gathered_before(const Proxy& proxy, const AcquisitionOptions& options, const std::filesystem::path& folder, std::span<const std::filesystem::path> others) {
  for (const std::filesystem::path& other : others) {
    if (read_text(other / kProxyFile) != read_text(folder / kProxyFile)) continue;
    Transport transport = read_transport(other / kTransportFile, proxy.size());
    if (transport.rays == options.rays && transport.seed == options.seed) return transport;
  }
  return std::nullopt;
}

}  // namespace

void gather_scene(const stream::Store& store, const AcquisitionInput& input, const AcquisitionOptions& options, const std::filesystem::path& folder,
                  std::span<const std::filesystem::path> others, MemoryBudget& budget, Reporter& report) {
  const std::uint64_t most = std::min<std::uint64_t>(options.max_proxy_surfels, proxy_surfels_within(budget.free_bytes() * 3 / 4, options.rays));
  const auto views = views_of(input);
  Proxy proxy = load_proxy(store, surfels::select_proxy(store, views, std::min(options.proxy_surfels, most), most));
  const BudgetLease lease(budget, proxy.size() * (static_cast<std::uint64_t>(options.rays) * 4 + 300), "light transport");
  const NearestPoints nearest(proxy.position);
  std::vector<float> votes(proxy.size(), 0.0f);
  for (const ObserveInput& photo : input.photographs) {
    const std::vector<float> v = visibility_votes(proxy, photo);
    for (std::size_t i = 0; i < votes.size(); ++i) votes[i] += v[i];
    report.check();
  }
  orient(proxy, votes, nearest);
  const Smoother smoother = make_smoother(proxy, nearest);
  write_proxy(proxy, store.manifest().key, folder / kProxyFile);
  std::optional<Transport> known = gathered_before(proxy, options, folder, others);
  const Transport transport = known ? std::move(*known) : gather(proxy, make_tracer(store, proxy, budget), smoother, {options.rays, options.seed, kSmoothPasses}, report);
  write_transport(transport, folder / kTransportFile);
  write_floor_of(proxy, transport, smoother, input, folder / "floor.bin");
}

Scene load_scene(const stream::Store& store, const std::filesystem::path& folder) {
  Scene scene;
  scene.proxy = read_proxy(store, folder / kProxyFile);
  scene.transport = read_transport(folder / kTransportFile, scene.proxy.size());
  scene.floor = read_floor(folder / "floor.bin", scene.proxy.size(), scene.transport.hidden);
  scene.nearest = std::make_unique<NearestPoints>(scene.proxy.position);
  return scene;
}

}  // namespace chiaro::optimize
