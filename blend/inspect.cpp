#include "blend/inspect.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace chiaro::blend {
namespace {

constexpr double kDetailSteps = 8192;   // as a vote's detail
/// Photographs of rendered scenes with exact cameras come out at 0.1 px or less, near ones with relief in flash light at 0.4.
constexpr float kLeastShiftPx = 0.5f;

/// Of the cells that show what others show too: what a smaller part says, such as a grazing rim that two neighbours see as well, does not hold for the picture.
constexpr double kLeastCompared = 0.1;

std::int64_t quantised(float detail) { return std::lround(std::clamp(static_cast<double>(detail) * kDetailSteps, -32767.0, 32767.0)); }

/// Median of what the other members say; nullopt if there are fewer than two, as then nobody knows which one is shifted.
std::optional<std::int64_t> detail_of_others(const Ballot& ballot, const Majority& majority, std::uint16_t photograph) {
  std::array<std::int64_t, kVotes> details{};
  std::size_t count = 0;
  for (std::size_t i = 0; i < kVotes; ++i)
    if ((majority.members >> i & 1) != 0 && ballot.votes[i].photograph != photograph) details[count++] = ballot.votes[i].detail;
  if (count < 2) return std::nullopt;
  std::sort(details.data(), details.data() + count);
  const std::size_t half = count / 2;
  return count % 2 == 1 ? details[half] : (details[half - 1] + details[half]) / 2;
}

/// Details at all offsets; false where the surface does not go on.
bool details_around(const PhotoWindow& window, const Vec2d& pixel, std::array<float, kOffsets * kOffsets>& details) {
  const int x0 = static_cast<int>(std::floor(pixel.x() - 0.5)) - kSearchPx, y0 = static_cast<int>(std::floor(pixel.y() - 0.5)) - kSearchPx;
  const auto fx = static_cast<float>(pixel.x() - 0.5 - std::floor(pixel.x() - 0.5)), fy = static_cast<float>(pixel.y() - 0.5 - std::floor(pixel.y() - 0.5));
  std::array<float, (kOffsets + 1) * (kOffsets + 1)> patch;
  for (int v = 0; v <= kOffsets; ++v)
    for (int u = 0; u <= kOffsets; ++u) {
      const WindowPixel* p = window.at(x0 + u, y0 + v);
      if (!p || !(p->weight > 0)) return false;
      const float low = p->low.mean();
      patch[static_cast<std::size_t>(v * (kOffsets + 1) + u)] = low > 0 ? p->high.mean() / low : 0;
    }
  for (int v = 0; v < kOffsets; ++v)
    for (int u = 0; u < kOffsets; ++u) {
      const float* a = &patch[static_cast<std::size_t>(v * (kOffsets + 1) + u)];
      const float* b = a + kOffsets + 1;
      details[static_cast<std::size_t>(v * kOffsets + u)] = (1 - fy) * ((1 - fx) * a[0] + fx * a[1]) + fy * ((1 - fx) * b[0] + fx * b[1]);
    }
  return true;
}

double correlation_at(const ShiftCounts& s, std::size_t i) {
  const auto n = static_cast<double>(s.n);
  const double r = static_cast<double>(s.r) / n, d = static_cast<double>(s.d[i]) / n;
  const double rr = static_cast<double>(s.rr) / n - r * r, dd = static_cast<double>(s.dd[i]) / n - d * d, rd = static_cast<double>(s.rd[i]) / n - r * d;
  return rr > 0 && dd > 0 ? rd / std::sqrt(rr * dd) : 0;
}

struct Shift {
  Vec2f px = Vec2f::Zero();
  float correlation = 0;
  float sd_px = 0, width_px = 0;   ///< standard deviation, and width of the peak, in the less certain direction
};

/// What a parabola through three correlations says: where its vertex lies beside the middle one, and how sharp it is.
struct Vertex {
  double offset = 0, bend = 0;   ///< bend: minus the second derivative
};
Vertex vertex_of(double before, double here, double after) {
  const double bend = 2 * here - before - after;
  return {bend > 0 ? std::clamp(0.5 * (after - before) / bend, -0.5, 0.5) : 0, bend};
}

/// Standard deviation of a correlation's peak. What the two do not have in common pulls the peak aside, the farther the flatter it is: with a correlation c of
/// `independent` pieces of detail and residuals as fine as the detail, sd^2 = (1 - c^2) / (independent c bend). On smoothly painted surfaces the bend is that
/// of errors of light and of means that end at borders: peaks lay up to 3 px beside on undisturbed photographs of a sphere.
double sd_of_peak(double correlation, double bend, double independent) {
  if (!(bend > 0 && correlation > 0 && independent > 0)) return kOffsets;
  return std::sqrt(std::max(0.0, 1 - correlation * correlation) / (independent * correlation * bend));
}

/// The offset of the best correlation, by a parabola through it and its neighbours; nullopt where too little is in common to tell where it lies.
/// independent: how many of the readings count, as errors and detail of neighbours are alike.
std::optional<Shift> best_shift(const ShiftCounts& s, double independent) {
  constexpr std::int64_t kLeastReadings = 200;
  constexpr double kLeastCorrelation = 0.3;
  if (s.n < kLeastReadings) return std::nullopt;
  std::array<double, kOffsets * kOffsets> c;
  for (std::size_t i = 0; i < c.size(); ++i) c[i] = correlation_at(s, i);
  const auto best = static_cast<std::size_t>(std::max_element(c.begin(), c.end()) - c.begin());
  if (!(c[best] >= kLeastCorrelation)) return std::nullopt;
  const int u = static_cast<int>(best) % kOffsets - kSearchPx, v = static_cast<int>(best) / kOffsets - kSearchPx;
  // At the border of what is searched the sharpness is that of the places beside it.
  const auto inner = [](int at) { return static_cast<std::size_t>(std::clamp(at, 1 - kSearchPx, kSearchPx - 1) + kSearchPx); };
  const std::size_t middle = inner(v) * kOffsets + inner(u);
  const Vertex x = vertex_of(c[middle - 1], c[middle], c[middle + 1]), y = vertex_of(c[middle - kOffsets], c[middle], c[middle + kOffsets]);
  const double bend = std::min(x.bend, y.bend);
  Shift result{Vec2f(static_cast<float>(u), static_cast<float>(v)), static_cast<float>(c[best]), static_cast<float>(sd_of_peak(c[best], bend, std::min(independent, static_cast<double>(s.n)))),
               static_cast<float>(bend > 0 ? std::sqrt(c[best] / bend) : kOffsets)};
  if (middle == best) result.px += Vec2d(x.offset, y.offset).cast<float>();
  return result;
}

float spread_of_parts(const InspectionCounts& counts, const Vec2f& whole, double independent) {
  std::vector<float> distances;
  for (const ShiftCounts& part : counts.parts)
    if (const auto shift = best_shift(part, independent / static_cast<double>(counts.parts.size()))) distances.push_back((shift->px - whole).norm());
  if (distances.empty()) return 0;
  std::nth_element(distances.begin(), distances.begin() + static_cast<std::ptrdiff_t>(distances.size() / 2), distances.end());
  return distances[distances.size() / 2];
}

/// A shift is known where one that matters could not have come by chance; and where it is known to a part of a pixel, is too large for chance, and the peak lies
/// within what is searched: one that is wider than that is no place. Flash light on errors of normals, and smooth paint under errors of light, are relief that moves
/// with the light: of 188 photographs of synthetic bodies and walls with exact cameras 27 lay 1.8 to 4.5 px beside, three to five of their deviations, which
/// were .45 px and more; those of photographs that had been moved are .2 px and less.
bool is_known(const Shift& shift) {
  constexpr float kDeviations = 3, kMostSdPx = 0.3f;
  if (kDeviations * shift.sd_px <= kLeastShiftPx) return true;
  return shift.sd_px <= kMostSdPx && kDeviations * shift.sd_px <= shift.px.norm() && shift.width_px <= kSearchPx;
}

/// Cells that share a side, in which most readings are outvoted.
struct Cluster {
  Inspection::Region region;
  std::size_t cells = 0;
};

std::vector<Cluster> outvoted_clusters(const InspectionCounts& counts) {
  constexpr std::uint32_t kLeastJudged = 8;
  const auto is_bad = [&](std::size_t i) { return counts.judged[i] >= kLeastJudged && 2 * counts.outvoted[i] > counts.judged[i]; };
  std::vector<std::uint8_t> seen(counts.judged.size());
  std::vector<Cluster> clusters;
  for (std::size_t start = 0; start < seen.size(); ++start) {
    if (seen[start] || !is_bad(start)) continue;
    Cluster cluster{{counts.width, counts.height, 0, 0, 0, 0, 1}, 0};
    Inspection::Region& region = cluster.region;
    std::vector<std::size_t> open{start};
    seen[start] = 1;
    while (!open.empty()) {
      const std::size_t i = open.back();
      open.pop_back();
      const int x = static_cast<int>(i) % counts.cells_x, y = static_cast<int>(i) / counts.cells_x;
      ++cluster.cells;
      region.x0 = std::min(region.x0, x * counts.cell_px);
      region.y0 = std::min(region.y0, y * counts.cell_px);
      region.x1 = std::max(region.x1, std::min(counts.width, (x + 1) * counts.cell_px));
      region.y1 = std::max(region.y1, std::min(counts.height, (y + 1) * counts.cell_px));
      region.judged += counts.judged[i];
      region.outvoted += counts.outvoted[i];
      for (const auto& [dx, dy] : {std::pair{1, 0}, {-1, 0}, {0, 1}, {0, -1}}) {
        const int u = x + dx, v = y + dy;
        if (u < 0 || v < 0 || u >= counts.cells_x || v >= counts.cells_y) continue;
        const auto next = static_cast<std::size_t>(v * counts.cells_x + u);
        if (seen[next] || !is_bad(next)) continue;
        seen[next] = 1;
        open.push_back(next);
      }
    }
    clusters.push_back(cluster);
  }
  return clusters;
}

/// How likely one of a photograph's clusters grows so large without anything being there. Cells along edges of shadows and relief are outvoted in any photograph,
/// a few beside each other: each goes on to one more with a probability that the other clusters tell (that of a geometric distribution, from what they have
/// in cells and number; without any, one in four), and any of them might have been the largest.
double chance_of(const Cluster& cluster, const std::vector<Cluster>& clusters) {
  double others = 0, cells = 0;
  for (const Cluster& c : clusters) {
    others += 1;
    cells += static_cast<double>(c.cells);
  }
  others -= 1;
  cells -= static_cast<double>(cluster.cells);
  const double goes_on = (cells - others + 0.5) / (cells + 2);
  return std::min(1.0, (others + 1) * std::pow(goes_on, static_cast<double>(cluster.cells) - 1));
}

/// The cluster with most outvoted readings, if it is more than what chance makes.
std::optional<Inspection::Region> largest_disturbed(const InspectionCounts& counts) {
  constexpr double kLeastOutvoted = 50, kLeastShare = 0.002;   // of all that is judged: a few points behind a corner are everywhere
  constexpr double kMostChance = 0.003;                        // three deviations
  const std::vector<Cluster> clusters = outvoted_clusters(counts);
  const auto largest = std::max_element(clusters.begin(), clusters.end(), [](const Cluster& a, const Cluster& b) { return a.region.outvoted < b.region.outvoted; });
  const double least = std::max(kLeastOutvoted, kLeastShare * static_cast<double>(std::accumulate(counts.judged.begin(), counts.judged.end(), std::uint64_t{0})));
  if (largest == clusters.end() || static_cast<double>(largest->region.outvoted) < least) return std::nullopt;
  Inspection::Region region = largest->region;
  region.chance = static_cast<float>(chance_of(*largest, clusters));
  if (!(chance_of(*largest, clusters) < kMostChance)) return std::nullopt;
  return region;
}

}  // namespace

