/// A flash that stands elsewhere than where its rays were cast to.
#pragma once
#include "stream/base/types.h"

namespace chiaro::optimize {

/// Factor on the flash's irradiance at a place whose normal is n if the flash moves: of falloff and cosine, not of shadows. Between 1/2 and 2.
double flash_factor(const Vec3d& place, const Vec3d& normal, const Vec3d& flash, const Vec3d& moved);

}  // namespace chiaro::optimize
