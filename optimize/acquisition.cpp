#include "optimize/acquisition.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "optimize/adam.h"
#include "optimize/exposure.h"
#include "optimize/fields.h"
#include "optimize/photo_band.h"
#include "optimize/proxy_file.h"
#include "optimize/radiosity.h"
#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

constexpr int kFirstSweeps = 14, kLaterSweeps = 4;
constexpr double kSweepTolerance = 1e-5, kOuterTolerance = 3e-5, kSettled = 1e-3;
/// Pairs of one photograph overlap and texture is not noise: a fiftieth of their information counts as independent.
constexpr double kPairInformation = 0.02;
/// Of the factor on gathered light, by where the normals come from (measured at the true flash: 0 to 3 % and 3 to 5 %).
constexpr double kBounceSdGiven = 0.03, kBounceSdEstimated = 0.05;
constexpr double kGuessSd = 0.35;   // of ln flash, around the guess that the brightest surfels reflect 80 %

std::filesystem::path observation_path(const std::filesystem::path& folder, std::size_t k) { return folder / concat("observation_", k, ".bin"); }

surfels::Tracer make_tracer(const stream::Store& store, const Proxy& proxy, MemoryBudget& budget) {
  surfels::Tracer tracer(proxy.origin_in_world, budget);
  for (const std::uint32_t c : proxy.chunks) tracer.add(store.read_chunk(c));
  tracer.commit();
  return tracer;
}

std::vector<surfels::View> views_of(const AcquisitionInput& input) {
  std::vector<surfels::View> views;
  for (const ObserveInput& p : input.photographs)
    views.push_back({p.camera.lens, p.camera.pose, {0, 0, p.camera.lens.width_px, p.camera.lens.height_px}, {}});
  return views;
}

std::optional<Vec3d> flash_in_world(const AcquisitionInput& input, std::size_t k) {
  const ObserveInput& p = input.photographs[k];
  if (!p.flash_in_camera) return std::nullopt;
  return p.camera.pose.world_from_camera(*p.flash_in_camera);
}

/// The lights as a photograph of another exposure has them.
Lights exposed(Lights lights, double ambient_scale) {
  for (double& s : lights.sky) s *= ambient_scale;
  return lights;
}

LightSample sample_of(const Transport& transport, const Observation& o, const std::vector<float>& gathered, std::size_t i) {
  LightSample s;
  for (std::size_t c = 0; c < 3; ++c) {
    s.radiosity[c] = o.radiosity[3 * i + c];
    s.gathered[c] = gathered[3 * i + c];
  }
  s.flash = o.flash[i];
  for (std::size_t k = 0; k < kSkyTerms; ++k) s.sky[k] = transport.sky[i * kSkyTerms + k];
  if (!transport.hidden.empty())
    for (std::size_t k = 0; k < kSkyTerms; ++k) s.hidden[k] = transport.hidden[i * kSkyTerms + k];
  if (!o.floor_flash.empty()) s.floor_flash = o.floor_flash[i];
  s.variance = o.variance[i];
  s.spread = o.spread[i];
  s.tan_flash = o.tan_flash[i];
  return s;
}

/// Surfels that stand for the acquisition in the light solve: seen `at_least` times, chosen by hash so that the choice is even and repeatable.
std::vector<std::uint32_t> choose_surfels(const std::vector<std::uint16_t>& times_seen, int at_least, std::size_t count, std::uint64_t seed) {
  std::vector<std::pair<float, std::uint32_t>> order;
  for (std::size_t i = 0; i < times_seen.size(); ++i)
    if (times_seen[i] >= at_least) order.emplace_back(uniform01(seed, Purpose::kSampleChoice, i, 0), static_cast<std::uint32_t>(i));
  std::sort(order.begin(), order.end());
  if (order.size() > count) order.resize(count);
  std::vector<std::uint32_t> chosen;
  for (const auto& [hash, i] : order) chosen.push_back(i);
  std::sort(chosen.begin(), chosen.end());
  return chosen;
}

/// Two surfels of one photograph that probably share their albedo.
struct Pair {
  std::uint32_t a, b;
  float trust;
};

float chroma_distance(const Observation& o, std::size_t a, std::size_t b) {
  const auto chroma = [&](std::size_t i) {
    const Vec3f c(o.radiosity[3 * i], o.radiosity[3 * i + 1], o.radiosity[3 * i + 2]);
    return Vec3f(c / c.sum());
  };
  return (chroma(a) - chroma(b)).norm();
}

/// Pairs at several scales: a surfel and the seen surfel nearest to a point some way along the surface.
std::vector<Pair> choose_pairs(const Scene& scene, const Observation& o, std::size_t count, std::uint64_t seed) {
  const Proxy& proxy = scene.proxy;
  std::vector<std::uint16_t> seen(o.seen.begin(), o.seen.end());
  const std::vector<std::uint32_t> starts = choose_surfels(seen, 1, count, seed);
  constexpr float kScales[] = {4, 12, 36, 108, 324};
  constexpr float kChromaSigma = 0.02f;
  std::vector<std::vector<Pair>> found(starts.size());
  parallel_blocks(starts.size(), 256, [&](std::size_t b, std::size_t e) {
    for (std::size_t s = b; s < e; ++s) {
      const std::uint32_t i = starts[s];
      for (std::size_t scale = 0; scale < std::size(kScales); ++scale) {
        const auto u = uniform01x4(seed, Purpose::kPairChoice, i, static_cast<std::uint32_t>(scale));
        const float z = 2 * u[0] - 1, r = std::sqrt(std::max(0.0f, 1 - z * z)), phi = 6.2831853f * u[1];
        Vec3f direction(r * std::cos(phi), r * std::sin(phi), z);
        std::uint32_t j;
        float d2;
        if (scene.nearest->find(proxy.position[i] + direction * (kScales[scale] * proxy.radius[i]), 1, &j, &d2) == 0 || j == i || !o.seen[j]) continue;
        const float chroma = chroma_distance(o, i, j);
        const float trust = std::exp(-0.5f * chroma * chroma / (kChromaSigma * kChromaSigma));
        if (trust > 0.01f) found[s].push_back({i, j, trust});
      }
    }
  });
  std::vector<Pair> pairs;
  for (const auto& f : found) pairs.insert(pairs.end(), f.begin(), f.end());
  return pairs;
}

