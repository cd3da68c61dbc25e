#include "tools/project_words.h"

namespace chiaro::tools {

const Words<Normals>& words_of(Normals) { static const Words<Normals> w{{"auto", Normals::kAuto}, {"file", Normals::kFile}, {"estimate", Normals::kEstimate}, {"none", Normals::kNone}}; return w; }
const Words<Outliers>& words_of(Outliers) { static const Words<Outliers> w{{"none", Outliers::kNone}, {"statistical", Outliers::kStatistical}}; return w; }
const Words<Alignment>& words_of(Alignment) { static const Words<Alignment> w{{"none", Alignment::kNone}, {"icp", Alignment::kIcp}}; return w; }
const Words<Encoding>& words_of(Encoding) {
  static const Words<Encoding> w{{"auto", Encoding::kAuto}, {"linear", Encoding::kLinear}, {"srgb", Encoding::kSrgb}, {"raw", Encoding::kRaw}};
  return w;
}
const Words<AmbientModel>& words_of(AmbientModel) {
  static const Words<AmbientModel> w{{"auto", AmbientModel::kAuto}, {"none", AmbientModel::kNone}, {"uniform", AmbientModel::kUniform},
                                     {"sh1", AmbientModel::kSh1}, {"sh2", AmbientModel::kSh2}};
  return w;
}
const Words<FloorModel>& words_of(FloorModel) {
  static const Words<FloorModel> w{{"auto", FloorModel::kAuto}, {"none", FloorModel::kNone}};
  return w;
}
const Words<FalloffModel>& words_of(FalloffModel) {
  static const Words<FalloffModel> w{{"auto", FalloffModel::kAuto}, {"none", FalloffModel::kNone}, {"lens", FalloffModel::kLens}, {"flash", FalloffModel::kFlash}};
  return w;
}
const Words<SolveMethod>& words_of(SolveMethod) {
  static const Words<SolveMethod> w{{"joint", SolveMethod::kJoint}, {"single", SolveMethod::kSingle}, {"adam", SolveMethod::kAdam},
                                    {"direct", SolveMethod::kDirect}, {"none", SolveMethod::kNone}};
  return w;
}
const Words<BlendGain>& words_of(BlendGain) {
  static const Words<BlendGain> w{{"none", BlendGain::kNone}, {"grey", BlendGain::kGrey}, {"channels", BlendGain::kChannels}};
  return w;
}
const Words<BlendRefine>& words_of(BlendRefine) { static const Words<BlendRefine> w{{"none", BlendRefine::kNone}, {"image", BlendRefine::kImage}}; return w; }
const Words<AcquisitionRole>& words_of(AcquisitionRole) {
  static const Words<AcquisitionRole> w{{"flash", AcquisitionRole::kFlash}, {"no_flash", AcquisitionRole::kNoFlash}};
  return w;
}

namespace {
template <class E>
const char* word_of(E value) {
  for (const auto& [word, known] : words_of(value))
    if (known == value) return word;
  return "?";
}
}  // namespace

const char* name_of(Normals value) { return word_of(value); }
const char* name_of(Outliers value) { return word_of(value); }
const char* name_of(Alignment value) { return word_of(value); }
const char* name_of(Encoding value) { return word_of(value); }
const char* name_of(AmbientModel value) { return word_of(value); }
const char* name_of(FloorModel value) { return word_of(value); }
const char* name_of(FalloffModel value) { return word_of(value); }
const char* name_of(SolveMethod value) { return word_of(value); }
const char* name_of(BlendGain value) { return word_of(value); }
const char* name_of(BlendRefine value) { return word_of(value); }
const char* name_of(AcquisitionRole value) { return word_of(value); }

}  // namespace chiaro::tools
