#include "tools/report_photo.h"

#include <algorithm>
#include <cmath>
#include <optional>

#include "stream/base/error.h"
#include "stream/photo/image_io.h"
#include "stream/photo/raster.h"
#include "tools/metrics.h"

namespace chiaro::tools {
namespace {

constexpr int kHalo = 5;                    // radius of the window of SSIM
constexpr std::size_t kBandPixels = 1 << 19;

int band_rows(int width) { return std::max(2 * kHalo + 16, static_cast<int>(kBandPixels / static_cast<std::size_t>(width))); }

/// Three planes to interleaved values.
std::vector<float> interleaved(const stream::RasterReader& in, int y0, int rows) {
  const auto r = in.rows<float>("r", y0, rows), g = in.rows<float>("g", y0, rows), b = in.rows<float>("b", y0, rows);
  std::vector<float> v(3 * r.size());
  for (std::size_t i = 0; i < r.size(); ++i) v[3 * i] = r[i], v[3 * i + 1] = g[i], v[3 * i + 2] = b[i];
  return v;
}

}  // namespace

// Histogram ------------------------------------------------------------------------------------------------------------------------

void LogHistogram::add(double value) {
  double bin = 0;
  if (value > 0) bin = std::clamp((std::log2(value) - kLeastLog2) * kBinsPerOctave, 0.0, static_cast<double>(bins_.size() - 1));
  ++bins_[static_cast<std::size_t>(bin)];
  ++count_;
}

void LogHistogram::add(const LogHistogram& other) {
  for (std::size_t i = 0; i < bins_.size(); ++i) bins_[i] += other.bins_[i];
  count_ += other.count_;
}

double LogHistogram::quantile(double share) const {
  if (count_ == 0) return NAN;
  const double wanted = share * static_cast<double>(count_);
  std::uint64_t sum = 0;
  for (std::size_t i = 0; i < bins_.size(); ++i) {
    sum += bins_[i];
    if (static_cast<double>(sum) >= wanted && sum > 0) return i == 0 ? 0.0 : std::exp2((static_cast<double>(i) + 0.5) / kBinsPerOctave + kLeastLog2);
  }
  return NAN;
}

// Files ----------------------------------------------------------------------------------------------------------------------------

struct ReportPhoto::Band {
  int rows = 0;
  std::vector<float> photo, residual, own;   ///< 3 a pixel; own: albedo of this photograph alone, NaN = none
  std::vector<std::uint8_t> usable, hit, solved, predicted;
  std::vector<float> coverage;
};

struct ReportPhoto::Impl {
  std::string key;
  stream::RasterReader radiance, gbuffer, own_albedo;
  stream::ImageSource albedo, sigma, residual;
  std::optional<stream::ImageSource> light;

  static stream::ImageOptions channels(std::vector<std::string> names) {
    stream::ImageOptions options;
    options.exr_channels = std::move(names);
    return options;
  }

  Impl(const RunFolder& f, const std::string& k, bool with_light)
      : key(k), radiance(f.radiance(k)), gbuffer(f.gbuffer(k)), own_albedo(f.albedo(k)), albedo(f.pictures(k) / "albedo.exr", channels({"R", "G", "B"})),
        sigma(f.pictures(k) / "sigma.exr", channels({"Y"})), residual(f.pictures(k) / "residual.exr", channels({"R", "G", "B"})) {
    if (with_light) light.emplace(f.pictures(k) / "light.exr", channels({"direct", "indirect", "ambient"}));
    require_size(f.gbuffer(k), gbuffer.width(), gbuffer.height());
    require_size(f.albedo(k), own_albedo.width(), own_albedo.height());
    require_size(f.pictures(k) / "albedo.exr", albedo.width(), albedo.height());
    require_size(f.pictures(k) / "sigma.exr", sigma.width(), sigma.height());
    require_size(f.pictures(k) / "residual.exr", residual.width(), residual.height());
    if (light) require_size(f.pictures(k) / "light.exr", light->width(), light->height());
    require_planes(radiance, f.radiance(k), {{"r", stream::PlaneType::kF32}, {"g", stream::PlaneType::kF32}, {"b", stream::PlaneType::kF32}, {"mask", stream::PlaneType::kU8}});
    require_planes(gbuffer, f.gbuffer(k), {{"coverage", stream::PlaneType::kF32}, {"edge", stream::PlaneType::kF32}});
    require_planes(own_albedo, f.albedo(k), {{"r", stream::PlaneType::kF32}, {"g", stream::PlaneType::kF32}, {"b", stream::PlaneType::kF32}});
  }