bool inside(const std::vector<Vec2d>& polygon, const Vec2d& p) {
  bool in = false;
  for (std::size_t i = 0, j = polygon.size() - 1; i < polygon.size(); j = i++) {
    const Vec2d &a = polygon[i], &b = polygon[j];
    if ((a.y() > p.y()) != (b.y() > p.y()) && p.x() < (b.x() - a.x()) * (p.y() - a.y()) / (b.y() - a.y()) + a.x()) in = !in;
  }
  return in;
}

/// The mean over the pixels of a target; what is gathered comes from the proxy around its middle.
struct ReferenceReading {
  ReferenceSample reference;
  Stencil stencil;
  std::size_t photograph;
};

std::optional<ReferenceReading> read_reference(const Scene& scene, const AcquisitionInput& input, const ReferenceTarget& target) {
  const ObserveInput& photo = input.photographs[target.photograph];
  const stream::RasterReader radiance(photo.radiance), gbuffer(photo.gbuffer);
  double y0 = 1e9, y1 = -1e9, x0 = 1e9, x1 = -1e9;
  for (const Vec2d& p : target.polygon) {
    x0 = std::min(x0, p.x());
    x1 = std::max(x1, p.x());
    y0 = std::min(y0, p.y());
    y1 = std::max(y1, p.y());
  }
  const int first = std::max(0, static_cast<int>(std::floor(y0))), last = std::min(gbuffer.height(), static_cast<int>(std::ceil(y1)));
  const int left = std::max(0, static_cast<int>(std::floor(x0))), right = std::min(gbuffer.width(), static_cast<int>(std::ceil(x1)));
  if (first >= last || left >= right) return std::nullopt;
  const PhotoBand band = read_band(radiance, gbuffer, first, last - first);
  Vec3d colour = Vec3d::Zero();
  double squares = 0;   // of the green channel
  Vec3f point = Vec3f::Zero(), normal = Vec3f::Zero();
  double flash = 0, spread = 0;
  int count = 0;
  for (int y = first; y < last; ++y)
    for (int x = left; x < right; ++x) {
      const std::size_t i = band.at(x, y);
      if (!inside(target.polygon, {x + 0.5, y + 0.5}) || band.mask[i] != 1 || !(band.depth[i] > 0)) continue;
      colour += band.colour(i).cast<double>();
      squares += static_cast<double>(band.g[i]) * static_cast<double>(band.g[i]);
      flash += static_cast<double>(band.flash[i]);
      spread += static_cast<double>(band.spread[i]);
      point += pixel_point(photo.camera, scene.proxy.origin_in_world, x, y, band.depth[i]);
      normal += band.normal(i);
      ++count;
    }
  if (count == 0 || !(colour.minCoeff() > 0)) return std::nullopt;
  ReferenceReading reading;
  reading.photograph = target.photograph;
  reading.reference.albedo = target.albedo;
  // Reading error: a target is even, so what varies over it is light that the model does not follow; its mean is off by about half of that.
  const double green = colour[1] / count, uneven = std::sqrt(std::max(0.0, squares / count - green * green)) / green;
  reading.reference.sigma = std::hypot(target.sigma, 0.005, 0.5 * uneven);
  LightSample& s = reading.reference.sample;
  for (int c = 0; c < 3; ++c) s.radiosity[static_cast<std::size_t>(c)] = static_cast<float>(3.14159265358979 * colour[c] / count);
  s.flash = static_cast<float>(flash / count);
  s.spread = static_cast<float>(spread / count);
  const double mean = colour.mean() / count;
  s.variance = static_cast<float>((photo.noise.gain * mean + photo.noise.read_sigma * photo.noise.read_sigma) / (mean * mean * count));
  const Vec3f middle = point / static_cast<float>(count), n = normal.normalized();
  reading.stencil = stencil_at(scene.proxy, *scene.nearest, middle, n);
  s.sky = interpolate<kSkyTerms>(reading.stencil, scene.transport.sky);
  for (float& t : s.sky) t *= static_cast<float>(photo.ambient_scale);
  if (scene.floor) {
    s.hidden = interpolate<kSkyTerms>(reading.stencil, scene.transport.hidden);
    for (float& t : s.hidden) t *= static_cast<float>(photo.ambient_scale);
  }
  if (const auto at = flash_in_world(input, target.photograph)) {
    const Vec3f to_flash = (*at - scene.proxy.origin_in_world).cast<float>() - middle;
    const float cosine = std::max(0.05f, n.dot(to_flash.normalized()));
    s.tan_flash = std::sqrt(std::max(0.0f, 1 - cosine * cosine)) / cosine;
  }
  return reading;
}

