#include "tools/synth_scene.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <numbers>
#include <stdexcept>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "tools/suggest.h"
#include "tools/synth_surfaces.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {

struct Known {
  const char* name;
  SynthKind kind;
  const char* help;
};
const Known kScenes[] = {
    {"sphere", SynthKind::kSphere, "radius 1 m"},
    {"statue", SynthKind::kStatue, "star-shaped body, 1.8 m high, with folds and cavities"},
    {"wall", SynthKind::kWall, "4 x 3 m of bricks that stand about 12 mm proud of their mortar; faces +z"},
    {"room", SynthKind::kRoom, "inside of a box of 10 x 8 x 4 m with six columns of radius 0.3 m"},
    {"duplicates", SynthKind::kDuplicates, "the sphere with every position many times over"},
    {"outlier", SynthKind::kOutlier, "the statue and a few points far away"},
    {"volume", SynthKind::kVolume, "a filled cube of 1 m: no surface at all"},
    {"line", SynthKind::kLine, "points on a straight line of 100 m"},
};
const std::array<const char*, 2> kParameters[] = {
    {"noise=METRES", "standard deviation along the normal (0)"},
    {"seed=N", "another seed, other points (1)"},
    {"normals=true|false", "write the true normals (true)"},
    {"order=random|scan", "scan: neighbours in the file are neighbours in space (random)"},
    {"scale=FACTOR", "of the whole scene (1)"},
    {"offset=METRES", "added to x and y, a tenth of it to z (0)"},
    {"share=0..1", "duplicates: distinct positions over points (0.01); outlier: outliers over points (1e-6, at least one)"},
    {"distance=METRES", "outlier: from the centre (1000)"},
};

double number(const std::string& key, const std::string& value, double min, double max) {
  double v = 0;
  const auto [end, error] = std::from_chars(value.data(), value.data() + value.size(), v);
  if (error != std::errc() || end != value.data() + value.size() || !(v >= min && v <= max))
    throw UsageError(concat("scene parameter ", key, "=", value, ": expected a number from ", min, " to ", max));
  return v;
}

template <std::size_t N>
std::size_t word(const std::string& key, const std::string& value, const std::array<std::string, N>& words) {
  for (std::size_t i = 0; i < N; ++i)
    if (value == words[i]) return i;
  throw UsageError(concat("scene parameter ", key, "=", value, ": expected ", words[0], " or ", words[1], suggestion(value, std::vector<std::string>(words.begin(), words.end()))));
}

void set(SynthSpec& spec, const std::string& key, const std::string& value) {
  if (key == "noise") spec.noise_m = number(key, value, 0, 1e6);
  else if (key == "seed") {
    const auto [end, error] = std::from_chars(value.data(), value.data() + value.size(), spec.seed);
    if (error != std::errc() || end != value.data() + value.size()) throw UsageError(concat("scene parameter seed=", value, ": expected a whole number"));
  } else if (key == "normals") spec.normals = word<2>(key, value, {"false", "true"}) == 1;
  else if (key == "order") spec.scan_order = word<2>(key, value, {"random", "scan"}) == 1;
  else if (key == "scale") spec.scale = number(key, value, 1e-9, 1e9);
  else if (key == "offset") spec.offset_m = number(key, value, -1e9, 1e9);
  else if (key == "share") spec.share = number(key, value, 0, 1);
  else if (key == "distance") spec.distance_m = number(key, value, 0, 1e12);
  else {
    std::vector<std::string> names;
    for (const auto& p : kParameters) names.push_back(std::string(p[0]).substr(0, std::string_view(p[0]).find('=')));
    throw UsageError(concat("unknown scene parameter \"", key, "\"", suggestion(key, names)));
  }
}

/// Finaliser of a 64-bit mixer: every input bit moves every output bit.
std::uint64_t mix(std::uint64_t v) {
  v = (v ^ (v >> 33)) * 0xff51afd7ed558ccdull;
  v = (v ^ (v >> 33)) * 0xc4ceb9fe1a85ec53ull;
  return v ^ (v >> 33);
}

}  // namespace

SynthSpec parse_synth_spec(const std::string& text) {
  const std::size_t colon = text.find(':');
  const std::string name = text.substr(0, colon);
  SynthSpec spec;
  std::vector<std::string> names;
  bool found = false;
  for (const Known& k : kScenes) {
    names.push_back(k.name);
    if (name != k.name) continue;
    spec.kind = k.kind;
    found = true;
  }
  if (!found) throw UsageError(concat("unknown scene \"", name, "\"", suggestion(name, names)));
  spec.share = spec.kind == SynthKind::kDuplicates ? 0.01 : 1e-6;
  spec.distance_m = 1000;
  for (std::size_t at = colon; at != std::string::npos && at < text.size();) {
    const std::size_t next = text.find(',', at + 1);
    const std::string part = text.substr(at + 1, next == std::string::npos ? next : next - at - 1);
    const std::size_t equals = part.find('=');
    if (equals == std::string::npos) throw UsageError(concat("scene parameter \"", part, "\": expected name=value"));
    set(spec, part.substr(0, equals), part.substr(equals + 1));
    at = next;
  }
  return spec;
}

