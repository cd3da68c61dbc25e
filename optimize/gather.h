/// Light transport between the surfels of a proxy, gathered once per geometry and solved many times (physics.md A.4).
#pragma once
#include <cstdint>
#include <filesystem>
#include <span>
#include <vector>

#include "optimize/proxy.h"
#include "stream/base/budget.h"
#include "stream/base/report.h"

namespace chiaro::optimize {

/// Basis of the sky: 1, then the polynomials of real spherical harmonics up to order 2 in the world direction w, not normalised:
/// y, z, x, xy, yz, 3z^2-1, xz, x^2-y^2. The irradiance of a sky of radiance sum_b L_b basis_b is sum_b L_b sky[i][b].
inline constexpr int kSkyTerms = 9;
void sky_basis(const Vec3f& direction, float* terms);

inline constexpr int kSmoothPasses = 4;   ///< over 16 neighbours of like normal, of whatever was gathered

struct GatherOptions {
  int rays = 64;            ///< per surfel, cosine-distributed
  std::uint64_t seed = 1;
  int smooth_passes = kSmoothPasses;
};

struct Transport {
  static constexpr std::uint32_t kSky = 0xffffffffu;
  int rays = 0;
  std::uint64_t seed = 1;            ///< the directions follow from it: see RayFan
  std::vector<std::uint32_t> hits;   ///< N * rays: proxy index that a ray meets, or kSky
  std::vector<float> sky;            ///< N * kSkyTerms, smoothed: pi / rays * sum over rays to the sky of basis; sky[0] = pi * v
  std::vector<float> hidden;         ///< N * kSkyTerms or empty: what a floor outside the cloud would hide of `sky` (optimize/floor.h); kept in a file of its own
  double back_share = 0;             ///< rays that met a surfel from behind
  std::size_t size() const { return sky.size() / kSkyTerms; }
};

/// The directions of one surfel's rays: low-discrepancy, cosine-distributed, rotated by the surfel's index.
class RayFan {
 public:
  RayFan(const Proxy& proxy, std::uint64_t seed, std::size_t surfel);
  Vec3f direction(std::size_t ray) const;

 private:
  Vec3f normal_, u_, v_;
  Vec2f shift_;
};

/// Casts the rays. Low-discrepancy directions, rotated per surfel by its index: the same bits for any thread count.
Transport gather(const Proxy& proxy, const surfels::Tracer& tracer, const Smoother& smoother, const GatherOptions& options, Reporter& report);

/// G = F B: irradiance from other surfels, mean over the rays of the radiosity that they meet. B and G: N * 3, interleaved.
void gather_radiosity(const Transport& transport, std::span<const float> radiosity, std::vector<float>& irradiance);
/// The adjoint: out_j = sum_i F_ij x_i (scatter, in index order).
void gather_adjoint(const Transport& transport, std::span<const float> x, std::vector<float>& out);

/// On disk: magic, version, counts, arrays, CRC-32C. throws Error on anything else.
void write_transport(const Transport& transport, const std::filesystem::path& path);
Transport read_transport(const std::filesystem::path& path, std::size_t expected_surfels);

}  // namespace chiaro::optimize
