// What one photograph needs of a large store, and how soon its first pixel is there.
//
//   working_set_bench STORE.chiaro [--size 4000x3000] [--rows 3000] [--field 50] [--light 0.02,-0.02,0] [--pixel-error 1] [--distances 0.05,0.2,1,3] [--memory 4GiB] [--cold] [--check 100000]
//
// Cameras look at the surface from outside, along the line from the centre of the bounds to its leaf in the middle of the Morton order: once for each distance
// from the surface, in units of half the diagonal of the bounds; --field is the width of the picture, degrees; --pixel-error how far apart surfels may be, pixels; --rows looks at that many rows in the middle of
// the picture alone, as rays are cast where the budget does not hold the whole (surfels/gbuffer.h). --light: where it stands in the camera's frame, in units of the
// camera's distance; beside it as a flash does if nothing is said. Share:
// of all chunks of the store, with inner ones. First pixel: from opening the store to the answer for the pixel in the middle. --cold: pages of the store are
// dropped first, without it they are read once before. --check: that many pixels, and the ways from there to the light, are also traced through everything in view,
// hidden or not; those that differ are counted.
#include <fcntl.h>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <sstream>
#include <string>
#include <vector>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/store/store_format.h"
#include "surfels/tracer.h"
#include "surfels/working_set.h"