std::string synth_spec_help() {
  Table table({"", ""}, {Table::Align::kLeft, Table::Align::kLeft});
  for (const Known& k : kScenes) table.row({std::string("  ") + k.name, k.help});
  Table parameters({"", ""}, {Table::Align::kLeft, Table::Align::kLeft});
  for (const auto& p : kParameters) parameters.row({std::string("  ") + p[0], p[1]});
  return concat("Scenes, in metres with z up:\n", table.text(), "Parameters, e.g. statue:noise=0.0005,seed=7,normals=false:\n", parameters.text());
}

Vec3f synth_albedo(const Vec3d& p) {
  const auto wave = [](double angle) { return static_cast<float>(0.45 + 0.30 * std::sin(angle)); };
  return {wave(12 * p.x() + 7 * p.y()), wave(9 * p.y() + 8 * p.z() + 2), wave(11 * p.z() - 6 * p.x() + 4)};
}

// A Feistel network permutes 0 .. 4^half_bits - 1; indices that fall beyond count are sent through again until one does not (at most 4 times on average).
IndexShuffle::IndexShuffle(std::uint64_t count, std::uint64_t seed) : count_(count), seed_(mix(seed + 0x9e3779b97f4a7c15ull)), half_bits_(1) {
  while (half_bits_ < 31 && (std::uint64_t{1} << (2 * half_bits_)) < count) ++half_bits_;
}

std::uint64_t IndexShuffle::operator()(std::uint64_t index) const {
  const std::uint64_t mask = (std::uint64_t{1} << half_bits_) - 1;
  do {
    std::uint64_t left = index >> half_bits_, right = index & mask;
    for (std::uint64_t round = 1; round <= 5; ++round) {
      const std::uint64_t next = left ^ (mix(right + seed_ * round) & mask);
      left = right;
      right = next;
    }
    index = left << half_bits_ | right;
  } while (index >= count_);
  return index;
}

// Scene ----------------------------------------------------------------------------------------------------------------------------

struct SynthScene::Impl {
  /// One cell of a sheet's square: points of sorted number first .. next patch's first lie here.
  struct Patch {
    std::uint64_t first = 0;
    float bound = 0;   ///< of the stretch within
  };

  SynthSpec spec;
  std::uint64_t count = 0;     ///< points
  std::uint64_t on_surface = 0;   ///< of them on the surface, before outliers
  std::uint64_t distinct = 0;  ///< positions on the surface
  std::vector<std::unique_ptr<Sheet>> sheets;
  std::vector<std::size_t> first_patch;   ///< of each sheet
  std::vector<Patch> patches;             ///< and one more, with first = distinct
  double area = 0;             ///< before scale
  IndexShuffle order, copies;

  Impl(const SynthSpec& s, std::uint64_t n) : spec(s), count(n), on_surface(n), distinct(n), order(n, s.seed), copies(1, s.seed) {
    switch (spec.kind) {
      case SynthKind::kSphere: sheets = sphere_sheets(); break;
      case SynthKind::kStatue: sheets = statue_sheets(); break;
      case SynthKind::kWall: sheets = wall_sheets(); break;
      case SynthKind::kRoom: sheets = room_sheets(); break;
      case SynthKind::kDuplicates:
        sheets = sphere_sheets();
        distinct = std::clamp<std::uint64_t>(static_cast<std::uint64_t>(std::llround(spec.share * static_cast<double>(n))), 1, n);
        break;
      case SynthKind::kOutlier:
        sheets = statue_sheets();
        on_surface = n - std::clamp<std::uint64_t>(static_cast<std::uint64_t>(std::llround(spec.share * static_cast<double>(n))), 1, n);
        distinct = on_surface;
        break;
      case SynthKind::kVolume:
      case SynthKind::kLine: break;
    }
    measure_patches();
  }

