/// Surfaces by formula that synthetic scenes are made of.
#pragma once
#include <memory>
#include <vector>

#include "stream/base/types.h"

namespace chiaro::tools {

struct SheetPoint {
  Vec3d position;   ///< metres, scene frame: z up
  Vec3d normal;     ///< unit, to the side that is seen
  double stretch;   ///< area on the surface over area in the unit square; 0 = not part of the surface
};

/// A surface over the unit square.
class Sheet {
 public:
  virtual ~Sheet() = default;
  virtual SheetPoint at(double u, double v) const = 0;
  /// The square is cut into cells x cells patches of known area; each is measured at probes x probes points.
  virtual int cells() const { return 32; }
  virtual int probes() const { return 4; }
};

/// Height of the wall's relief at (x, y) and its gradient, metres. Running bond: bricks of 0.25 x 0.075 m (joints of 10 mm included) that stand up to 15 mm
/// proud of the mortar, each by its own amount.
struct ReliefHeight {
  double height = 0, dx = 0, dy = 0;
};
ReliefHeight wall_relief(double x_m, double y_m);
inline constexpr double kWallWidth = 4, kWallHeight = 3;

/// Distance of the statue's surface from its centre in direction d (unit), and the gradient over d in space, metres. An upright body of about 0.5 x 0.45 x 0.9 m
/// (half axes) with folds of 1 to 20 cm and six cavities up to 10 cm deep.
struct StarRadius {
  double radius = 0;
  Vec3d gradient = Vec3d::Zero();
};
StarRadius statue_radius(const Vec3d& d);

inline constexpr double kSphereRadius = 1;
inline constexpr double kRoomLength = 10, kRoomWidth = 8, kRoomHeight = 4, kColumnRadius = 0.3;
/// Centres of the room's six columns.
std::vector<Vec2d> room_columns();

std::vector<std::unique_ptr<Sheet>> sphere_sheets();
std::vector<std::unique_ptr<Sheet>> statue_sheets();
std::vector<std::unique_ptr<Sheet>> wall_sheets();
std::vector<std::unique_ptr<Sheet>> room_sheets();

}  // namespace chiaro::tools
