/// Random numbers as a function, not a state: the same (seed, purpose, element, draw) gives the same number on any thread, in any order.
#pragma once
#include <array>
#include <cstdint>

namespace chiaro {

/// Philox4x32-10. source: Salmon et al., "Parallel Random Numbers: As Easy as 1, 2, 3", SC 2011.
std::array<std::uint32_t, 4> philox4x32(std::array<std::uint32_t, 4> counter, std::array<std::uint32_t, 2> key);

/// What a draw is for; part of the counter, so that two uses never share numbers. Append only: values are part of the results.
enum class Purpose : std::uint32_t { kTest = 0, kGatherRotation = 1, kSampleChoice = 2, kSynth = 3, kPairChoice = 4, kPixelJitter = 5, kNoise = 6 };

/// Uniform in [0, 1), 24 bits.
float uniform01(std::uint64_t seed, Purpose purpose, std::uint64_t element, std::uint32_t draw);
/// Four uniforms of one evaluation: draws 4*block .. 4*block+3.
std::array<float, 4> uniform01x4(std::uint64_t seed, Purpose purpose, std::uint64_t element, std::uint32_t block);
/// Standard normal by Box-Muller; two draws a value.
double normal01(std::uint64_t seed, Purpose purpose, std::uint64_t element, std::uint32_t draw);

}  // namespace chiaro
