/// Radiosity on the proxy: what is measured stays, what a photograph does not see follows from its albedo (physics.md A.4).
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "optimize/gather.h"
#include "optimize/light_solve.h"
#include "optimize/observe.h"

namespace chiaro::optimize {

/// Irradiance without bounces of the cloud: flash and sky, and a floor's share of both. 3 N values. floor_flash: flash_by_floor(), may be empty.
std::vector<float> direct_irradiance(const Transport& transport, std::span<const float> flash, std::span<const float> floor_flash, const Lights& lights);

/// B of unseen surfels = albedo * (direct + bounce * F B), by sweeps that start from what the observation holds; seen surfels keep their measurement. Several photographs at a
/// time: their radiosities lie beside each other, so that what a ray meets is fetched once for all. Each gets the same bits as by itself.
class Completion {
 public:
  static constexpr std::size_t kMost = 5;   ///< photographs: their colours fill a cache line

  /// transport and smoother outlive this; photographs: how many will be added, 1 to kMost.
  Completion(const Transport& transport, const Smoother& smoother, int smooth_passes, std::size_t photographs);
  /// albedo: 3 N, outlives this; the rest is copied. Radiosities of unseen surfels are where the sweeps start.
  void add(const Lights& lights, std::span<const float> albedo, const Observation& o);
  /// A photograph stops after max_sweeps or when no value moves by more than tolerance of the mean.
  void solve(int max_sweeps, double tolerance);
  /// Afterwards, by the order in which photographs were added: into the unseen surfels of its observation.
  void take_unseen(std::size_t photograph, Observation& o) const;
  /// G = F B, smoothed. 3 N.
  std::vector<float> gathered(std::size_t photograph) const;
  int sweeps(std::size_t photograph) const { return photographs_[photograph].sweeps; }

 private:
  struct Photograph {
    std::span<const float> albedo;
    float bounce = 1;
    std::vector<float> direct;           ///< 3 N
    std::vector<std::uint32_t> unseen;
    double seen_sum = 0;                 ///< of radiosities
    int sweeps = 0;
    bool moving = true;
  };
  struct alignas(64) Line {
    float values[16];
  };
  /// N places of floats_ floats: 3 of each photograph.
  using Lines = std::vector<Line>;
  float* at(Lines& lines, std::size_t i) const { return lines.data()->values + i * floats_; }
  const float* at(const Lines& lines, std::size_t i) const { return lines.data()->values + i * floats_; }
  Lines make_lines() const;
  std::vector<std::uint32_t> unseen_of_moving() const;
  void sum_hits(std::span<const std::uint32_t> surfels);
  void smooth();
  double move_unseen(std::size_t photograph, double& sum);

  const Transport& transport_;
  const Smoother& smoother_;
  const int smooth_passes_;
  const std::size_t floats_;
  std::vector<Photograph> photographs_;
  Lines radiosity_, gathered_;   ///< while sweeps go on, gathered_ holds sums over the rays
};

/// All surfels from their albedo: B = albedo * (direct + bounce * F B) with `scatterings` surface scatterings (each sweep adds one).
std::vector<float> forward_radiosity(const Transport& transport, std::span<const float> albedo, std::span<const float> direct, double bounce, int scatterings);

}  // namespace chiaro::optimize