  void measure_patches() {
    std::vector<double> areas;
    for (const auto& sheet : sheets) {
      const int cells = sheet->cells(), probes = sheet->probes();
      first_patch.push_back(patches.size());
      const std::size_t begin = patches.size(), n = static_cast<std::size_t>(cells) * static_cast<std::size_t>(cells);
      patches.resize(begin + n);
      areas.resize(begin + n);
      parallel_blocks(n, 64, [&](std::size_t p0, std::size_t p1) {
        for (std::size_t p = p0; p < p1; ++p) {
          double sum = 0, most = 0;
          for (int i = 0; i < probes * probes; ++i) {
            const double u = corner(p, cells)[0] + (i % probes + 0.5) / (cells * probes), v = corner(p, cells)[1] + (i / probes + 0.5) / (cells * probes);
            const double stretch = sheet->at(u, v).stretch;
            sum += stretch;
            most = std::max(most, stretch);
          }
          areas[begin + p] = sum / (static_cast<double>(n) * probes * probes);
          // Probes miss the very peak. One probe is enough only where the stretch is constant.
          patches[begin + p].bound = static_cast<float>(most * (probes > 1 ? 1.2 : 1.0000002));
        }
      });
    }
    for (const double a : areas) area += a;
    double before = 0;
    for (std::size_t p = 0; p < patches.size(); ++p) {
      patches[p].first = static_cast<std::uint64_t>(std::llround(before / area * static_cast<double>(distinct)));
      before += areas[p];
    }
    patches.push_back({distinct, 0});
  }

  static std::array<double, 2> corner(std::size_t patch, int cells) {
    const auto n = static_cast<std::size_t>(cells), row = patch / n;
    // Back and forth, as a scanner sweeps.
    const std::size_t column = row % 2 ? n - 1 - patch % n : patch % n;
    return {static_cast<double>(column) / cells, static_cast<double>(row) / cells};
  }

  /// Point of the surface by its sorted number.
  SheetPoint surface_point(std::uint64_t sorted) const {
    const auto it = std::upper_bound(patches.begin(), patches.end(), sorted, [](std::uint64_t v, const Patch& p) { return v < p.first; }) - 1;
    const auto patch = static_cast<std::size_t>(it - patches.begin());
    const auto sheet_it = std::upper_bound(first_patch.begin(), first_patch.end(), patch) - 1;
    const Sheet& sheet = *sheets[static_cast<std::size_t>(sheet_it - first_patch.begin())];
    const int cells = sheet.cells();
    const auto c = corner(patch - *sheet_it, cells);
    constexpr std::uint32_t kMostTries = 4096;   // a patch that has points has some of its area seen by a probe: one try in 64 at worst
    SheetPoint p;
    for (std::uint32_t attempt = 0; attempt < kMostTries; ++attempt) {
      const auto r = uniform01x4(spec.seed, Purpose::kSynth, sorted, attempt);
      p = sheet.at(c[0] + static_cast<double>(r[0]) / cells, c[1] + static_cast<double>(r[1]) / cells);
      if (static_cast<double>(r[2]) * static_cast<double>(it->bound) < p.stretch) break;
    }
    return p;
  }

  SheetPoint volume_point(std::uint64_t index) const {
    const auto r = uniform01x4(spec.seed, Purpose::kSynth, index, 0), n = uniform01x4(spec.seed, Purpose::kSynth, index, 1);
    Vec3d p(r[0] - 0.5, r[1] - 0.5, r[2] - 0.5);
    if (spec.scan_order) p.z() = (static_cast<double>(index) + 0.5) / static_cast<double>(count) - 0.5;
    const double z = 2 * static_cast<double>(n[0]) - 1, s = std::sqrt(std::max(0.0, 1 - z * z)), phi = 2 * std::numbers::pi * static_cast<double>(n[1]);
    return {p, {s * std::cos(phi), s * std::sin(phi), z}, 1};
  }

  SheetPoint line_point(std::uint64_t index) const {
    // One point in each of `count` equal parts.
    const double t = (static_cast<double>(index) + static_cast<double>(uniform01(spec.seed, Purpose::kSynth, index, 0))) / static_cast<double>(count) - 0.5;
    return {100 * t * line_direction(), Vec3d(-2, 1, 0).normalized(), 1};
  }
  static Vec3d line_direction() { return Vec3d(1, 2, 2) / 3; }

  SheetPoint outlier_point(std::uint64_t index) const {
    const auto r = uniform01x4(spec.seed, Purpose::kSynth, index, 0);
    const double z = 2 * static_cast<double>(r[0]) - 1, s = std::sqrt(std::max(0.0, 1 - z * z)), phi = 2 * std::numbers::pi * static_cast<double>(r[1]);
    const Vec3d d(s * std::cos(phi), s * std::sin(phi), z);
    return {spec.distance_m / spec.scale * (1 - 0.01 * static_cast<double>(r[2])) * d, d, 1};
  }