LightSolveOptions solve_options(const AcquisitionInput& input, const Lights& start, bool scale_is_given, int sky_terms, bool pairs, double bounce_sd) {
  LightSolveOptions o;
  o.bounce_sd = bounce_sd;
  o.sky_terms = sky_terms;
  if (input.intensity_range) {
    const auto [low, high] = *input.intensity_range;
    o.flash_ln_mean = 0.5 * (std::log(low) + std::log(high));
    o.flash_ln_sd = std::max(1e-4, 0.25 * std::log(high / low));   // the range is +-2 sigma
  }
  // With nothing known, "all light is bounced light between white surfaces" explains any photograph of rough geometry: the guess at the start holds against it.
  if (!input.intensity_range && !scale_is_given) {
    o.flash_ln_mean = std::log(start.flash_intensity);
    o.flash_ln_sd = kGuessSd;
    o.flash_is_guess = true;
  }
  if (pairs) o.information = kPairInformation;
  return o;
}

Lights start_lights(const AcquisitionInput& input, int sky_terms) {
  Lights x;
  x.flash_intensity = input.intensity_range ? std::sqrt((*input.intensity_range)[0] * (*input.intensity_range)[1]) : 1.0;
  if (sky_terms > 0) x.sky[0] = 0.01 * x.flash_intensity / 4;
  return x;
}

/// A flash of unknown strength starts where the brightest surfels have albedo 0.8: only the scale, never a result. A surfel's brightness is its geometric mean
/// over the photographs, so that highlights, which move, count little.
void guess_flash(const Scene& scene, const AcquisitionInput& input, const std::filesystem::path& folder, Lights& lights) {
  if (input.intensity_range) return;
  const std::size_t n = scene.proxy.size();
  if (n == 0) return;
  std::vector<float> ln_sum(n, 0.0f);
  std::vector<std::uint16_t> times(n, 0);
  for (std::size_t k = 0; k < input.photographs.size(); ++k) {
    const Observation o = read_observation(observation_path(folder, k), n);
    for (std::size_t i = 0; i < n; ++i) {
      if (!o.seen[i] || !(o.flash[i] > 0) || !(o.radiosity[3 * i + 1] > 0)) continue;
      ln_sum[i] += std::log(o.radiosity[3 * i + 1] / o.flash[i]);
      ++times[i];
    }
  }
  const std::uint16_t least = *std::max_element(times.begin(), times.end()) >= 2 ? 2 : 1;
  std::vector<float> ratios;
  for (std::size_t i = 0; i < n; ++i)
    if (times[i] >= least) ratios.push_back(std::exp(ln_sum[i] / static_cast<float>(times[i])));
  if (ratios.empty()) return;
  const auto at = ratios.begin() + static_cast<std::ptrdiff_t>(ratios.size() * 95 / 100);
  std::nth_element(ratios.begin(), at, ratios.end());
  lights.flash_intensity = std::max(1e-9, static_cast<double>(*at) / 0.8);
  lights.sky[0] = std::min(lights.sky[0], 0.0025 * lights.flash_intensity);
}

/// How the ambient light is described.
struct SkyShape {
  int terms = 1;           ///< 0, 1, 4 or 9
  bool coloured = false, floor = false;
  std::string name() const {
    const char* shape = terms == 0 ? "none" : terms == 1 ? "uniform" : terms == 4 ? "sh1" : "sh2";
    return std::string(shape) + (coloured ? " coloured" : "") + (floor ? " + floor" : "");
  }
  int parameters() const { return terms + (coloured ? 2 : 0) + (floor ? 1 : 0); }
};

SkyShape sky_shape(SkyModel model) {
  switch (model) {
    case SkyModel::kNone: return {0};
    case SkyModel::kUniform:
    case SkyModel::kAuto: return {1};
    case SkyModel::kSh1: return {4};
    case SkyModel::kSh2: return {9};
  }
  return {1};
}

/// Mean log albedo of every surfel over the photographs that see it.
struct AlbedoMean {
  std::vector<float> weight, sum;   ///< N, 3 N
  explicit AlbedoMean(std::size_t n) : weight(n, 0.0f), sum(3 * n, 0.0f) {}

  void add(const Transport& transport, const Observation& o, const std::vector<float>& g, const Lights& lights) {
    parallel_blocks(weight.size(), 4096, [&](std::size_t b, std::size_t e) {
      for (std::size_t i = b; i < e; ++i) {
        if (!o.seen[i]) continue;
        const LightSample s = sample_of(transport, o, g, i);
        const float w = static_cast<float>(sample_weight(lights, s));
        double ln[3];
        bool fine = true;
        for (int c = 0; c < 3; ++c) {
          const double h = irradiance(lights, s, c);
          fine = fine && h > 0 && s.radiosity[static_cast<std::size_t>(c)] > 0;
          ln[c] = fine ? std::log(static_cast<double>(s.radiosity[static_cast<std::size_t>(c)]) / h) : 0;
        }
        if (!fine) continue;
        weight[i] += w;
        for (std::size_t c = 0; c < 3; ++c) sum[3 * i + c] += w * static_cast<float>(ln[c]);
      }
    });
  }

