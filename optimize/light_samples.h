/// Which surfels, pairs of surfels and targets the lights are solved from, and what photographs say about them.
#pragma once
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "optimize/acquisition.h"
#include "optimize/fields.h"

namespace chiaro::optimize {

/// What a photograph says of surfel i; `gathered` is its G, 3 N.
LightSample sample_of(const Transport& transport, const Observation& o, const std::vector<float>& gathered, std::size_t i);

/// Surfels that stand for the acquisition in the light solve: seen `at_least` times, chosen by hash so that the choice is even and repeatable.
/// most_readings: fewer are chosen if together they would be seen more often than that.
std::vector<std::uint32_t> choose_surfels(const std::vector<std::uint16_t>& times_seen, int at_least, std::size_t count, std::uint64_t seed, std::size_t most_readings = SIZE_MAX);

/// Whole groups, evenly chosen, so that about `most` are left: enough to compare models by.
std::vector<LightSample> thinned(const std::vector<LightSample>& samples, std::size_t most);

/// Two surfels of one photograph that probably share their albedo.
struct Pair {
  std::uint32_t a, b;
  float trust;
};

/// Pairs at several scales: a surfel and the seen surfel nearest to a point some way along the surface.
std::vector<Pair> choose_pairs(const Scene& scene, const Observation& o, std::size_t count, std::uint64_t seed);

/// The mean over the pixels of a target; what is gathered comes from the proxy around its middle.
struct ReferenceReading {
  ReferenceSample reference;
  Stencil stencil;
  std::size_t photograph;
  Vec3f place, normal;   ///< of its middle, frame of the proxy
};

/// Absent where the target covers no usable pixel.
std::optional<ReferenceReading> read_reference(const Scene& scene, const AcquisitionInput& input, const ReferenceTarget& target);

/// Of the light gathered there, the share that comes from surfaces which no photograph shows (times_seen 0), whose albedo is a guess.
double unknown_share(const Transport& transport, const Stencil& stencil, std::span<const float> radiosity, std::span<const std::uint16_t> times_seen);

/// Where a photograph's flash stands; absent: taken without.
std::optional<Vec3d> flash_in_world(const AcquisitionInput& input, std::size_t photograph);

}  // namespace chiaro::optimize