  void require_size(const std::filesystem::path& file, int width, int height) const {
    if (width == radiance.width() && height == radiance.height()) return;
    throw Error(concat(file.string(), ": ", width, " x ", height, " pixels, but the photograph has ", radiance.width(), " x ", radiance.height()));
  }
  static void require_planes(const stream::RasterReader& in, const std::filesystem::path& file, const std::vector<stream::PlaneInfo>& wanted) {
    for (const stream::PlaneInfo& w : wanted) {
      const auto found = std::find_if(in.planes().begin(), in.planes().end(), [&](const stream::PlaneInfo& p) { return p.name == w.name && p.type == w.type; });
      if (found == in.planes().end()) throw Error(concat(file.string(), ": plane \"", w.name, "\" is missing or of another type"));
    }
  }

  int width() const { return radiance.width(); }
  int height() const { return radiance.height(); }

  std::vector<float> read(stream::ImageSource& source, int y0, int rows) const {
    std::vector<float> v(static_cast<std::size_t>(rows) * static_cast<std::size_t>(width()) * static_cast<std::size_t>(source.channels()));
    source.read_rows(y0, rows, v.data());
    for (float& x : v)
      if (!std::isfinite(x)) x = 0;   // pixels beyond the data window
    return v;
  }

  Band band(int y0, int rows) {
    Band b;
    b.rows = rows;
    b.photo = interleaved(radiance, y0, rows);
    b.own = interleaved(own_albedo, y0, rows);
    b.residual = read(residual, y0, rows);
    b.coverage = gbuffer.rows<float>("coverage", y0, rows);
    b.usable = radiance.rows<std::uint8_t>("mask", y0, rows);
    const std::size_t n = b.coverage.size();
    b.hit.resize(n);
    b.solved.resize(n);
    b.predicted.resize(n);
    for (std::size_t i = 0; i < n; ++i) {
      const float *own = &b.own[3 * i], *left = &b.residual[3 * i];
      bool finite = true;
      for (int c = 0; c < 3; ++c) finite = finite && std::isfinite(b.photo[3 * i + c]);
      b.usable[i] = b.usable[i] == 1 && finite;
      b.hit[i] = b.usable[i] && b.coverage[i] > 0;
      b.solved[i] = b.usable[i] && std::isfinite(own[0]) && std::isfinite(own[1]) && std::isfinite(own[2]) && std::max({own[0], own[1], own[2]}) > 0;
      // Where the blended result has no albedo nothing is predicted, and the residual was left at zero.
      b.predicted[i] = b.solved[i] && (left[0] != 0 || left[1] != 0 || left[2] != 0);
    }
    return b;
  }
};

ReportPhoto::ReportPhoto(const RunFolder& folder, const std::string& key, bool with_light) : impl_(std::make_unique<Impl>(folder, key, with_light)) {}
ReportPhoto::ReportPhoto(ReportPhoto&&) noexcept = default;
ReportPhoto::~ReportPhoto() = default;
int ReportPhoto::width() const { return impl_->width(); }
int ReportPhoto::height() const { return impl_->height(); }
const std::string& ReportPhoto::key() const { return impl_->key; }

// Measures -------------------------------------------------------------------------------------------------------------------------

LogHistogram radiance_histogram(ReportPhoto& photo) {
  LogHistogram on_cloud, anywhere;
  auto& files = photo.impl();
  const int step = band_rows(files.width());
  for (int y0 = 0; y0 < files.height(); y0 += step) {
    const int rows = std::min(step, files.height() - y0);
    const auto values = interleaved(files.radiance, y0, rows);
    const auto mask = files.radiance.rows<std::uint8_t>("mask", y0, rows);
    const auto coverage = files.gbuffer.rows<float>("coverage", y0, rows);
    for (std::size_t i = 0; i < values.size(); ++i) {
      if (mask[i / 3] != 1 || !std::isfinite(values[i])) continue;
      anywhere.add(values[i]);
      if (coverage[i / 3] > 0) on_cloud.add(values[i]);
    }
  }
  return on_cloud.count() > 0 ? on_cloud : anywhere;
}

namespace {

/// How many pixels ssim() averages over: those that keep kHalo pixels from the border and have no unset pixel within that distance.
std::uint64_t count_inside(const std::vector<std::uint8_t>& mask, int width, int rows) {
  const auto w = static_cast<std::size_t>(width);
  std::vector<int> reach(mask.size());   // set pixels to either side in the row, -1 where the pixel itself is unset
  for (std::size_t y = 0; y < static_cast<std::size_t>(rows); ++y) {
    int run = -1;
    for (std::size_t x = 0; x < w; ++x) reach[y * w + x] = run = mask[y * w + x] ? run + 1 : -1;
    run = -1;
    for (std::size_t x = w; x-- > 0;) {
      run = mask[y * w + x] ? run + 1 : -1;
      reach[y * w + x] = std::min(reach[y * w + x], run);
    }
  }
  int half_width[2 * kHalo + 1];   // of the disc in its rows
  for (int dy = -kHalo; dy <= kHalo; ++dy) half_width[dy + kHalo] = static_cast<int>(std::sqrt(static_cast<double>(kHalo * kHalo - dy * dy)));
  std::uint64_t count = 0;
  for (int y = kHalo; y < rows - kHalo; ++y)
    for (int x = kHalo; x < width - kHalo; ++x) {
      bool inside = true;
      for (int dy = -kHalo; inside && dy <= kHalo; ++dy)
        inside = reach[static_cast<std::size_t>(y + dy) * w + static_cast<std::size_t>(x)] >= half_width[dy + kHalo];
      count += inside;
    }
  return count;
}

struct Sums {
  double squares_linear = 0, squares_srgb = 0, ssim = 0, residual = 0, photo = 0;
  std::uint64_t ssim_pixels = 0;
  std::array<double, 3> shares{};
};

/// Luminance of encoded values, one a pixel.
std::vector<float> encoded_luminance(const std::vector<float>& encoded) {
  std::vector<float> y(encoded.size() / 3);
  for (std::size_t i = 0; i < y.size(); ++i) y[i] = 0.2126f * encoded[3 * i] + 0.7152f * encoded[3 * i + 1] + 0.0722f * encoded[3 * i + 2];
  return y;
}

/// The band reaches kHalo rows beyond what it counts, above and below; at the picture's border fewer are lost, as ssim() leaves them out anyway.
void add_likeness(const ReportPhoto::Band& band, int width, int first, int last, double white, Sums& sums) {
  const std::size_t n = band.predicted.size();
  std::vector<float> test(3 * n), reference(3 * n);
  for (std::size_t i = 0; i < 3 * n; ++i) {
    const bool use = band.predicted[i / 3];
    reference[i] = use ? band.photo[i] / static_cast<float>(white) : 0;
    test[i] = use ? (band.photo[i] - band.residual[i]) / static_cast<float>(white) : 0;
  }
  std::vector<std::uint8_t> mask(n);
  std::uint64_t used = 0;
  for (int y = first; y < last; ++y)
    for (int x = 0; x < width; ++x) {
      const std::size_t i = static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x);
      mask[i] = band.predicted[i];
      used += mask[i];
    }
  const auto view = [&](const std::vector<float>& v, int channels) { return PixelView{width, band.rows, channels, v}; };
  if (used > 0) sums.squares_linear += mse(view(test, 3), view(reference, 3), mask) * static_cast<double>(used);
  for (auto* values : {&test, &reference})
    for (float& v : *values) v = static_cast<float>(stream::srgb_from_linear(v));
  if (used > 0) sums.squares_srgb += mse(view(test, 3), view(reference, 3), mask) * static_cast<double>(used);
  const std::uint64_t inner = count_inside(band.predicted, width, band.rows);
  if (inner == 0) return;
  const std::vector<float> a = encoded_luminance(test), b = encoded_luminance(reference);
  sums.ssim += ssim(view(a, 1), view(b, 1), band.predicted) * static_cast<double>(inner);
  sums.ssim_pixels += inner;
}

void add_counts(const ReportPhoto::Band& band, const std::vector<float>& sigma, const std::vector<float>& light, int width, int first, int last, double white, PhotoMeasures& m,
                PictureRanges& ranges, Sums& sums) {
  const auto w = static_cast<std::size_t>(width);
  for (std::size_t i = static_cast<std::size_t>(first) * w; i < static_cast<std::size_t>(last) * w; ++i) {
    m.usable += band.usable[i];
    m.on_cloud += band.hit[i];
    m.solved += band.solved[i];
    m.predicted += band.predicted[i];
    if (band.solved[i]) {
      if (sigma[i] > 0) ranges.sigma.add(sigma[i]);
      if (!light.empty()) {
        for (std::size_t c = 0; c < 3; ++c) sums.shares[c] += light[3 * i + c];
        ranges.indirect.add(light[3 * i + 1]);
        ranges.ambient.add(light[3 * i + 2]);
      }
    }
    if (!band.predicted[i]) continue;
    double difference = 0;
    for (std::size_t c = 0; c < 3; ++c) {
      const double left = band.residual[3 * i + c] / white, value = band.photo[3 * i + c] / white;
      difference += std::abs(left) / 3;
      sums.residual += left * left;
      sums.photo += value * value;
    }
    ranges.difference.add(difference);
  }
}

double decibels(double mean_square) { return mean_square > 0 ? -10 * std::log10(mean_square) : INFINITY; }

}  // namespace