  /// Unseen surfels take the albedo of the nearest seen one (physics.md A.4; the median instead costs 5 % of the flash).
  std::vector<float> albedo(const std::vector<std::uint32_t>& nearest_seen) const {
    std::vector<float> out(sum.size());
    for (std::size_t i = 0; i < weight.size(); ++i) {
      const std::size_t j = weight[i] > 0 || nearest_seen.empty() ? i : nearest_seen[i];
      for (std::size_t c = 0; c < 3; ++c) out[3 * i + c] = weight[j] > 0 ? std::clamp(std::exp(sum[3 * j + c] / weight[j]), 0.0f, 0.98f) : 0.3f;
    }
    return out;
  }
};

std::vector<std::uint32_t> nearest_seen_surfels(const Proxy& proxy, const std::vector<std::uint16_t>& times_seen) {
  std::vector<Vec3f> points;
  std::vector<std::uint32_t> ids;
  for (std::size_t i = 0; i < times_seen.size(); ++i)
    if (times_seen[i] > 0) {
      points.push_back(proxy.position[i]);
      ids.push_back(static_cast<std::uint32_t>(i));
    }
  std::vector<std::uint32_t> result(times_seen.size());
  std::iota(result.begin(), result.end(), 0u);
  if (points.empty()) return {};
  const NearestPoints nearest(points);
  parallel_blocks(times_seen.size(), 2048, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) {
      std::uint32_t j;
      float d2;
      if (times_seen[i] == 0 && nearest.find(proxy.position[i], 1, &j, &d2) == 1) result[i] = ids[j];
    }
  });
  return result;
}

/// How far the lights moved: ln flash, sky relative to the flash, its colour, bounce, the floor's albedo, all of the order of one.
using LightStep = Eigen::Matrix<double, kSkyTerms + 5, 1>;

LightStep light_step(const Lights& from, const Lights& to) {
  LightStep v;
  v[0] = std::log(to.flash_intensity / from.flash_intensity);
  for (std::size_t k = 0; k < kSkyTerms; ++k)
    v[1 + static_cast<Eigen::Index>(k)] = to.sky[k] / to.flash_intensity - from.sky[k] / from.flash_intensity;
  v[kSkyTerms + 1] = to.sky_colour[0] - from.sky_colour[0];
  v[kSkyTerms + 2] = to.sky_colour[2] - from.sky_colour[2];
  v[kSkyTerms + 3] = to.bounce - from.bounce;
  v[kSkyTerms + 4] = to.floor_albedo - from.floor_albedo;
  return v;
}

double light_change(const Lights& a, const Lights& b) {
  return std::fabs(std::log(b.flash_intensity / a.flash_intensity)) + std::fabs(b.bounce - a.bounce) + std::fabs(b.floor_albedo - a.floor_albedo) + std::fabs(b.sky_colour[0] - a.sky_colour[0]) + std::fabs(b.sky_colour[2] - a.sky_colour[2]) +
         std::fabs(b.sky[0] - a.sky[0]) / std::max(1e-9, b.sky[0] + 0.01 * b.flash_intensity);
}

/// Share of the new state that the next iteration starts from, by how the last step answered the one before: a step that turns back asks for less.
/// source: Irons & Tuck, "A version of the Aitken accelerator for computer iteration", Int. J. Numer. Meth. Engng 1, 1969, in its vector form.
class Relaxation {
 public:
  double share() const { return share_; }
  void observe(const LightStep& step) {
    if (const double squares = last_.squaredNorm(); squares > 0) share_ = std::clamp(share_ / std::max(1e-9, 1 - step.dot(last_) / squares), kLeast, 1.0);
    last_ = step;
  }

 private:
  static constexpr double kLeast = 0.2;
  LightStep last_ = LightStep::Zero();
  double share_ = 1;
};

/// share of `values`, the rest of `before`.
void blend_into(std::vector<float>& values, const std::vector<float>& before, double share) {
  const float s = static_cast<float>(share);
  parallel_blocks(values.size(), 65536, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) values[i] = before[i] + s * (values[i] - before[i]);
  });
}

/// One set of photographs that share their lights: the whole acquisition, or a single photograph.
class LightProblem {
 public:
  LightProblem(const Scene& scene, const Smoother& smoother, const AcquisitionInput& input, const AcquisitionOptions& options, std::vector<std::size_t> photographs,
               const std::filesystem::path& folder, double bounce_sd)
      : bounce_sd_(bounce_sd), scene_(scene), smoother_(smoother), input_(input), options_(options), photographs_(std::move(photographs)), folder_(folder), times_seen_(scene.proxy.size(), 0), exposures_(input.photographs.size(), 1.0) {
    for (const std::size_t k : photographs_) {
      const Observation o = read(k);
      for (std::size_t i = 0; i < times_seen_.size(); ++i) times_seen_[i] = static_cast<std::uint16_t>(times_seen_[i] + o.seen[i]);
    }
    nearest_seen_ = nearest_seen_surfels(scene.proxy, times_seen_);
    use_pairs_ = photographs_.size() == 1;
    if (use_pairs_) {
      pairs_ = choose_pairs(scene, read(photographs_[0]), options.light_samples / 4, options.seed);
    } else {
      chosen_ = choose_surfels(times_seen_, 2, options.light_samples, options.seed);
    }
    for (const ReferenceTarget& t : input.references)
      if (std::find(photographs_.begin(), photographs_.end(), t.photograph) != photographs_.end())
        if (auto reading = read_reference(scene, input, t)) references_.push_back(*reading);
  }

  const std::vector<std::uint16_t>& times_seen() const { return times_seen_; }
  std::size_t num_references() const { return references_.size(); }

