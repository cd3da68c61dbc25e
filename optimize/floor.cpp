#include "optimize/floor.h"

#include <algorithm>
#include <cmath>

#include "optimize/proxy_file.h"
#include "stream/base/error.h"
#include "stream/base/parallel.h"

namespace chiaro::optimize {
namespace {

constexpr float kPi = 3.14159265f;
constexpr std::size_t kMapCells = 160;   ///< a side of the map of the flash on the floor
constexpr float kMapReach = 2.5f;        ///< half its side, in half diagonals of the cloud; shadows farther out do not matter
constexpr double kAgreement = 0.5;       ///< length of the mean of the cameras' down directions, below which there is none
constexpr double kSnapCosine = 0.906;    ///< 25 degrees
constexpr double kLowest = 0.001;        ///< share of the surfels that may lie below the floor: outliers

/// Distance along a ray from p to the floor; 0 where it does not get there.
float distance_to_floor(const Floor& floor, const Vec3f& p, const Vec3f& direction) {
  const float down = floor.normal.dot(direction), above = floor.normal.dot(p) - floor.height;
  return down < -1e-4f && above > 0 ? above / -down : 0.0f;
}

/// Calls body(surfel, direction, point on the floor) for every ray of the surfel that meets nothing but the floor.
template <class Body>
void for_floor_rays(const Proxy& proxy, const Transport& transport, const Floor& floor, std::size_t i, const Body& body) {
  const auto rays = static_cast<std::size_t>(transport.rays);
  const RayFan fan(proxy, transport.seed, i);
  for (std::size_t m = 0; m < rays; ++m) {
    if (transport.hits[i * rays + m] != Transport::kSky) continue;
    const Vec3f direction = fan.direction(m);
    if (const float t = distance_to_floor(floor, proxy.position[i], direction); t > 0) body(direction, proxy.position[i] + t * direction);
  }
}

/// Flash irradiance on the floor per unit intensity, 1/m^2.
class FlashMap {
 public:
  FlashMap(const Proxy& proxy, const surfels::Tracer& tracer, const Floor& floor, const Vec3d& flash_in_world) : floor_(floor), m2_(static_cast<float>(proxy.metres_per_unit * proxy.metres_per_unit)), lit_(kMapCells * kMapCells) {
    flash_ = (flash_in_world - proxy.origin_in_world).cast<float>();
    Vec3f low = Vec3f::Constant(1e30f), high = Vec3f::Constant(-1e30f);
    for (const Vec3f& p : proxy.position) {
      low = low.cwiseMin(p);
      high = high.cwiseMax(p);
    }
    const Vec3f middle = 0.5f * (low + high);
    centre_ = middle - (floor.normal.dot(middle) - floor.height) * floor.normal;
    half_ = kMapReach * 0.5f * (high - low).norm() + 1e-6f;
    u_ = floor.normal.unitOrthogonal();
    v_ = floor.normal.cross(u_);
    const Vec3f shift = (proxy.origin_in_world - tracer.origin_in_world()).cast<float>();
    parallel_blocks(lit_.size(), 256, [&](std::size_t b, std::size_t e) {
      for (std::size_t c = b; c < e; ++c) {
        const Vec3f y = centre_ + half_ * ((2 * (static_cast<float>(c % kMapCells) + 0.5f) / kMapCells - 1) * u_ + (2 * (static_cast<float>(c / kMapCells) + 0.5f) / kMapCells - 1) * v_);
        const Vec3f way = flash_ - y;
        const float r = way.norm();
        // From a little above, as the lowest surfels touch the floor.
        lit_[c] = !(r > 0) || tracer.occluded({y + shift, way / r, 1e-3f * half_, r}) ? 0.0f : 1.0f;
      }
    });
  }

  float irradiance(const Vec3f& y) const {
    const Vec3f way = flash_ - y;
    const float r2 = way.squaredNorm(), cosine = floor_.normal.dot(way) / std::sqrt(r2);
    return cosine > 0 ? visible(y) * cosine / (r2 * m2_) : 0.0f;
  }

 private:
  /// Bilinear; all light beyond the map.
  float visible(const Vec3f& y) const {
    const float x = ((y - centre_).dot(u_) / half_ + 1) * 0.5f * kMapCells - 0.5f, z = ((y - centre_).dot(v_) / half_ + 1) * 0.5f * kMapCells - 0.5f;
    if (!(x >= 0 && z >= 0 && x < kMapCells - 1 && z < kMapCells - 1)) return 1;
    const auto i = static_cast<std::size_t>(x), j = static_cast<std::size_t>(z);
    const float a = x - static_cast<float>(i), b = z - static_cast<float>(j);
    const float* row = lit_.data() + j * kMapCells + i;
    return (1 - b) * ((1 - a) * row[0] + a * row[1]) + b * ((1 - a) * row[kMapCells] + a * row[kMapCells + 1]);
  }