void PictureRanges::add(const PictureRanges& other) {
  difference.add(other.difference);
  sigma.add(other.sigma);
  indirect.add(other.indirect);
  ambient.add(other.ambient);
}

PhotoMeasures measure(ReportPhoto& photo, double white, PictureRanges& ranges, Reporter& report) {
  auto& files = photo.impl();
  const int width = files.width(), height = files.height(), step = band_rows(width);
  PhotoMeasures m;
  PictureRanges own;
  Sums sums;
  m.pixels = static_cast<std::uint64_t>(width) * static_cast<std::uint64_t>(height);
  for (int y0 = 0; y0 < height; y0 += step) {
    report.check();
    const int y1 = std::min(height, y0 + step), from = std::max(0, y0 - kHalo), to = std::min(height, y1 + kHalo);
    const ReportPhoto::Band band = files.band(from, to - from);
    add_likeness(band, width, y0 - from, y1 - from, white, sums);
    const std::vector<float> sigma = files.read(files.sigma, from, to - from);
    const std::vector<float> light = files.light ? files.read(*files.light, from, to - from) : std::vector<float>{};
    add_counts(band, sigma, light, width, y0 - from, y1 - from, white, m, own, sums);
  }
  const double n = static_cast<double>(m.predicted);
  m.psnr_linear = n > 0 ? decibels(sums.squares_linear / n) : NAN;
  m.psnr_srgb = n > 0 ? decibels(sums.squares_srgb / n) : NAN;
  m.ssim = sums.ssim_pixels > 0 ? sums.ssim / static_cast<double>(sums.ssim_pixels) : NAN;
  m.residual_rms = n > 0 ? std::sqrt(sums.residual / (3 * n)) : NAN;
  m.residual_relative = sums.photo > 0 ? std::sqrt(sums.residual / sums.photo) : NAN;
  m.median_sigma = own.sigma.quantile(0.5);
  ranges.add(own);
  for (std::size_t c = 0; c < 3; ++c) m.shares[c] = files.light && m.solved > 0 ? sums.shares[c] / static_cast<double>(m.solved) : NAN;
  return m;
}