  /// Alternates between what unseen surfels radiate and the lights until nothing moves. Plain alternation overshoots where unseen surfaces give most of the light (in a
  /// closed room it ends in a cycle), so the step is relaxed.
  LightSolution solve(SkyShape sky, const Lights& start, int& outer, double& change, Reporter& report) {
    sky_ = sky;
    bool choose_sky = !richer_skies(sky).empty();
    LightSolution solution;
    solution.lights = start;
    std::vector<float> albedo(3 * scene_.proxy.size(), 0.3f);
    Relaxation relaxation;
    int most = options_.outer_iterations;
    for (outer = 0; outer < most; ++outer) {
      report.check();
      sweep(solution.lights, albedo, outer < 2 ? kFirstSweeps : kLaterSweeps, relaxation.share());
      const Lights before = solution.lights;
      const LightSolveOptions light_options = current_options(start);
      solution = solve_lights(samples_, current_references(), light_options, before);
      if (outer == kBounceCheck && !without_bounces_) check_bounces(light_options, solution);
      change = light_change(before, solution.lights);
      report.progress(static_cast<std::uint64_t>(std::min(outer + 1, options_.outer_iterations)));
      const bool settled = outer > kBounceCheck && change < kOuterTolerance;
      const bool evened = exposure_rounds_ < kExposureRounds && outer > kBounceCheck && change < kSettled && even_exposures(solution.lights);
      bool chose = false, richer = false;
      if (!evened && choose_sky && (change < kSettled || outer + 1 == most) && outer > kBounceCheck) {
        choose_sky = false;
        chose = true;
        richer = choose_richer_sky(start, solution);
      }
      albedo = mean_albedo(solution.lights);
      if (!evened && settled && !richer) break;
      if (evened || chose) most = outer + 1 + options_.outer_iterations;
      if (!evened && outer > 0) relaxation.observe(light_step(before, solution.lights));
    }
    solution.converged = solution.converged && change < kSettled;
    // With the lights final: the gathered light that the albedo stage reads.
    sweep(solution.lights, albedo, kFirstSweeps, relaxation.share());
    albedo_ = mean_albedo(solution.lights);
    return solution;
  }

  /// Of the photographs of the input: factors that were taken out.
  const std::vector<double>& exposures() const { return exposures_; }
  SkyShape sky() const { return sky_; }
  const std::vector<SkyEvidence>& sky_evidence() const { return sky_evidence_; }
  const std::vector<float>& albedo() const { return albedo_; }
  bool without_bounces() const { return without_bounces_; }

 private:
  static constexpr int kExposureRounds = 4;     ///< each one sees what the lights had taken for their own before
  static constexpr int kTrialIterations = 15;   ///< from a settled start: enough to compare models
  static constexpr int kBounceCheck = 2;   ///< outer iteration after which the alternative is tried

  /// Takes the factor of brightness out of photographs that are clearly off. Returns whether there were any.
  bool even_exposures(const Lights& lights) {
    ++exposure_rounds_;
    if (use_pairs_) return false;
    const std::vector<double> found = unlike_exposures(samples_, lights, exposures_);
    bool any = false;
    for (const std::size_t k : photographs_) {
      if (std::fabs(std::log(found[k])) < kSettled) continue;
      any = true;
      exposures_[k] *= found[k];
      const float factor = static_cast<float>(1 / found[k]);
      Observation o = read(k);
      for (std::size_t i = 0; i < o.seen.size(); ++i)
        for (std::size_t c = 3 * i; o.seen[i] && c < 3 * i + 3; ++c) o.radiosity[c] *= factor;
      write_observation(o, observation_path(folder_, k));
      for (ReferenceReading& r : references_)
        if (r.photograph == k)
          for (float& b : r.reference.sample.radiosity) b *= factor;
    }
    return any;
  }

  std::vector<SkyShape> richer_skies(const SkyShape& plain) const {
    std::vector<SkyShape> shapes{plain};
    if (input_.sky == SkyModel::kAuto) shapes.insert(shapes.end(), {{1, true}, {4, false}, {4, true}, {9, false}, {9, true}});
    std::vector<SkyShape> candidates(shapes.begin() + 1, shapes.end());
    if (scene_.floor && input_.try_floor)
      for (SkyShape s : shapes) {
        s.floor = true;
        candidates.push_back(s);
      }
    return candidates;
  }

  LightSolveOptions current_options(const Lights& start) const {
    LightSolveOptions o = solve_options(input_, start, !references_.empty(), sky_.terms, use_pairs_, bounce_sd_);
    o.sky_colour = sky_.coloured;
    o.floor = sky_.floor;
    if (without_bounces_) o.bounce_mean = o.bounce_sd = 0;
    return o;
  }

  /// Tries richer models of the ambient light on what is gathered now, and takes the one with the smallest Bayesian information criterion: misfit, and
  /// ln(residuals) / 2 for each parameter. One photograph supports none (physics.md E.4). Returns whether the model has changed.
  bool choose_richer_sky(const Lights& start, LightSolution& solution) {
    if (use_pairs_) return false;
    const SkyShape plain = sky_;
    const LightSolveOptions plain_options = current_options(start);
    const Lights base = solution.lights;
    const double price = std::log(std::max(2.0, independent_residuals(samples_, plain_options))), reference = 2 * light_misfit(samples_, plain_options, base, base) + price * plain.parameters();
    SkyShape best = plain;
    double least = 0;
    sky_evidence_ = {{plain.name(), plain.parameters(), 0}};
    for (const SkyShape& candidate : richer_skies(plain)) {
      sky_ = candidate;
      LightSolveOptions candidate_options = current_options(start);
      candidate_options.max_iterations = kTrialIterations;
      const LightSolution tried = solve_lights(samples_, current_references(), candidate_options, base);
      const double criterion = 2 * light_misfit(samples_, plain_options, tried.lights, base) + price * candidate.parameters() - reference;
      sky_evidence_.push_back({candidate.name(), candidate.parameters(), criterion});
      if (!(criterion < least)) continue;
      least = criterion;
      best = candidate;
      solution = tried;
    }
    sky_ = best;
    return best.name() != plain.name();
  }

