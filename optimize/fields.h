/// Smooth fields of the proxy (sky terms, gathered light) read at any point: what a pixel needs beside its own direct light.
#pragma once
#include <array>
#include <cstdint>

#include "optimize/proxy.h"

namespace chiaro::optimize {

inline constexpr std::size_t kStencil = 8;

/// Weights over the nearest proxy surfels of like normal; they sum to 1.
struct Stencil {
  std::array<std::uint32_t, kStencil> index{};
  std::array<float, kStencil> weight{};
};

/// point in the proxy's scene frame, unit normal. Never empty: the nearest surfel serves where no neighbour has a like normal.
Stencil stencil_at(const Proxy& proxy, const NearestPoints& nearest, const Vec3f& point, const Vec3f& normal);

/// Interpolates `channels` interleaved values a surfel.
template <std::size_t Channels>
std::array<float, Channels> interpolate(const Stencil& stencil, const std::vector<float>& values) {
  std::array<float, Channels> out{};
  for (std::size_t j = 0; j < kStencil; ++j)
    for (std::size_t c = 0; c < Channels; ++c) out[c] += stencil.weight[j] * values[stencil.index[j] * Channels + c];
  return out;
}

}  // namespace chiaro::optimize
