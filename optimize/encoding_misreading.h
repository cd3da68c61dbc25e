/// Photographs that hold the sRGB curve and are taken as linear, or the other way round.
#pragma once
#include <optional>
#include <span>
#include <string>

#include "optimize/light_solve.h"

namespace chiaro::optimize {

/// What should have been done with the values.
enum class CurveChange { kDecode, kEncode };

struct EncodingMisreading {
  CurveChange change = CurveChange::kDecode;
  double scatter = 0, scatter_as_taken = 0;   ///< of ln albedo between photographs (LightSolution::scatter), of the same samples. A curve makes all differences larger or smaller: both are for values as they were taken
};

/// Whether the first is so much less than the second that it is worth telling, and by itself what photographs of one surface differ by.
bool explains_far_better(double scatter, double as_taken);

/// Solves for the lights by the values as they are, with the curve taken off, and with it put on. Values have to be those of a picture, white at 1: where some lie above, nothing is found.
/// Light that is compressed by a curve passes for ambient light and for brightness that varies; as long as nothing of that is taken out, it shows by what remains.
///
/// samples     sorted by group. Nothing in them is corrected yet for photographs unlike the others, falloff or a shift.
/// as_taken    lights that explain them.
/// returns     absent where neither is far better.
/// memory      a copy of the samples.
std::optional<EncodingMisreading> find_encoding_misreading(std::span<const LightSample> samples, const LightSolveOptions& options, const Lights& as_taken);

/// In words, with what to write instead.
std::string encoding_note(const EncodingMisreading& misreading);

}  // namespace chiaro::optimize
