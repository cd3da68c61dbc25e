/// What is uncertain about a surfel by itself, its neighbours tell, as far as its sigma says.
///
/// Noise of pixels, normals and misread places differs from surfel to surfel; albedo mostly does not. The variance of the albedo around a surfel, less what
/// the sigmas explain of it, is the surface's own; the surfel's deviation from its surroundings is kept in the proportion of the two (local Wiener filter).
/// Edges stay, because across them the surface's own variance is large and because neighbours that differ beyond their sigmas hardly count.
///
/// source: Lee, "Digital image enhancement and noise filtering by use of local statistics", PAMI 1980; Tomasi and Manduchi, "Bilateral filtering", ICCV 1998.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "stream/base/types.h"

namespace chiaro::blend {

/// Structure of arrays.
struct NoisySurfels {
  std::vector<Vec3f> position, normal;   ///< of one frame, project units; unit normals
  std::vector<std::uint8_t> oriented;    ///< 1: the sign of the normal is known
  std::vector<Vec3f> log_albedo;         ///< log_value() of the albedo
  std::vector<float> sd;                 ///< of log_albedo, without what neighbours share; 0: exact
  std::size_t size() const { return position.size(); }
  void resize(std::size_t n);
};

struct Denoised {
  Vec3f log_albedo = Vec3f::Zero();
  float sd = 0;
};

/// The first `count` surfels, from all of them within `reach` (project units).
std::vector<Denoised> denoise(const NoisySurfels& surfels, std::size_t count, float reach);

}  // namespace chiaro::blend
