/// Denoising chunk by chunk: a leaf with what lies around it in other leaves, so that borders leave no trace.
#pragma once
#include <cstdint>
#include <functional>
#include <vector>

#include "blend/accumulate.h"
#include "stream/store/store.h"

namespace chiaro::blend {

class LeafDenoiser {
 public:
  /// blended: the values of a leaf, by its place in store.leaves(); called from several threads. brightness: see log_value().
  LeafDenoiser(const stream::Store& store, float brightness, std::function<std::vector<BlendedSurfel>(std::size_t leaf)> blended);

  /// Leaves albedo, own_sigma and sigma of a leaf's values as its surroundings have them. Thread-safe.
  void denoise(std::size_t leaf, std::vector<BlendedSurfel>& values) const;

  /// Of a surfel of the leaf, at most: itself, its surroundings and the search.
  static std::uint64_t bytes_per_surfel();

 private:
  std::vector<std::uint32_t> leaves_near(std::uint32_t chunk, const Box3d& box) const;
  /// Puts what lies within reach of a leaf behind the first `own` surfels, which are its. false: too much.
  bool add_surroundings(std::uint32_t chunk, const Vec3d& origin, double reach, struct NoisySurfels& surfels, std::size_t own) const;

  const stream::Store& store_;
  const float brightness_;
  const std::function<std::vector<BlendedSurfel>(std::size_t)> blended_;
  std::vector<std::uint32_t> leaf_of_chunk_;   // place in store.leaves()
};

}  // namespace chiaro::blend