  /// Photographs may hold no interreflection at all (they were corrected before, or composed). If leaving it out explains them far better, it is left out.
  void check_bounces(const LightSolveOptions& options, LightSolution& solution) {
    LightSolveOptions no_bounces = options;
    no_bounces.bounce_mean = no_bounces.bounce_sd = 0;
    Lights start = solution.lights;
    start.bounce = 0;
    // References do not take part: one that is misread must not decide.
    const LightSolution without = solve_lights(samples_, {}, no_bounces, start);
    const double with = references_.empty() ? solution.scatter : solve_lights(samples_, {}, options, solution.lights).scatter;
    constexpr double kClearly = 0.8;
    if (without.scatter > kClearly * with) return;
    without_bounces_ = true;
    solution = references_.empty() ? without : solve_lights(samples_, current_references(), no_bounces, start);
  }

  double ambient_scale(std::size_t k) const { return input_.photographs[k].ambient_scale; }

  void add_sample(std::size_t k, const Observation& o, const std::vector<float>& g, std::size_t i, std::uint32_t group) {
    LightSample s = sample_of(scene_.transport, o, g, i);
    s.group = group;
    s.photograph = static_cast<std::uint32_t>(k);
    s.flash_photograph = input_.photographs[k].flash_in_camera.has_value();
    for (float& t : s.sky) t *= static_cast<float>(ambient_scale(k));
    for (float& t : s.hidden) t *= static_cast<float>(ambient_scale(k));
    samples_.push_back(s);
  }

  Observation read(std::size_t k) const {
    Observation o = read_observation(observation_path(folder_, k), scene_.proxy.size());
    if (scene_.floor && input_.photographs[k].flash_in_camera) o.floor_flash = read_floats(floor_flash_path(folder_, k), scene_.proxy.size());
    return o;
  }

  /// One pass over the photographs: completes their radiosity under the lights (`share` of it new) and refreshes the samples.
  void sweep(const Lights& lights, const std::vector<float>& albedo, int max_sweeps, double share) {
    samples_.clear();
    for (const std::size_t k : photographs_) {
      Observation o = read(k);
      std::vector<float> before;
      if (share < 1) before = o.radiosity;
      std::vector<float> g = complete_radiosity(scene_.transport, smoother_, kSmoothPasses, exposed(lights, ambient_scale(k)), albedo, o, max_sweeps, kSweepTolerance);
      if (share < 1) {   // gathering is linear: what holds for the radiosity holds for G
        blend_into(o.radiosity, before, share);
        blend_into(g, read_floats(gathered_path(folder_, k), g.size()), share);
      }
      if (use_pairs_) {
        for (std::size_t p = 0; p < pairs_.size(); ++p)
          for (const std::uint32_t i : {pairs_[p].a, pairs_[p].b}) {
            add_sample(k, o, g, i, static_cast<std::uint32_t>(p));
            samples_.back().trust = pairs_[p].trust;
          }
      } else {
        for (const std::uint32_t i : chosen_)
          if (o.seen[i]) add_sample(k, o, g, i, i);
      }
      for (ReferenceReading& r : references_)
        if (r.photograph == k) {
          r.reference.sample.gathered = interpolate<3>(r.stencil, g);
          if (!o.floor_flash.empty()) r.reference.sample.floor_flash = interpolate<1>(r.stencil, o.floor_flash)[0];
        }
      write_observation(o, observation_path(folder_, k));
      write_floats(g, gathered_path(folder_, k));
    }
    std::stable_sort(samples_.begin(), samples_.end(), [](const LightSample& a, const LightSample& b) { return a.group < b.group; });
  }

  /// The albedo that the photographs have under these lights, with the light gathered last: what unseen surfels radiate must not lag behind the lights by a step,
  /// or the iteration overshoots.
  std::vector<float> mean_albedo(const Lights& lights) const {
    AlbedoMean mean(scene_.proxy.size());
    for (const std::size_t k : photographs_) mean.add(scene_.transport, read(k), read_floats(gathered_path(folder_, k), 3 * scene_.proxy.size()), exposed(lights, ambient_scale(k)));
    return mean.albedo(nearest_seen_);
  }

  std::vector<ReferenceSample> current_references() const {
    std::vector<ReferenceSample> r;
    for (const ReferenceReading& reading : references_) r.push_back(reading.reference);
    return r;
  }

  const double bounce_sd_;
  const Scene& scene_;
  const Smoother& smoother_;
  const AcquisitionInput& input_;
  const AcquisitionOptions& options_;
  const std::vector<std::size_t> photographs_;
  const std::filesystem::path folder_;
  std::vector<std::uint16_t> times_seen_;
  std::vector<double> exposures_;
  std::vector<std::uint32_t> nearest_seen_, chosen_;
  std::vector<Pair> pairs_;
  std::vector<ReferenceReading> references_;
  std::vector<LightSample> samples_;
  std::vector<float> albedo_;
  SkyShape sky_;
  std::vector<SkyEvidence> sky_evidence_;
  int exposure_rounds_ = 0;
  bool use_pairs_ = false, without_bounces_ = false;
};