// Pictures -------------------------------------------------------------------------------------------------------------------------

namespace {

/// Means over blocks of block x block pixels, as far as these have a value.
class Shrunk {
 public:
  Shrunk(int width, int height, int block, int channels)
      : width_(width), block_(block), channels_(static_cast<std::size_t>(channels)), out_width((width + block - 1) / block), out_height((height + block - 1) / block),
        sums_(size() * channels_), weights_(size()), areas_(size()) {}

  /// values: channels a pixel; use: one byte a pixel, empty = all.
  void add(int y0, const std::vector<float>& values, const std::vector<std::uint8_t>& use) {
    for (std::size_t i = 0; i < values.size() / channels_; ++i) {
      const int x = static_cast<int>(i % static_cast<std::size_t>(width_)), y = y0 + static_cast<int>(i / static_cast<std::size_t>(width_));
      const std::size_t o = static_cast<std::size_t>(y / block_) * static_cast<std::size_t>(out_width) + static_cast<std::size_t>(x / block_);
      areas_[o] += 1;
      if (!use.empty() && !use[i]) continue;
      weights_[o] += 1;
      for (std::size_t c = 0; c < channels_; ++c) sums_[o * channels_ + c] += values[i * channels_ + c];
    }
  }
  std::size_t size() const { return static_cast<std::size_t>(out_width) * static_cast<std::size_t>(out_height); }
  bool has(std::size_t o) const { return weights_[o] > 0 && 2 * weights_[o] >= areas_[o]; }
  double at(std::size_t o, std::size_t c) const { return sums_[o * channels_ + c] / weights_[o]; }
  Rgb8 nothing(std::size_t o) const { return no_value(static_cast<int>(o % static_cast<std::size_t>(out_width)), static_cast<int>(o / static_cast<std::size_t>(out_width))); }

