#include "optimize/flash_place.h"

#include <algorithm>
#include <cmath>

namespace chiaro::optimize {

double flash_factor(const Vec3d& place, const Vec3d& normal, const Vec3d& flash, const Vec3d& moved) {
  const Vec3d before = flash - place, after = moved - place;
  const double cosine = normal.dot(before) / std::pow(before.norm(), 3), now = normal.dot(after) / std::pow(after.norm(), 3);
  if (!(cosine > 0)) return 1;
  return std::clamp(now / cosine, 0.5, 2.0);
}

}  // namespace chiaro::optimize
