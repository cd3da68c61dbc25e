/// The words of the project file for each enumeration, in the order in which they are suggested.
#pragma once
#include <utility>
#include <vector>

#include "tools/project.h"

namespace chiaro::tools {

template <class E>
using Words = std::vector<std::pair<const char*, E>>;
const Words<Normals>& words_of(Normals);
const Words<Outliers>& words_of(Outliers);
const Words<Alignment>& words_of(Alignment);
const Words<Encoding>& words_of(Encoding);
const Words<AmbientModel>& words_of(AmbientModel);
const Words<FloorModel>& words_of(FloorModel);
const Words<FalloffModel>& words_of(FalloffModel);
const Words<SolveMethod>& words_of(SolveMethod);
const Words<BlendGain>& words_of(BlendGain);
const Words<BlendRefine>& words_of(BlendRefine);
const Words<AcquisitionRole>& words_of(AcquisitionRole);

}  // namespace chiaro::tools
