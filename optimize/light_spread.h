/// How much the light of an acquisition's photographs varies by itself.
#pragma once
#include <array>
#include <cstddef>

namespace chiaro::optimize {

/// A photograph's factors on the light that all share.
enum FactorKind : std::size_t { kAmbient, kExposure, kFactorKinds };

/// Over all photographs that are not unlike the others: standard deviations of ln, by FactorKind. 0: nothing speaks for it.
using LightSpread = std::array<double, kFactorKinds>;

/// What clouds do to the light of a window, most; what flashes are not the same by.
inline constexpr LightSpread kUsualSpread{0.2, 0.03};

}  // namespace chiaro::optimize
