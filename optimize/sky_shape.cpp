#include "optimize/sky_shape.h"

namespace chiaro::optimize {

std::string SkyShape::name() const {
  const char* shape = terms == 0 ? "none" : terms == 1 ? "uniform" : terms == 4 ? "sh1" : "sh2";
  return std::string(shape) + (coloured ? " coloured" : "") + (floor ? " + floor" : "");
}

SkyShape sky_shape(SkyModel model) {
  switch (model) {
    case SkyModel::kNone: return {0};
    case SkyModel::kUniform:
    case SkyModel::kAuto: return {1};
    case SkyModel::kSh1: return {4};
    case SkyModel::kSh2: return {9};
  }
  return {1};
}

std::vector<SkyShape> richer_skies(const SkyShape& plain, SkyModel model, bool floor) {
  std::vector<SkyShape> shapes{plain};
  if (model == SkyModel::kAuto) shapes.insert(shapes.end(), {{1, true}, {4, false}, {4, true}, {9, false}, {9, true}});
  std::vector<SkyShape> candidates(shapes.begin() + 1, shapes.end());
  if (floor)
    for (SkyShape s : shapes) {
      s.floor = true;
      candidates.push_back(s);
    }
  return candidates;
}

}  // namespace chiaro::optimize