/// The paper's solver on one photograph; its lights and the light it gathers from its own albedo.
LightSolution solve_with_adam(const Scene& scene, const Smoother& smoother, const AcquisitionInput& input, std::size_t k, const std::filesystem::path& folder,
                              std::vector<float>& albedo, Reporter& report) {
  const Observation o = read_observation(observation_path(folder, k), scene.proxy.size());
  if (!input.intensity_range) throw UsageError("solve.method = \"adam\" searches the flash in its calibrated range: acquisition.flash.intensity_range is missing");
  const AdamOptions options;
  const AdamResult result = solve_adam(scene.transport, o, *input.intensity_range, options, report);
  LightSolution solution;
  solution.lights.flash_intensity = result.state.flash_intensity;
  solution.lights.sky[0] = result.state.ambient;
  solution.scale_known = true;
  solution.converged = true;
  solution.iterations = options.search_steps * options.search_iterations + options.iterations;
  // The solver reports no uncertainty of its own: the calibrated interval is all that is known about its lights.
  const double sd = 0.25 * std::log((*input.intensity_range)[1] / (*input.intensity_range)[0]);
  solution.sky_terms = 1;
  solution.covariance = Eigen::MatrixXd::Zero(3, 3);
  solution.covariance(0, 0) = sd * sd;
  const std::vector<float> direct = direct_irradiance(scene.transport, o.flash, {}, solution.lights);
  const std::vector<float> b = forward_radiosity(scene.transport, result.state.albedo, direct, 1, options.scatterings);
  std::vector<float> g;
  gather_radiosity(scene.transport, b, g);
  smoother.apply(g, 3, kSmoothPasses);
  write_floats(g, gathered_path(folder, k));
  albedo = result.state.albedo;
  return solution;
}

}  // namespace

std::filesystem::path floor_flash_path(const std::filesystem::path& folder, std::size_t k) { return folder / concat("floor_", k, ".bin"); }
std::filesystem::path gathered_path(const std::filesystem::path& folder, std::size_t k) { return folder / concat("gathered_", k, ".bin"); }
std::filesystem::path proxy_albedo_path(const std::filesystem::path& folder) { return folder / "albedo.bin"; }

std::uint64_t proxy_surfels_within(std::uint64_t bytes, int rays) {
  // hits, sky, floor, smoother, kd-tree, geometry, blocks and tree, one observation, gathered light, means, samples
  const std::uint64_t per_surfel = static_cast<std::uint64_t>(rays) * 4 + 36 + 36 + 4 + 128 + 24 + 33 + 20 + 58 + 24 + 40 + 40;
  return bytes / per_surfel;
}

namespace {

/// What the cloud can see of a floor below this share does not matter.
constexpr float kLeastFloorShare = 0.005f;

void write_floor_of(const Proxy& proxy, const Transport& transport, const Smoother& smoother, const AcquisitionInput& input, const std::filesystem::path& path) {
  std::optional<Floor> floor;
  std::vector<float> hidden;
  if (input.floor_plane) {
    const Vec3d n((*input.floor_plane)[0], (*input.floor_plane)[1], (*input.floor_plane)[2]);
    floor = Floor{n.normalized().cast<float>(), static_cast<float>((*input.floor_plane)[3] / n.norm() - n.normalized().dot(proxy.origin_in_world))};
  } else if (input.try_floor) {
    std::vector<Mat3d> rotations;
    for (const ObserveInput& p : input.photographs) rotations.push_back(p.camera.pose.rotation_camera_from_world);
    floor = find_floor(proxy, rotations);
  }
  if (floor) {
    hidden = hidden_by_floor(proxy, transport, smoother, *floor);
    double mean = 0;
    for (std::size_t i = 0; i < proxy.size(); ++i) mean += static_cast<double>(hidden[i * kSkyTerms]) / (3.14159265 * static_cast<double>(proxy.size()));
    if (mean < static_cast<double>(kLeastFloorShare)) floor.reset();
  }
  write_floor(floor, hidden, path);
}

}  // namespace

void gather_scene(const stream::Store& store, const AcquisitionInput& input, const AcquisitionOptions& options, const std::filesystem::path& folder,
                  MemoryBudget& budget, Reporter& report) {
  const std::uint64_t most = std::min<std::uint64_t>(options.max_proxy_surfels, proxy_surfels_within(budget.free_bytes() * 3 / 4, options.rays));
  const auto views = views_of(input);
  Proxy proxy = load_proxy(store, surfels::select_proxy(store, views, std::min(options.proxy_surfels, most), most));
  const BudgetLease lease(budget, proxy.size() * (static_cast<std::uint64_t>(options.rays) * 4 + 300), "light transport");
  const NearestPoints nearest(proxy.position);
  std::vector<float> votes(proxy.size(), 0.0f);
  for (const ObserveInput& photo : input.photographs) {
    const std::vector<float> v = visibility_votes(proxy, photo);
    for (std::size_t i = 0; i < votes.size(); ++i) votes[i] += v[i];
    report.check();
  }
  orient(proxy, votes, nearest);
  const Smoother smoother = make_smoother(proxy, nearest);
  const surfels::Tracer tracer = make_tracer(store, proxy, budget);
  const Transport transport = gather(proxy, tracer, smoother, {options.rays, options.seed, kSmoothPasses}, report);
  write_proxy(proxy, store.manifest().key, folder / "proxy.bin");
  write_transport(transport, folder / "transport.bin");
  write_floor_of(proxy, transport, smoother, input, folder / "floor.bin");
}

