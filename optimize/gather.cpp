#include "optimize/gather.h"

#include <atomic>
#include <cmath>
#include <cstring>
#include <numbers>
#include <optional>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

constexpr float kPi = std::numbers::pi_v<float>;

/// Orthonormal frame around a unit vector. source: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 2017.
void basis_around(const Vec3f& n, Vec3f& u, Vec3f& v) {
  const float sign = std::copysign(1.0f, n.z());
  const float a = -1.0f / (sign + n.z()), b = n.x() * n.y() * a;
  u = {1.0f + sign * n.x() * n.x() * a, sign * b, -sign * n.x()};
  v = {b, sign + n.y() * n.y() * a, -n.y()};
}

float fraction(float x) { return x - std::floor(x); }

/// k-th point of the R2 sequence (additive recurrence with the plastic number), shifted: Cranley-Patterson rotation keeps its discrepancy.
/// source: M. Roberts, "The Unreasonable Effectiveness of Quasirandom Sequences", 2018.
Vec2f sequence_point(int k, const Vec2f& shift) {
  constexpr double kG = 1.32471795724474602596;
  const double a = (k + 0.5) / kG, b = (k + 0.5) / (kG * kG);
  return {fraction(shift.x() + static_cast<float>(a - std::floor(a))), fraction(shift.y() + static_cast<float>(b - std::floor(b)))};
}

Vec3f cosine_direction(const Vec2f& u, const Vec3f& n, const Vec3f& t, const Vec3f& b) {
  const float r = std::sqrt(u.x()), phi = 2 * kPi * u.y();
  return (t * (r * std::cos(phi)) + b * (r * std::sin(phi)) + n * std::sqrt(std::max(0.0f, 1 - u.x()))).normalized();
}

/// Normals farther apart belong to two faces of an edge, as in the fit of normals.
constexpr float kOtherFace = 0.82f;   // cos 35 degrees
constexpr float kOwnReach = 3;        // times what a ray skips: a blend of the own discs may end beyond it

/// What a ray from surfel i meets, absent: the sky. Its own surface is skipped (surfels::EscapeOptions), but not the front of another face that begins within that reach:
/// beside a crease most rays end there, and let through they would meet the sky. (Two planes at 80 degrees: sky 15 % too large and bounces 10 % too small within six radii.)
std::optional<std::uint32_t> met(const Proxy& proxy, const surfels::Tracer& tracer, const Vec3f& shift, std::size_t i, const Vec3f& direction) {
  surfels::Ray ray = surfels::escape_ray(proxy.position[i] + shift, proxy.normal[i], proxy.radius[i], direction, 1e30f);
  const float skip = ray.t_min;
  ray.t_min = 0;
  surfels::Hit hit;
  if (!tracer.closest(ray, hit)) return std::nullopt;
  std::uint32_t j = proxy.index_of(hit.surfel);
  const bool other_face = proxy.normal[j].dot(proxy.normal[i]) < kOtherFace && proxy.normal[j].dot(direction) < 0;
  if (hit.t < kOwnReach * skip && !other_face) {
    ray.t_min = skip;
    if (!tracer.closest(ray, hit)) return std::nullopt;
    j = proxy.index_of(hit.surfel);
  }
  return j;
}

}  // namespace

void sky_basis(const Vec3f& w, float* terms) {
  const float x = w.x(), y = w.y(), z = w.z();
  const float values[kSkyTerms] = {1, y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y};
  std::memcpy(terms, values, sizeof values);
}

RayFan::RayFan(const Proxy& proxy, std::uint64_t seed, std::size_t surfel) : normal_(proxy.normal[surfel]) {
  const auto u = uniform01x4(seed, Purpose::kGatherRotation, surfel, 0);
  shift_ = {u[0], u[1]};
  basis_around(normal_, u_, v_);
}

Vec3f RayFan::direction(std::size_t ray) const { return cosine_direction(sequence_point(static_cast<int>(ray), shift_), normal_, u_, v_); }

Transport gather(const Proxy& proxy, const surfels::Tracer& tracer, const Smoother& smoother, const GatherOptions& options, Reporter& report) {
  Transport transport;
  transport.rays = options.rays;
  transport.seed = options.seed;
  const std::size_t n = proxy.size(), rays = static_cast<std::size_t>(options.rays);
  transport.hits.assign(n * rays, Transport::kSky);
  transport.sky.assign(n * kSkyTerms, 0.0f);
  std::vector<std::uint32_t> back(n, 0);
  report.begin("gather", n, "surfels");
  const Vec3f shift = (proxy.origin_in_world - tracer.origin_in_world()).cast<float>();
  std::atomic<std::size_t> done{0};
  parallel_blocks(n, 256, [&](std::size_t b, std::size_t e) {
    report.check();
    for (std::size_t i = b; i < e; ++i) {
      const RayFan fan(proxy, options.seed, i);
      float* sky = transport.sky.data() + i * kSkyTerms;
      for (std::size_t m = 0; m < rays; ++m) {
        const Vec3f direction = fan.direction(m);
        if (const auto j = met(proxy, tracer, shift, i, direction)) {
          transport.hits[i * rays + m] = *j;
          back[i] += proxy.normal[*j].dot(direction) > 0;
        } else {
          float terms[kSkyTerms];
          sky_basis(direction, terms);
          for (int k = 0; k < kSkyTerms; ++k) sky[k] += terms[k];
        }
      }
      for (int k = 0; k < kSkyTerms; ++k) sky[k] *= kPi / static_cast<float>(rays);
    }
    report.progress(done += e - b);
  });
  std::uint64_t total = 0;
  for (const std::uint32_t c : back) total += c;
  transport.back_share = static_cast<double>(total) / static_cast<double>(std::max<std::size_t>(1, n * rays));
  smoother.apply(transport.sky, kSkyTerms, options.smooth_passes);
  report.end();
  return transport;
}