  Floor floor_;
  float m2_;   ///< of a square of the project's unit
  Vec3f flash_, centre_, u_, v_;
  float half_ = 1;
  std::vector<float> lit_;
};

}  // namespace

std::optional<Floor> find_floor(const Proxy& proxy, std::span<const Mat3d> rotations_camera_from_world) {
  if (proxy.size() == 0 || rotations_camera_from_world.empty()) return std::nullopt;
  Vec3d down = Vec3d::Zero();
  for (const Mat3d& r : rotations_camera_from_world) down += r.row(1).transpose();
  down /= static_cast<double>(rotations_camera_from_world.size());
  if (down.norm() < kAgreement) return std::nullopt;
  down.normalize();
  Eigen::Index axis;
  if (down.cwiseAbs().maxCoeff(&axis) > kSnapCosine) {
    const double sign = down[axis] > 0 ? 1 : -1;
    down = Vec3d::Zero();
    down[axis] = sign;
  }
  Floor floor;
  floor.normal = -down.cast<float>();
  std::vector<float> heights;
  for (const Vec3f& p : proxy.position) heights.push_back(floor.normal.dot(p));
  const auto at = heights.begin() + static_cast<std::ptrdiff_t>(kLowest * static_cast<double>(heights.size()));
  std::nth_element(heights.begin(), at, heights.end());
  floor.height = *at;
  return floor;
}

std::vector<float> hidden_by_floor(const Proxy& proxy, const Transport& transport, const Smoother& smoother, const Floor& floor) {
  std::vector<float> hidden(proxy.size() * kSkyTerms, 0.0f);
  parallel_blocks(proxy.size(), 1024, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) {
      float* sum = hidden.data() + i * kSkyTerms;
      for_floor_rays(proxy, transport, floor, i, [&](const Vec3f& direction, const Vec3f&) {
        float terms[kSkyTerms];
        sky_basis(direction, terms);
        for (int k = 0; k < kSkyTerms; ++k) sum[k] += terms[k] * kPi / static_cast<float>(transport.rays);
      });
    }
  });
  smoother.apply(hidden, kSkyTerms, kSmoothPasses);
  return hidden;
}

std::vector<std::vector<float>> flash_by_floor(const Proxy& proxy, const Transport& transport, const Smoother& smoother, const surfels::Tracer& tracer, const Floor& floor,
                                               std::span<const Vec3d> flashes_in_world) {
  std::vector<FlashMap> maps;
  for (const Vec3d& flash : flashes_in_world) maps.emplace_back(proxy, tracer, floor, flash);
  const std::size_t count = maps.size();
  std::vector<float> irradiance(count * proxy.size(), 0.0f);   // flashes beside each other
  parallel_blocks(proxy.size(), 1024, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) {
      float* sum = irradiance.data() + i * count;
      for_floor_rays(proxy, transport, floor, i, [&](const Vec3f&, const Vec3f& y) {
        for (std::size_t f = 0; f < count; ++f) sum[f] += maps[f].irradiance(y);
      });
      for (std::size_t f = 0; f < count; ++f) sum[f] /= static_cast<float>(transport.rays);
    }
  });
  smoother.apply(irradiance, static_cast<int>(count), kSmoothPasses);
  std::vector<std::vector<float>> each(count, std::vector<float>(proxy.size()));
  for (std::size_t i = 0; i < proxy.size(); ++i)
    for (std::size_t f = 0; f < count; ++f) each[f][i] = irradiance[i * count + f];
  return each;
}

void write_floor(const std::optional<Floor>& floor, const std::vector<float>& hidden, const std::filesystem::path& path) {
  std::vector<float> values;
  if (floor) values = {floor->normal.x(), floor->normal.y(), floor->normal.z(), floor->height};
  if (floor) values.insert(values.end(), hidden.begin(), hidden.end());
  write_floats(values, path);
}

std::optional<Floor> read_floor(const std::filesystem::path& path, std::size_t num_surfels, std::vector<float>& hidden) {
  hidden.clear();
  std::error_code code;
  const auto bytes = std::filesystem::file_size(path, code);
  if (code) throw Error(concat(path.string(), ": cannot be read: ", code.message()));
  if (bytes == 4) {
    read_floats(path, 0);
    return std::nullopt;
  }
  hidden = read_floats(path, num_surfels * kSkyTerms + 4);
  const Floor floor{{hidden[0], hidden[1], hidden[2]}, hidden[3]};
  hidden.erase(hidden.begin(), hidden.begin() + 4);
  return floor;
}

}  // namespace chiaro::optimize
