/// A store of an analytic scene with a folder for its photographs, and what a blend makes of them.
#pragma once
#include <gtest/gtest.h>

#include <cmath>
#include <optional>
#include <string>
#include <vector>

#include "blend/blend.h"
#include "stream/base/file.h"
#include "stream/store/layer.h"
#include "stream/store/octree_build.h"
#include "tests/blend/analytic_scene.h"

namespace chiaro::blend::testing {

inline constexpr std::uint64_t kPlenty = std::uint64_t{1} << 30;

inline Vec3f smooth_paint(const Vec3d& p) {
  const auto wave = [](double v) { return static_cast<float>(0.5 + 0.2 * std::sin(v)); };
  return {wave(9 * p.x()), wave(7 * p.y() + 1), wave(5 * p.x() - 4 * p.y())};
}

inline AnalyticScene plane_scene() {
  AnalyticScene scene;
  scene.rectangles.push_back({Vec3d(0, 0, 0), Vec3d(1, 0, 0), Vec3d(0, 1, 0)});
  scene.albedo = smooth_paint;
  scene.spacing = 0.01;
  return scene;
}

inline ShotOptions gained(float gain) {
  ShotOptions options;
  options.gain = gain;
  return options;
}

/// Seen surfels with their positions and values.
struct Seen {
  Vec3d position;
  Vec3f normal, albedo;
  float sigma = 0;
  int photos = 0;
};

/// A store of the scene's points and a folder for its photographs.
class Workplace {
 public:
  explicit Workplace(AnalyticScene scene_, bool oriented = true, std::uint32_t chunk_surfels = 1000) : scene(std::move(scene_)) {
    write_scene_ply(folder.path() / "cloud.ply", scene.points());
    MemoryBudget budget(kPlenty);
    stream::BuildOptions build;
    build.chunk_surfels = chunk_surfels;
    if (!oriented) build.normals = stream::NormalSource::kEstimate;
    stream::build_store({folder.path() / "cloud.ply"}, folder.path() / "store.chiaro", build, budget, silent_reporter());
    store.emplace(folder.path() / "store.chiaro");
  }
  BlendPhotograph photograph(const std::string& name, const Vec3d& eye, const Vec3d& target, const ShotOptions& options = {}, double focal = 150) const {
    return shoot(scene, look_at(name, eye, target, 160, 120, focal), folder.path(), options);
  }
  BlendStats run(const std::vector<BlendPhotograph>& photographs, BlendOptions options = {}, std::uint64_t budget_bytes = kPlenty, Reporter& report = silent_reporter()) const {
    MemoryBudget budget(budget_bytes);
    const BlendStats stats = blend(*store, photographs, options, folder.path() / "scratch", budget, report);
    EXPECT_EQ(budget.used_bytes(), 0u);
    EXPECT_LE(budget.peak_bytes(), budget_bytes);
    return stats;
  }
  std::vector<Seen> result(const std::string& layer = "albedo") const {
    std::vector<Seen> all;
    const stream::Layer values(*store, layer);
    for (const std::uint32_t leaf : store->leaves()) {
      const stream::Chunk chunk = store->read_chunk(leaf);
      const stream::AlbedoValues v = stream::read_albedo(values, *store, leaf);
      for (std::uint32_t i = 0; i < chunk.count; ++i) {
        const stream::Surfel s = chunk.surfel(i);
        all.push_back({s.position_in_world, s.normal, v.albedo[i], v.sigma[i], v.photos[i]});
      }
    }
    return all;
  }
  /// All bytes of the leaves' values.
  std::vector<std::byte> bytes(const std::string& layer = "albedo") const {
    std::vector<std::byte> all;
    const stream::Layer values(*store, layer);
    for (std::uint32_t c = 0; c < store->chunks().size(); ++c) {
      const auto chunk = values.read_chunk(c);
      all.insert(all.end(), chunk.begin(), chunk.end());
    }
    return all;
  }

  AnalyticScene scene;
  ScratchFolder folder;
  std::optional<stream::Store> store;
};

}  // namespace chiaro::blend::testing