namespace {

using namespace chiaro;
namespace fs = std::filesystem;
using Clock = std::chrono::steady_clock;

struct Options {
  fs::path store;
  int width = 4000, height = 3000, rows = 0;   ///< rows: 0 = all
  double field_deg = 50, pixel_error = 1;
  Vec3d light{0.02, -0.02, 0};
  std::vector<double> distances{0.05, 0.2, 1, 3};
  std::uint64_t memory = std::uint64_t{4} << 30;
  bool cold = false;
  int check = 0;   ///< pixels
};

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

surfels::View view_of(const Options& o, const stream::Manifest& m, const Vec3d& target, double distance) {
  const Vec3d centre = 0.5 * (m.bounds.min + m.bounds.max);
  const Vec3d forward = (centre - target).normalized(), right = forward.unitOrthogonal(), down = forward.cross(right);
  surfels::View v;
  v.lens.width_px = o.width;
  v.lens.height_px = o.height;
  v.lens.fx = v.lens.fy = 0.5 * o.width / std::tan(0.5 * o.field_deg * 3.14159265358979 / 180);
  v.lens.cx = 0.5 * o.width;
  v.lens.cy = 0.5 * o.height;
  const Vec3d eye = target - distance * forward;
  v.pose.rotation_camera_from_world << right.transpose(), down.transpose(), forward.transpose();
  v.pose.translation_camera_from_world = -v.pose.rotation_camera_from_world * eye;
  const int rows = o.rows > 0 ? std::min(o.rows, o.height) : o.height, first = (o.height - rows) / 2;
  v.rect = {0, first, o.width, first + rows};
  v.lights_in_world.push_back(v.pose.world_from_camera(distance * o.light));
  return v;
}

void touch(const fs::path& folder, bool drop) {
  for (const auto& entry : fs::directory_iterator(folder)) {
    if (!entry.is_regular_file()) continue;
    const File file(entry.path(), File::Mode::kRead);
    if (drop) posix_fadvise(file.descriptor(), 0, 0, POSIX_FADV_DONTNEED);
    std::vector<char> block(8 << 20);
    for (std::uint64_t at = 0; !drop && at < file.size(); at += block.size()) file.read_some_at(at, block.data(), block.size());
  }
}

/// Pixels, of `check` spread over the picture, for which leaving out what is hidden changes the answer.
int differences(const stream::Store& store, const surfels::View& view, const surfels::Tracer& seen, const Options& o, MemoryBudget& budget) {
  surfels::CutOptions cut;
  cut.pixel_error = o.pixel_error;
  cut.cull_hidden = false;
  surfels::Tracer all(view.pose.centre_in_world(), budget);
  for (const std::uint32_t c : surfels::select_visible(store, view, cut, budget, silent_reporter()).chunks) all.add(store.read_chunk(c));
  all.commit();
  const Vec3f flash = all.scene_from_world(view.lights_in_world[0]);
  int differ = 0;
  for (int i = 0; i < o.check; ++i) {
    const Vec2d at(view.rect.width() * std::fmod(i * 0.7548776662466927, 1.0), view.rect.y0 + view.rect.height() * std::fmod(i * 0.5698402909980532, 1.0));   // R2 sequence
    const Vec3f d = (view.pose.rotation_camera_from_world.transpose() * *stream::unproject(view.lens, at)).normalized().cast<float>();
    surfels::Hit a, b;
    const bool met = all.closest({Vec3f::Zero(), d, 0, 1e30f}, a);
    bool same = met == seen.closest({Vec3f::Zero(), d, 0, 1e30f}, b) && (!met || a.surfel == b.surfel);
    if (met && same) {
      const Vec3f p = d * a.t, to_flash = flash - p;
      const surfels::Ray back = surfels::escape_ray(p, a.normal, a.radius, to_flash.normalized(), to_flash.norm());
      same = all.occluded(back) == seen.occluded(back);
    }
    differ += !same;
  }
  return differ;
}

void measure(const Options& o, double share) {
  touch(o.store, o.cold);
  MemoryBudget budget(o.memory);
  const auto start = Clock::now();
  const stream::Store store(o.store);
  const stream::Manifest& m = store.manifest();
  const Box3d middle = store.bounds(store.leaves()[store.leaves().size() / 2]);
  const surfels::View view = view_of(o, m, 0.5 * (middle.min + middle.max), share * 0.5 * (m.bounds.max - m.bounds.min).norm());
  const double opened = seconds_since(start);
  surfels::CutOptions cut;
  cut.pixel_error = o.pixel_error;
  const surfels::WorkingSet set = surfels::select_visible(store, view, cut, budget, silent_reporter());
  const double selected = seconds_since(start);
  surfels::Tracer tracer(view.pose.centre_in_world(), budget);
  for (const std::uint32_t c : set.chunks) tracer.add(store.read_chunk(c));
  tracer.commit();
  surfels::Hit hit;
  const bool met = tracer.closest({Vec3f::Zero(), view.pose.rotation_camera_from_world.row(2).transpose().cast<float>(), 0, 1e30f}, hit);
  const double first = seconds_since(start);
  std::printf("| %.2f | %zu | %zu | %.2f %% | %.2f M | %llu | %.0f MiB | %.3f s | %.3f s | %.3f s | %s |", share, store.chunks().size(), set.chunks.size(),
              100 * static_cast<double>(set.chunks.size()) / static_cast<double>(store.chunks().size()), 1e-6 * static_cast<double>(set.surfels),
              static_cast<unsigned long long>(set.chunks_hidden), static_cast<double>(tracer.bytes()) / 1048576, opened, selected - opened, first, met ? "yes" : "no");
  if (o.check > 0) std::printf(" %d of %d |", differences(store, view, tracer, o, budget), o.check);
  std::printf("\n");
  std::fflush(stdout);
}

Options parse(int count, char** words) {
  Options o;
  for (int i = 1; i < count; ++i) {
    const std::string word = words[i];
    if (word == "--cold") o.cold = true;
    else if (!word.starts_with("--")) o.store = word;
    else if (i + 1 == count) throw Error(concat(word, ": a value is missing"));
    else if (word == "--size") {
      if (std::sscanf(words[++i], "%dx%d", &o.width, &o.height) != 2 || o.width < 1 || o.height < 1) throw Error("--size is WIDTHxHEIGHT");
    } else if (word == "--field") o.field_deg = std::stod(words[++i]);
    else if (word == "--rows") o.rows = std::stoi(words[++i]);
    else if (word == "--pixel-error") o.pixel_error = std::stod(words[++i]);
    else if (word == "--light") {
      if (std::sscanf(words[++i], "%lf,%lf,%lf", &o.light[0], &o.light[1], &o.light[2]) != 3) throw Error("--light is X,Y,Z");
    } else if (word == "--check") o.check = std::stoi(words[++i]);
    else if (word == "--memory") o.memory = parse_bytes(words[++i]);
    else if (word == "--distances") {
      o.distances.clear();
      std::istringstream list(words[++i]);
      for (std::string item; std::getline(list, item, ',');) o.distances.push_back(std::stod(item));
    } else throw Error(concat(word, ": unknown; see the head of working_set_bench.cpp"));
  }
  if (o.store.empty()) throw Error("which store?");
  return o;
}

}  // namespace

int main(int count, char** words) {
  try {
    const Options options = parse(count, words);
    std::printf("%s, %d x %d pixels, %s\n| distance | chunks | needed | share | surfels | hidden | resident | open | select | first pixel | hit |%s\n", options.store.c_str(), options.width, options.height,
                options.cold ? "cold" : "warm", options.check > 0 ? " differ |" : "");
    for (const double distance : options.distances) measure(options, distance);
    return 0;
  } catch (const std::exception& e) {
    std::fprintf(stderr, "error: %s\n", e.what());
    return 1;
  }
}