Scene load_scene(const stream::Store& store, const std::filesystem::path& folder) {
  Scene scene;
  scene.proxy = read_proxy(store, folder / "proxy.bin");
  scene.transport = read_transport(folder / "transport.bin", scene.proxy.size());
  scene.floor = read_floor(folder / "floor.bin", scene.proxy.size(), scene.transport.hidden);
  scene.nearest = std::make_unique<NearestPoints>(scene.proxy.position);
  return scene;
}

AcquisitionResult solve_acquisition(const stream::Store& store, const Scene& scene, const AcquisitionInput& input, const AcquisitionOptions& options,
                                    const std::filesystem::path& folder, MemoryBudget& budget, Reporter& report) {
  AcquisitionResult result;
  const std::size_t count = input.photographs.size();
  result.proxy_surfels = scene.proxy.size();
  result.back_share = scene.transport.back_share;
  const Smoother smoother = make_smoother(scene.proxy, *scene.nearest);
  {
    const surfels::Tracer tracer = make_tracer(store, scene.proxy, budget);
    report.begin("observe", count, "photographs");
    for (std::size_t k = 0; k < count; ++k) {
      Observation o = observe(scene.proxy, input.photographs[k]);
      if (const auto flash = flash_in_world(input, k)) {
        cast_flash(scene.proxy, tracer, *flash, o);
        if (scene.floor) write_floats(flash_by_floor(scene.proxy, scene.transport, smoother, tracer, *scene.floor, *flash), floor_flash_path(folder, k));
      }
      write_observation(o, observation_path(folder, k));
      report.progress(k + 1);
      report.check();
    }
    report.end();
  }
  result.light_of_photograph.assign(count, 0);
  result.exposures.assign(count, 1.0);
  std::vector<std::size_t> with_flash, without_flash;
  for (std::size_t k = 0; k < count; ++k) (input.photographs[k].flash_in_camera ? with_flash : without_flash).push_back(k);
  const SkyShape sky = sky_shape(input.sky);
  result.sky_model = sky.name();
  std::vector<float> albedo(3 * scene.proxy.size(), 0.3f);
  if (input.method == Method::kAdam) {
    for (const std::size_t k : with_flash) {
      result.light_of_photograph[k] = result.lights.size();
      result.lights.push_back(solve_with_adam(scene, smoother, input, k, folder, albedo, report));
    }
  } else if (input.method == Method::kDirect) {
    LightSolution solution;
    solution.lights = start_lights(input, 0);
    guess_flash(scene, input, folder, solution.lights);
    solution.scale_known = input.intensity_range.has_value();
    solution.covariance = Eigen::MatrixXd::Zero(2, 2);
    if (input.intensity_range) solution.covariance(0, 0) = std::pow(0.25 * std::log((*input.intensity_range)[1] / (*input.intensity_range)[0]), 2);
    result.lights.push_back(solution);
  } else {
    std::vector<std::vector<std::size_t>> problems;
    if (input.method == Method::kJoint) {
      problems.emplace_back(count);
      std::iota(problems[0].begin(), problems[0].end(), std::size_t{0});
    } else {
      for (const std::size_t k : with_flash) {
        problems.push_back({k});
        problems.back().insert(problems.back().end(), without_flash.begin(), without_flash.end());
      }
    }
    for (const auto& photographs : problems) {
      LightProblem problem(scene, smoother, input, options, photographs, folder, store.manifest().normals_from_file ? kBounceSdGiven : kBounceSdEstimated);
      Lights start = start_lights(input, sky.terms);
      guess_flash(scene, input, folder, start);
      report.begin(problems.size() > 1 ? concat("light ", input.names[photographs[0]]) : "light", static_cast<std::uint64_t>(options.outer_iterations), "iterations");
      const std::size_t number = result.lights.size();
      result.lights.push_back(problem.solve(sky, start, result.outer_iterations, result.last_change, report));
      report.end();
      for (const std::size_t k : photographs)
        if (number == 0 || input.photographs[k].flash_in_camera) result.light_of_photograph[k] = number;
      for (const std::size_t k : photographs)
        if (problem.exposures()[k] != 1) result.exposures[k] = problem.exposures()[k];
      result.sky_model = problem.sky().name();
      result.sky_evidence = problem.sky_evidence();
      albedo = problem.albedo();
      if (!result.lights.back().converged)
        result.notes.push_back(concat(input.names[photographs[0]], photographs.size() > 1 ? " and the others of the acquisition" : "", ": the lights had not settled after ", result.outer_iterations,
                                      " iterations, last change ", result.last_change));
      if (problem.without_bounces())
        result.notes.push_back(concat(input.names[photographs[0]], photographs.size() > 1 ? " and the others of the acquisition show" : " shows",
                                      " no interreflection: bounced light was left out"));
      for (const std::uint16_t t : problem.times_seen()) result.proxy_seen += t > 0;
      if (problem.num_references() < input.references.size() && problems.size() == 1)
        result.notes.push_back(concat(input.references.size() - problem.num_references(), " reference targets cover no usable pixel and were left out"));
    }
  }
  write_floats(albedo, proxy_albedo_path(folder));
  return result;
}

}  // namespace chiaro::optimize
