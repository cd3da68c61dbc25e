/// A flash offset that was measured well and written in other axes or another unit than the project's.
#pragma once
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "optimize/light_solve.h"

namespace chiaro::optimize {

/// One way to misread an offset.
struct OffsetReading {
  Mat3d offset_from_written;   ///< what should have been written
  std::string mistake;         ///< how it was written instead: "with y up"
};

/// Those that people make: axes of other programs, a picture on its side, another unit.
std::vector<OffsetReading> usual_readings();

/// Where the flash of a photograph stands under a reading; frame of the positions.
using FlashUnder = std::function<Vec3d(std::size_t photograph, const Mat3d& offset_from_written)>;

/// The reading that explains the photographs far better than the offset as it is written.
struct Misreading {
  OffsetReading reading;
  double scatter = 0, scatter_as_written = 0;   ///< of ln albedo between photographs (LightSolution::scatter), of the same samples
  double scatter_corrected = 0;                 ///< as written, with what was taken out in the end (light that varies, a shift, a falloff)
};

/// Whether it explains the photographs and leaves far less than the offset as written does with all that was taken out; or, where that was light that varies from photograph to photograph, about as little by itself.
bool is_worth_telling(const Misreading& misreading, bool light_varies);

/// Solves for the lights under each reading, from what no shadow of the flash reaches as the offset is written. Where another flash would cast shadows is not looked for: that speaks
/// against a reading, so that one that is found has overcome it. Single photographs are not asked: what they say of the lights is too little.
///
/// samples            sorted by group, which is an index into position and normal. Nothing that the offset may have caused (photographs unlike the others, a falloff, a shift) is taken out.
/// as_written         lights that explain them by the offset as it is written.
/// returns            absent where no reading is far better.
/// memory             a copy of the samples.
std::optional<Misreading> find_misreading(std::span<const LightSample> samples, std::span<const Vec3f> position, std::span<const Vec3f> normal, const FlashUnder& flash_under,
                                          std::span<const ReferenceSample> references, const LightSolveOptions& options, const Lights& as_written);

/// In words, with what to write instead.
std::string misreading_note(const Misreading& misreading, const Vec3d& written);

}  // namespace chiaro::optimize
