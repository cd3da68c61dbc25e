#include "tools/compare_points.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <functional>
#include <limits>
#include <optional>
#include <vector>

#include "stream/base/error.h"
#include "stream/cloud/point_stream.h"
#include "tools/colour_source.h"
#include "tools/colour_spaces.h"
#include "tools/compare_picture.h"
#include "tools/metrics.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr float kDarkest = 1e-3f;  ///< references below this have no relative difference

/// Counts values >= 0 in bins of their float's leading bits: constant relative width, fixed memory, any order.
class Histogram {
 public:
  void add(double value) {
    const auto bits = std::bit_cast<std::uint32_t>(static_cast<float>(value));
    ++bins_[std::min<std::uint32_t>(bits >> kShift, kBins - 1)];
    sum_ += value;
    max_ = std::max(max_, value);
    ++count_;
  }
  Distribution distribution() const {
    if (count_ == 0) return {kNan, kNan, kNan, kNan};
    return {sum_ / static_cast<double>(count_), quantile(0.5), quantile(0.95), max_};
  }

 private:
  static constexpr int kShift = 11;  // sign and 8 bits of exponent stay, with 12 bits of mantissa
  static constexpr std::uint32_t kBins = 0x7f800000u >> kShift;
  double quantile(double q) const {
    const auto rank = static_cast<std::uint64_t>(std::ceil(q * static_cast<double>(count_)));
    std::uint64_t passed = 0;
    for (std::uint32_t bin = 0; bin < kBins; ++bin) {
      passed += bins_[bin];
      if (passed >= rank && passed > 0) {
        const double low = std::bit_cast<float>(bin << kShift), high = std::bit_cast<float>((bin + 1) << kShift);
        return bin == 0 ? 0 : std::min(max_, (low + high) / 2);
      }
    }
    return max_;
  }
  std::vector<std::uint64_t> bins_ = std::vector<std::uint64_t>(kBins);
  double sum_ = 0, max_ = 0;
  std::uint64_t count_ = 0;
};

/// One point of both.
struct Pair {
  Vec3d position = Vec3d::Constant(kNan);
  double apart = kNan;   ///< distance of the point in A from that in B; NaN where one of them says nothing
  Vec3f a, b;
  bool is_seen() const { return a.allFinite() && b.allFinite(); }
};

double relative_of(const Vec3f& a, const Vec3f& b) {
  double sum = 0;
  int channels = 0;
  for (int c = 0; c < 3; ++c)
    if (b[c] > kDarkest) {
      sum += std::abs(static_cast<double>(a[c]) - static_cast<double>(b[c])) / static_cast<double>(b[c]);
      ++channels;
    }
  return channels ? sum / channels : kNan;
}

/// As relative_of(), with its sign: positive where A is brighter.
double signed_of(const Vec3f& a, const Vec3f& b) {
  double sum = 0;
  int channels = 0;
  for (int c = 0; c < 3; ++c)
    if (b[c] > kDarkest) {
      sum += (static_cast<double>(a[c]) - static_cast<double>(b[c])) / static_cast<double>(b[c]);
      ++channels;
    }
  return channels ? sum / channels : kNan;
}

double difference_of(const Vec3f& a, const Vec3f& b) { return (a.cast<double>() - b.cast<double>()).cwiseAbs().mean(); }

/// Both sources in step, whatever their blocks.
class Walk {
 public:
  Walk(const std::string& a, const std::string& b) : names_{a, b} {
    for (std::size_t s = 0; s < 2; ++s) sources_[s] = open_colours(names_[s]);
    use_albedo_ = sources_[0]->has_albedo() && sources_[1]->has_albedo();
    if (!use_albedo_ && !(sources_[0]->has_colour() && sources_[1]->has_colour()))
      throw Error(concat(a, " and ", b, ": one has albedo alone and the other colours alone: nothing to compare"));
    if (sources_[0]->order_key() != sources_[1]->order_key())
      throw Error(concat(a, " and ", b, ": not the same points in the same order (layers of different stores, or a layer and a file; compare exports instead)"));
  }
  bool use_albedo() const { return use_albedo_; }
  bool has_position() const { return sources_[0]->has_position() || sources_[1]->has_position(); }
  bool position_is_double() const { return sources_[0]->position_is_double() || sources_[1]->position_is_double(); }
  std::uint64_t declared_points() const { return std::max(sources_[0]->declared_points(), sources_[1]->declared_points()); }

