/// Rays on the surfaces of synthetic scenes: the formulas of synth_surfaces.h themselves, never points that were drawn from them.
#pragma once
#include <limits>
#include <memory>
#include <optional>

#include "stream/base/types.h"
#include "tools/synth_scene.h"

namespace chiaro::tools {

struct BodyHit {
  double distance = 0;   ///< along the ray, metres
  Vec3d position, normal;   ///< of the surface, normal to the side that is seen
};

/// All in the frame of the scene before scale and offset, metres. Thread-safe. Surfaces have one side: rays start outside of the solid.
class SynthBody {
 public:
  static constexpr double kFar = std::numeric_limits<double>::infinity();
  /// Start a ray this far off a surface that it leaves, along the normal, metres: more than the rays' error, less than any detail.
  static constexpr double kLift = 1e-4;

  virtual ~SynthBody() = default;
  /// First meeting of the ray with the surface nearer than max_distance. direction: unit.
  virtual std::optional<BodyHit> hit(const Vec3d& origin, const Vec3d& direction, double max_distance = kFar) const = 0;
  /// Whether there is one.
  virtual bool occluded(const Vec3d& origin, const Vec3d& direction, double max_distance = kFar) const { return hit(origin, direction, max_distance).has_value(); }
  /// No ray from a surface gets away: no light comes from outside.
  virtual bool is_closed() const { return false; }
};

/// sphere, statue, wall and room.
bool has_body(SynthKind kind);
/// null for scenes that are no surface to photograph.
std::unique_ptr<SynthBody> make_body(SynthKind kind);

}  // namespace chiaro::tools