 private:
  int width_, block_;
  std::size_t channels_;

 public:
  const int out_width, out_height;

 private:
  std::vector<double> sums_;
  std::vector<float> weights_, areas_;
};

ReportPicture colour_picture(const char* kind, const Shrunk& s, double white) {
  std::vector<Rgb8> pixels(s.size());
  for (std::size_t o = 0; o < s.size(); ++o) {
    if (!s.has(o)) {
      pixels[o] = s.nothing(o);
      continue;
    }
    for (std::size_t c = 0; c < 3; ++c) pixels[o][c] = stream::srgb8_from_linear(s.at(o, c) / white);
  }
  return {kind, s.out_width, s.out_height, png_rgb(s.out_width, s.out_height, pixels)};
}

ReportPicture scale_picture(const char* kind, const Shrunk& s, double range, bool grey) {
  std::vector<double> values(s.size());
  for (std::size_t o = 0; o < s.size(); ++o) values[o] = s.has(o) ? s.at(o, 0) / range : NAN;
  return {kind, s.out_width, s.out_height, png_scale(s.out_width, s.out_height, values, grey)};
}

/// Grey: how much of the pixel the cloud covers; orange: near a depth edge.
ReportPicture coverage_picture(const Shrunk& s) {
  std::vector<Rgb8> pixels(s.size());
  for (std::size_t o = 0; o < s.size(); ++o) {
    const double coverage = s.has(o) ? s.at(o, 0) : 0, near = s.has(o) ? std::clamp(s.at(o, 1), 0.0, 1.0) : 0;
    if (!(coverage > 0)) {
      pixels[o] = s.nothing(o);
      continue;
    }
    const double grey = 40 + 180 * std::min(1.0, coverage), orange[3] = {235, 125, 20};
    for (std::size_t c = 0; c < 3; ++c) pixels[o][c] = static_cast<std::uint8_t>(grey + near * (orange[c] - grey) + 0.5);
  }
  return {"coverage", s.out_width, s.out_height, png_rgb(s.out_width, s.out_height, pixels)};
}

/// One channel out of three.
std::vector<float> channel(const std::vector<float>& v, std::size_t c) {
  std::vector<float> out(v.size() / 3);
  for (std::size_t i = 0; i < out.size(); ++i) out[i] = v[3 * i + c];
  return out;
}

}  // namespace