  SheetPoint raw_point(std::uint64_t index) const {
    if (spec.kind == SynthKind::kVolume) return volume_point(index);
    const std::uint64_t sorted = spec.scan_order ? index : order(index);
    if (spec.kind == SynthKind::kLine) return line_point(sorted);
    if (sorted >= on_surface) return outlier_point(sorted);
    return surface_point(distinct == on_surface ? sorted : sorted % distinct);
  }

  Vec3d offset() const { return {spec.offset_m, spec.offset_m, spec.offset_m / 10}; }
};

SynthScene::SynthScene(const SynthSpec& spec, std::uint64_t num_points) {
  if (num_points < 1 || num_points > std::uint64_t{1} << 40) throw std::invalid_argument("SynthScene: 1 .. 2^40 points");
  impl_ = std::make_unique<Impl>(spec, num_points);
}
SynthScene::SynthScene(SynthScene&&) noexcept = default;
SynthScene::~SynthScene() = default;
std::uint64_t SynthScene::num_points() const { return impl_->count; }
const SynthSpec& SynthScene::spec() const { return impl_->spec; }
double SynthScene::area_m2() const { return impl_->area * impl_->spec.scale * impl_->spec.scale; }

SynthPoint SynthScene::point(std::uint64_t index) const {
  const SheetPoint p = impl_->raw_point(index);
  const SynthSpec& spec = impl_->spec;
  Vec3d position = spec.scale * p.position + impl_->offset();
  // Copies of a position are true copies: noise would make them distinct.
  if (spec.noise_m > 0 && spec.kind != SynthKind::kDuplicates) position += spec.noise_m * normal01(spec.seed, Purpose::kNoise, index, 0) * p.normal;
  return {position, p.normal.cast<float>(), synth_albedo(p.position)};
}

Box3d SynthScene::bounds() const {
  const SynthSpec& spec = impl_->spec;
  Vec3d half = Vec3d::Zero();
  switch (spec.kind) {
    case SynthKind::kSphere:
    case SynthKind::kDuplicates: half = Vec3d::Constant(kSphereRadius); break;
    case SynthKind::kStatue: half = Vec3d(0.95, 0.95, 1.5); break;
    case SynthKind::kWall: half = Vec3d(kWallWidth / 2, kWallHeight / 2, 0.016); break;
    case SynthKind::kRoom: half = Vec3d(kRoomLength / 2, kRoomWidth / 2, kRoomHeight / 2); break;
    case SynthKind::kOutlier: half = Vec3d::Constant(std::max(1.5, spec.distance_m / spec.scale)); break;
    case SynthKind::kVolume: half = Vec3d::Constant(0.5); break;
    case SynthKind::kLine: half = 50 * Impl::line_direction(); break;
  }
  constexpr double kMostSigmas = 6;   // Box-Muller on 24 bits ends below this
  half = spec.scale * half * (1 + 1e-6) + Vec3d::Constant(kMostSigmas * spec.noise_m);
  Box3d box;
  box.extend(impl_->offset() - half);
  box.extend(impl_->offset() + half);
  return box;
}

double SynthScene::distance_to_surface(const Vec3d& position) const {
  const SynthSpec& spec = impl_->spec;
  const Vec3d p = (position - impl_->offset()) / spec.scale;
  double d = 0;
  switch (spec.kind) {
    case SynthKind::kSphere:
    case SynthKind::kDuplicates: d = std::abs(p.norm() - kSphereRadius); break;
    case SynthKind::kStatue:
    case SynthKind::kOutlier: d = p.norm() > 0 ? std::abs(p.norm() - statue_radius(p.normalized()).radius) : statue_radius(Vec3d(0, 0, 1)).radius; break;
    case SynthKind::kWall: d = std::abs(p.z() - wall_relief(p.x(), p.y()).height); break;
    case SynthKind::kRoom: {
      d = std::min({kRoomLength / 2 - std::abs(p.x()), kRoomWidth / 2 - std::abs(p.y()), kRoomHeight / 2 - std::abs(p.z())}, [](double a, double b) { return std::abs(a) < std::abs(b); });
      d = std::abs(d);
      for (const Vec2d& c : room_columns()) d = std::min(d, std::abs((p.head<2>() - c).norm() - kColumnRadius));
      break;
    }
    case SynthKind::kVolume: d = std::max(0.0, p.cwiseAbs().maxCoeff() - 0.5); break;
    case SynthKind::kLine: d = (p - p.dot(Impl::line_direction()) * Impl::line_direction()).norm(); break;
  }
  return d * spec.scale;
}

}  // namespace chiaro::tools