  /// Calls f for every pair. throws Error if one source ends before the other.
  void for_each(Reporter& report, const std::function<void(const Pair&)>& f) {
    std::array<ColourBlock, 2> blocks;
    std::array<std::size_t, 2> at{0, 0};
    std::uint64_t done = 0;
    const auto refill = [&](std::size_t s) {
      while (at[s] == blocks[s].size()) {
        at[s] = 0;
        if (!sources_[s]->read(blocks[s])) return false;
      }
      return true;
    };
    while (true) {
      report.check();
      const bool more_a = refill(0), more_b = refill(1);
      if (more_a != more_b) throw Error(concat(names_[more_a ? 1 : 0], " has ", done, " points, ", names_[more_a ? 0 : 1], " has more"));
      if (!more_a) return;
      const std::size_t count = std::min(blocks[0].size() - at[0], blocks[1].size() - at[1]);
      for (std::size_t i = 0; i < count; ++i) f(pair(blocks, at[0]++, at[1]++));
      report.progress(done += count);
    }
  }

 private:
  Pair pair(const std::array<ColourBlock, 2>& blocks, std::size_t i, std::size_t j) const {
    Pair pair;
    pair.a = use_albedo_ ? blocks[0].albedo[i] : blocks[0].colour[i];
    pair.b = use_albedo_ ? blocks[1].albedo[j] : blocks[1].colour[j];
    if (!blocks[0].position.empty()) pair.position = blocks[0].position[i];
    else if (!blocks[1].position.empty()) pair.position = blocks[1].position[j];
    if (!blocks[0].position.empty() && !blocks[1].position.empty()) pair.apart = (blocks[0].position[i] - blocks[1].position[j]).norm();
    return pair;
  }
  std::array<std::string, 2> names_;
  std::array<std::unique_ptr<ColourSource>, 2> sources_;
  bool use_albedo_ = false;
};

struct Sums {
  double aa = 0, ab = 0, squares = 0, signed_sum = 0, delta_e = 0;
  Box3d bounds;
};

stream::PointWriterOptions difference_file(const PointComparison& result, const Sums& sums, bool is_double) {
  const auto position = is_double ? stream::ScalarType::kF64 : stream::ScalarType::kF32;
  stream::PointWriterOptions options;
  options.num_points = result.points;
  options.bounds = sums.bounds;
  for (const char* name : {"x", "y", "z"}) options.properties.push_back({name, position});
  for (const char* name : {"difference_r", "difference_g", "difference_b", "difference", "relative"}) options.properties.push_back({name, stream::ScalarType::kF32});
  return options;
}

template <class T>
void append(std::vector<std::byte>& row, T value) {
  const auto* bytes = reinterpret_cast<const std::byte*>(&value);
  row.insert(row.end(), bytes, bytes + sizeof value);
}

void append_row(std::vector<std::byte>& rows, const Pair& pair, bool is_double) {
  for (int c = 0; c < 3; ++c) {
    if (is_double) append(rows, pair.position[c]);
    else append(rows, static_cast<float>(pair.position[c]));
  }
  const bool seen = pair.is_seen();
  for (int c = 0; c < 3; ++c) append(rows, seen ? pair.a[c] - pair.b[c] : static_cast<float>(kNan));
  append(rows, static_cast<float>(seen ? difference_of(pair.a, pair.b) : kNan));
  append(rows, static_cast<float>(seen ? relative_of(pair.a, pair.b) : kNan));
}