std::vector<ReportPicture> draw(ReportPhoto& photo, const PictureScales& scales, int max_width, Reporter& report) {
  auto& files = photo.impl();
  const int width = files.width(), height = files.height(), block = (width + max_width - 1) / max_width;
  Shrunk input(width, height, block, 3), prediction(width, height, block, 3), albedo(width, height, block, 3), difference(width, height, block, 1), sigma(width, height, block, 1),
      coverage(width, height, block, 2);
  std::array<std::optional<Shrunk>, 3> light;
  if (files.light)
    for (auto& l : light) l.emplace(width, height, block, 1);
  const int step = band_rows(width);
  for (int y0 = 0; y0 < height; y0 += step) {
    report.check();
    const int rows = std::min(step, height - y0);
    ReportPhoto::Band band = files.band(y0, rows);
    std::vector<float> predicted(band.photo.size()), off(band.predicted.size());
    for (float& v : band.photo)
      if (!std::isfinite(v)) v = 0;
    for (std::size_t i = 0; i < predicted.size(); ++i) {
      predicted[i] = band.photo[i] - band.residual[i];
      off[i / 3] += std::abs(band.residual[i]) / 3;
    }
    input.add(y0, band.photo, {});
    prediction.add(y0, predicted, band.predicted);
    difference.add(y0, off, band.predicted);
    albedo.add(y0, files.read(files.albedo, y0, rows), band.solved);
    sigma.add(y0, files.read(files.sigma, y0, rows), band.solved);
    if (files.light) {
      const auto values = files.read(*files.light, y0, rows);
      for (std::size_t c = 0; c < 3; ++c) light[c]->add(y0, channel(values, c), band.solved);
    }
    const auto edge = files.gbuffer.rows<float>("edge", y0, rows);
    std::vector<float> cover(2 * edge.size());
    for (std::size_t i = 0; i < edge.size(); ++i) {
      cover[2 * i] = std::isfinite(band.coverage[i]) ? band.coverage[i] : 0;
      cover[2 * i + 1] = band.coverage[i] > 0 && edge[i] >= 0 ? std::max(0.0f, 1 - edge[i] / static_cast<float>(scales.edge_px)) : 0;
    }
    coverage.add(y0, cover, {});
  }
  std::vector<ReportPicture> pictures;
  pictures.push_back(colour_picture("photograph", input, scales.white));
  pictures.push_back(colour_picture("prediction", prediction, scales.white));
  pictures.push_back(scale_picture("difference", difference, scales.difference * scales.white, false));
  pictures.push_back(colour_picture("albedo", albedo, scales.albedo_white));
  pictures.push_back(scale_picture("sigma", sigma, scales.sigma, false));
  pictures.push_back(coverage_picture(coverage));
  if (files.light) {
    pictures.push_back(scale_picture("direct", *light[0], 1, true));
    pictures.push_back(scale_picture("indirect", *light[1], scales.indirect, true));
    pictures.push_back(scale_picture("ambient", *light[2], scales.ambient, true));
  }
  return pictures;
}

}  // namespace chiaro::tools
