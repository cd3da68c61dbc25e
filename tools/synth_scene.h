/// Synthetic scenes of any size: every point is a function of (scene, seed, number of points, index), so nothing grows with their number.
#pragma once
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "stream/base/types.h"

namespace chiaro::tools {

enum class SynthKind { kSphere, kStatue, kWall, kRoom, kDuplicates, kOutlier, kVolume, kLine };

struct SynthSpec {
  SynthKind kind = SynthKind::kSphere;
  std::uint64_t seed = 1;
  double noise_m = 0;          ///< standard deviation along the normal, of the scene as written (after scale)
  bool normals = true;         ///< write the true normals
  bool scan_order = false;     ///< neighbours in the file are neighbours in space; false: random order
  double scale = 1;            ///< of the whole scene, > 0
  double offset_m = 0;         ///< added to x and y, ten times less to z: coordinates as surveys have them
  double share = 0;            ///< duplicates: distinct points over points (default 0.01); outlier: outliers over points (default 1e-6, at least one)
  double distance_m = 0;       ///< outlier: how far they are from the centre (default 1000 m)
};

/// "statue", "statue:noise=0.0005,seed=7,normals=false". throws UsageError naming what is wrong, with the nearest known word.
SynthSpec parse_synth_spec(const std::string& text);
/// The words that parse_synth_spec() knows, for --help: one line a scene, then one a parameter.
std::string synth_spec_help();

struct SynthPoint {
  Vec3d position;   ///< metres
  Vec3f normal;     ///< unit, true normal of the surface without noise
  Vec3f albedo;     ///< linear, by synth_albedo()
};

/// Albedo at a point of the scene before scale, offset and noise: red = 0.45 + 0.30 sin(12 x + 7 y), green = 0.45 + 0.30 sin(9 y + 8 z + 2),
/// blue = 0.45 + 0.30 sin(11 z - 6 x + 4). Within 0.15 .. 0.75.
Vec3f synth_albedo(const Vec3d& p);

class SynthScene {
 public:
  /// num_points: 1 .. 2^40.
  SynthScene(const SynthSpec& spec, std::uint64_t num_points);
  SynthScene(SynthScene&&) noexcept;
  ~SynthScene();

  /// Point of an index below num_points. Thread-safe. On a surface, the expected number of points on any part of it is proportional to the part's area,
  /// and every patch of some thousandths of the surface has its share but for rounding.
  SynthPoint point(std::uint64_t index) const;
  std::uint64_t num_points() const;
  const SynthSpec& spec() const;
  /// Holds every point, noise included.
  Box3d bounds() const;
  /// Square metres, after scale; 0 for volume and line.
  double area_m2() const;
  /// Of a point as written from the noise-free surface, metres: along the radius for sphere and statue, along z for the wall, else the nearest distance.
  /// For the scene outlier: from the statue, wherever the point is.
  double distance_to_surface(const Vec3d& position) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// A bijection of 0 .. count-1 in an order that looks random; the same for the same seed.
class IndexShuffle {
 public:
  IndexShuffle(std::uint64_t count, std::uint64_t seed);
  std::uint64_t operator()(std::uint64_t index) const;

 private:
  std::uint64_t count_, seed_;
  int half_bits_;
};

}  // namespace chiaro::tools