void ShiftCounts::merge(const ShiftCounts& other) {
  n += other.n;
  r += other.r;
  rr += other.rr;
  for (std::size_t i = 0; i < d.size(); ++i) {
    d[i] += other.d[i];
    dd[i] += other.dd[i];
    rd[i] += other.rd[i];
  }
}

InspectionCounts::InspectionCounts(int width_, int height_) : width(width_), height(height_) {
  constexpr int kLeastCellPx = 12, kCellsAcross = 60;
  cell_px = std::max(kLeastCellPx, std::max(width, height) / kCellsAcross);
  cells_x = (width + cell_px - 1) / cell_px;
  cells_y = (height + cell_px - 1) / cell_px;
  judged.resize(static_cast<std::size_t>(cells_x) * static_cast<std::size_t>(cells_y));
  outvoted.resize(judged.size());
  compared.resize(judged.size());
}

void InspectionCounts::merge(const InspectionCounts& other) {
  for (std::size_t i = 0; i < parts.size(); ++i) parts[i].merge(other.parts[i]);
  for (std::size_t i = 0; i < judged.size(); ++i) {
    judged[i] += other.judged[i];
    outvoted[i] += other.outvoted[i];
    compared[i] += other.compared[i];
  }
}

std::size_t InspectionCounts::cell(const Vec2d& pixel) const {
  const int x = std::clamp(static_cast<int>(pixel.x()), 0, width - 1), y = std::clamp(static_cast<int>(pixel.y()), 0, height - 1);
  return static_cast<std::size_t>(y / cell_px * cells_x + x / cell_px);
}