/// First pass: all but what needs the scale.
Sums measure(const std::string& a, const std::string& b, PointComparison& result, Reporter& report) {
  Walk walk(a, b);
  result.compared_values = walk.use_albedo() ? "albedo" : "colour";
  Sums sums;
  Histogram difference, relative;
  report.begin("compare", walk.declared_points(), "points");
  walk.for_each(report, [&](const Pair& pair) {
    ++result.points;
    if (!pair.a.allFinite()) ++result.unseen_a;
    if (!pair.b.allFinite()) ++result.unseen_b;
    if (pair.position.allFinite()) sums.bounds.extend(pair.position);
    if (!pair.is_seen()) return;
    ++result.compared;
    const Vec3d va = pair.a.cast<double>(), vb = pair.b.cast<double>();
    difference.add(difference_of(pair.a, pair.b));
    if (const double r = relative_of(pair.a, pair.b); std::isfinite(r)) relative.add(r);
    sums.aa += va.squaredNorm();
    sums.ab += va.dot(vb);
    sums.squares += (va - vb).squaredNorm();
    sums.signed_sum += (va - vb).sum();
    sums.delta_e += delta_e_2000(lab_from_linear({va[0], va[1], va[2]}), lab_from_linear({vb[0], vb[1], vb[2]}));
  });
  report.end();
  const double count = static_cast<double>(result.compared);
  result.difference = difference.distribution();
  result.relative = relative.distribution();
  result.rms = std::sqrt(sums.squares / (3 * count));
  result.bias = sums.signed_sum / (3 * count);
  result.delta_e = sums.delta_e / count;
  result.scale = sums.aa > 0 ? sums.ab / sums.aa : kNan;
  return sums;
}

}  // namespace

PointComparison compare_points(const std::string& a, const std::string& b, const std::filesystem::path& out, Reporter& report, const std::filesystem::path& picture) {
  for (const auto& file : {out, picture})
    for (const std::string& source : {a, b})
      if (std::error_code code; !file.empty() && std::filesystem::equivalent(file, source, code)) throw Error(concat(file.string(), ": is what is compared, it is not written over; choose another name"));
  PointComparison result;
  const Sums sums = measure(a, b, result, report);
  if (result.points == 0) throw Error(concat(a, " and ", b, ": no points"));

  Walk walk(a, b);
  for (const auto& file : {out, picture})
    if (!file.empty() && !walk.has_position()) throw Error(concat(file.string(), ": neither ", a, " nor ", b, " has positions to write"));
  std::unique_ptr<stream::PointWriter> writer;
  if (!out.empty()) writer = stream::create_points(out, difference_file(result, sums, walk.position_is_double()));
  std::optional<DifferencePicture> drawing;
  if (!picture.empty()) {
    if (sums.bounds.empty()) throw Error(concat(picture.string(), ": no point has a finite position"));
    result.picture_range = round_range(result.relative.p95);
    drawing.emplace(sums.bounds, result.points, result.picture_range);
  }
  // Points match by their order. Formats round positions by far less than this; in another order they lie anywhere.
  constexpr double kElsewhere = 1e-3;   // of the extent
  const double elsewhere = sums.bounds.empty() ? kNan : kElsewhere * (sums.bounds.max - sums.bounds.min).norm();
  constexpr std::size_t kRowsAtOnce = 1 << 14;
  std::vector<std::byte> rows;
  std::size_t num_rows = 0;
  const auto flush = [&] {
    if (num_rows) writer->write(rows.data(), num_rows);
    rows.clear();
    num_rows = 0;
  };
  Histogram scaled;
  report.begin("compare, one factor taken out", result.points, "points");
  walk.for_each(report, [&](const Pair& pair) {
    if (pair.apart > elsewhere) ++result.elsewhere;
    if (pair.is_seen())
      if (const double r = relative_of(pair.a * static_cast<float>(result.scale), pair.b); std::isfinite(r)) scaled.add(r);
    if (drawing) drawing->add(pair.position, pair.is_seen() ? signed_of(pair.a, pair.b) : kNan);
    if (!writer) return;
    append_row(rows, pair, walk.position_is_double());
    if (++num_rows == kRowsAtOnce) flush();
  });
  report.end();
  result.relative_scaled = scaled.distribution();
  if (writer) {
    flush();
    writer->commit();
  }
  if (drawing) drawing->write(picture);
  return result;
}

}  // namespace chiaro::tools