void gather_radiosity(const Transport& transport, std::span<const float> radiosity, std::vector<float>& irradiance) {
  const std::size_t n = transport.size(), rays = static_cast<std::size_t>(transport.rays);
  irradiance.resize(n * 3);
  parallel_blocks(n, 2048, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) {
      float sum[3] = {0, 0, 0};
      for (std::size_t m = i * rays; m < (i + 1) * rays; ++m) {
        const std::uint32_t j = transport.hits[m];
        if (j == Transport::kSky) continue;
        for (std::size_t c = 0; c < 3; ++c) sum[c] += radiosity[j * 3 + c];
      }
      for (std::size_t c = 0; c < 3; ++c) irradiance[i * 3 + c] = sum[c] / static_cast<float>(rays);
    }
  });
}

void gather_adjoint(const Transport& transport, std::span<const float> x, std::vector<float>& out) {
  const std::size_t n = transport.size(), rays = static_cast<std::size_t>(transport.rays);
  out.assign(n * 3, 0.0f);
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t m = i * rays; m < (i + 1) * rays; ++m) {
      const std::uint32_t j = transport.hits[m];
      if (j == Transport::kSky) continue;
      for (std::size_t c = 0; c < 3; ++c) out[j * 3 + c] += x[i * 3 + c] / static_cast<float>(rays);
    }
}

namespace {
struct TransportHeader {
  char magic[8];
  std::uint32_t version, rays;
  std::uint64_t surfels;
  double back_share;
  std::uint64_t seed;
  std::uint32_t crc, reserved;
};
constexpr char kMagic[8] = {'C', 'H', 'T', 'R', 'A', 'N', 'S', '2'};
}  // namespace

void write_transport(const Transport& transport, const std::filesystem::path& path) {
  TransportHeader header{};
  std::memcpy(header.magic, kMagic, 8);
  header.version = 2;
  header.rays = static_cast<std::uint32_t>(transport.rays);
  header.surfels = transport.size();
  header.back_share = transport.back_share;
  header.seed = transport.seed;
  header.crc = crc32c(transport.sky.data(), transport.sky.size() * 4, crc32c(transport.hits.data(), transport.hits.size() * 4));
  AtomicFile file(path);
  file.append(&header, sizeof header);
  file.append(transport.hits.data(), transport.hits.size() * 4);
  file.append(transport.sky.data(), transport.sky.size() * 4);
  file.commit();
}

Transport read_transport(const std::filesystem::path& path, std::size_t expected_surfels) {
  const File file(path, File::Mode::kRead);
  TransportHeader header{};
  file.read_at(0, &header, sizeof header);
  if (std::memcmp(header.magic, kMagic, 8) != 0 || header.version != 2) throw Error(concat(path.string(), ": not a transport file of version 2"));
  if (header.surfels != expected_surfels || header.rays == 0 || header.rays > 65536 ||
      file.size() != sizeof header + header.surfels * (header.rays + std::uint64_t{kSkyTerms}) * 4)
    throw Error(concat(path.string(), ": holds ", header.surfels, " surfels of ", header.rays, " rays in ", file.size(), " bytes, expected ", expected_surfels, " surfels"));
  Transport transport;
  transport.rays = static_cast<int>(header.rays);
  transport.back_share = header.back_share;
  transport.seed = header.seed;
  transport.hits.resize(header.surfels * header.rays);
  transport.sky.resize(header.surfels * kSkyTerms);
  file.read_at(sizeof header, transport.hits.data(), transport.hits.size() * 4);
  file.read_at(sizeof header + transport.hits.size() * 4, transport.sky.data(), transport.sky.size() * 4);
  if (header.crc != crc32c(transport.sky.data(), transport.sky.size() * 4, crc32c(transport.hits.data(), transport.hits.size() * 4)))
    throw Error(concat(path.string(), ": checksum is wrong"));
  for (const std::uint32_t h : transport.hits)
    if (h != Transport::kSky && h >= header.surfels) throw Error(concat(path.string(), ": hit ", h, " beyond ", header.surfels, " surfels"));
  return transport;
}

}  // namespace chiaro::optimize
