/// What photographs leave open about the lights, or say against what the project claims: found after solving, said in words.
#pragma once
#include <span>
#include <string>
#include <vector>

#include "optimize/acquisition.h"

namespace chiaro::optimize {

/// Whether the flash reaches any sample of a photograph taken with it.
bool flash_reaches(std::span<const LightSample> samples);

/// Ambient radiance that makes the brightest samples reflect 80 %, if it is all the light there is; 0 without samples.
double guess_ambient(std::span<const LightSample> samples);

/// How far a calibrated range is from what the photographs say, and what they say by themselves.
struct RangeEvidence {
  double deviations = 0;        ///< of the difference between the range's middle and the solution, signed; expected within 2 or 3
  double ln_flash = 0, sd = 0;  ///< by the photographs alone; sd 0 where they say nothing
};

/// Posterior and prior of ln flash are normal: what is between them is the photographs'. Under a right range their means differ by prior variance - posterior variance.
RangeEvidence range_evidence(const std::array<double, 2>& intensity_range, const LightSolution& solution);

/// Notes on one solution. `who`: the photograph, or "PHOTO and the others of the acquisition".
/// alone: one photograph by itself. lit: flash_reaches().
std::vector<std::string> light_notes(const AcquisitionInput& input, std::span<const LightSample> samples, const LightSolution& solution, const std::string& who, bool alone, bool lit);

}  // namespace chiaro::optimize
