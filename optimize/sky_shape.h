/// How the ambient light is described, and the richer descriptions that are tried beside it.
#pragma once
#include <string>
#include <vector>

#include "optimize/acquisition.h"

namespace chiaro::optimize {

/// How the ambient light is described.
struct SkyShape {
  int terms = 1;           ///< 0, 1, 4 or 9
  bool coloured = false, floor = false;
  std::string name() const;
  int parameters() const { return terms + (coloured ? 2 : 0) + (floor ? 1 : 0); }
};

SkyShape sky_shape(SkyModel model);

/// What may be tried instead of `plain`: colours and spherical harmonics where the model is automatic, each with and without a floor where there may be one.
std::vector<SkyShape> richer_skies(const SkyShape& plain, SkyModel model, bool floor);

}  // namespace chiaro::optimize