void inspect_reading(const Ballot& ballot, const Majority& majority, std::uint16_t photograph, const Vec3f& log_low, float tolerance, const Vec2d& pixel, const PhotoWindow& window,
                     InspectionCounts& counts) {
  const std::size_t cell = counts.cell(pixel);
  ++counts.judged[cell];
  if (agreement_weight(majority, log_low, tolerance) < 0.5f) {
    ++counts.outvoted[cell];
    return;
  }
  const auto reference = detail_of_others(ballot, majority, photograph);
  std::array<float, kOffsets * kOffsets> details;
  if (!reference || !details_around(window, pixel, details)) return;
  const int px = std::clamp(static_cast<int>(3 * pixel.x() / counts.width), 0, 2), py = std::clamp(static_cast<int>(3 * pixel.y() / counts.height), 0, 2);
  ShiftCounts& s = counts.parts[static_cast<std::size_t>(3 * py + px)];
  ++s.n;
  ++counts.compared[cell];
  s.r += *reference;
  s.rr += *reference * *reference;
  for (std::size_t i = 0; i < details.size(); ++i) {
    const std::int64_t d = quantised(details[i]);
    s.d[i] += d;
    s.dd[i] += d * d;
    s.rd[i] += *reference * d;
  }
}

Inspection conclude(const InspectionCounts& counts) {
  Inspection result;
  ShiftCounts whole;
  for (const ShiftCounts& part : counts.parts) whole.merge(part);
  result.shift_readings = static_cast<std::uint64_t>(whole.n);
  // Detail is as fine as a cell, or finer, and errors hardly reach beyond one.
  const auto cells = [](const std::vector<std::uint32_t>& readings) { return static_cast<double>(std::count_if(readings.begin(), readings.end(), [](std::uint32_t n) { return n > 0; })); };
  const double independent = cells(counts.compared);
  if (independent < kLeastCompared * cells(counts.judged)) {
    result.disturbed = largest_disturbed(counts);
    return result;
  }
  if (const auto shift = best_shift(whole, independent)) {
    result.correlation = shift->correlation;
    result.shift_sd_px = shift->sd_px;
    if (is_known(*shift)) {
      result.shift_px = shift->px;
      result.shift_spread_px = spread_of_parts(counts, shift->px, independent);
    }
  }
  result.disturbed = largest_disturbed(counts);
  return result;
}

Alignment alignment_for(const Inspection& inspection) {
  Alignment result;
  if (!inspection.shift_px) return result;
  const float length = inspection.shift_px->norm();
  if (length < kLeastShiftPx) return result;
  const bool inside = inspection.shift_px->cwiseAbs().maxCoeff() < kSearchPx;
  if (inside && inspection.shift_spread_px < 0.5f * length) result.shift_px = *inspection.shift_px;
  const float left = inside && result.shift_px != Vec2f::Zero() ? inspection.shift_spread_px : length;
  result.trust = 1 / (1 + left * left / (kLeastShiftPx * kLeastShiftPx));
  return result;
}

}  // namespace chiaro::blend
