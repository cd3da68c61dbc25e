#include "stream/photo/develop.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <deque>
#include <limits>
#include <memory>

#include "stream/base/error.h"
#include "stream/photo/cells.h"
#include "stream/photo/image_io.h"
#include "stream/photo/noise.h"
#include "stream/photo/plateau.h"
#include "stream/photo/raster.h"
#include "stream/photo/raw.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

constexpr int kBandRows = 64;
static_assert(kBandRows % NoiseEstimator::kBlock == 0);

/// One band as it goes through development.
struct Band {
  int y0 = 0, rows = 0;
  std::vector<float> rgb[3];
  std::vector<std::uint8_t> flags;  ///< MaskBit, saturation not yet dilated
};

/// Where linear values come from: a picture file or a mosaic.
class Source {
 public:
  virtual ~Source() = default;
  virtual void read(Band& band) = 0;
  int width = 0, height = 0;
  bool dilate = false;
  bool white_unknown = false;         ///< nothing says where white is, or values may be clipped below it
  std::array<std::optional<float>, 3> clipped;   ///< values from here on are saturated
  double quantum = 0;  ///< spacing of the linear values near black; 0 for floats
  std::vector<std::string> notes;
};

void set_pixel(Band& band, std::size_t i, const float* rgb) {
  const bool finite = std::isfinite(rgb[0]) && std::isfinite(rgb[1]) && std::isfinite(rgb[2]);
  if (!finite) band.flags[i] |= kNotFinite;
  for (std::size_t c = 0; c < 3; ++c) band.rgb[c][i] = finite ? rgb[c] : 0.0f;
}

/// Whether a picture is transparent somewhere and opaque somewhere else. An alpha channel that is the same all over says nothing.
bool alpha_varies(ImageSource& image, float opaque) {
  const std::size_t num = static_cast<std::size_t>(image.channels());
  std::vector<float> values;
  bool any = false, all = true;
  for (int y = 0; y < image.height() && !(any && !all); y += kBandRows) {
    const int rows = std::min(kBandRows, image.height() - y);
    values.resize(static_cast<std::size_t>(image.width()) * static_cast<std::size_t>(rows) * num);
    image.read_rows(y, rows, values.data());
    for (std::size_t i = num - 1; i < values.size(); i += num) (values[i] >= opaque ? any : all) = values[i] >= opaque;
  }
  return any && !all;
}

class PictureSource : public Source {
 public:
  PictureSource(const fs::path& path, const DevelopOptions& options) : image_(path) {
    const ImageInfo& info = image_.info();
    width = info.width;
    height = info.height;
    notes = info.notes;
    decode_ = options.encoding == Encoding::kSrgb;
    if (decode_ && info.is_float)
      throw Error(concat(path.string(), ": holds floating-point values, which are linear; declared as encoding = \"srgb\", expected \"linear\""));
    const std::string source = info.profile.empty() ? std::string("the file") : concat("its colour profile \"", info.profile, "\"");
    if (!decode_ && info.says_linear == false)
      notes.push_back(concat(source, " says that values are not linear, and they are taken as linear: export the picture with a linear profile, or use encoding = \"srgb\" where its curve is sRGB's"));
    else if (!decode_ && !info.profile.empty() && !info.says_linear)
      notes.push_back(concat(source, " does not say by a curve whether values are linear; they are taken as linear"));
    else if (!decode_ && info.bits == 8)
      notes.push_back("8-bit values are taken as linear; ordinary pictures of 8 bits are not: for those use encoding = \"srgb\"");
    if (decode_ && info.says_linear == true)
      notes.push_back(concat(source, " says that values are linear, and they are decoded with the sRGB curve: use encoding = \"linear\""));
    else if (decode_ && !info.profile.empty() && info.profile.find("sRGB") == std::string::npos)
      notes.push_back(concat("its colour profile is \"", info.profile, "\"; it is decoded with the sRGB curve all the same"));
    dilate = info.bits == 8;
    if (!info.is_float) limit_ = options.saturation * options.white.value_or(1.0);
    if (info.is_float && options.white) limit_ = options.saturation * *options.white;
    white_unknown = !options.white && (info.is_float || (!decode_ && info.bits == 16));
    use_alpha_ = info.has_alpha && !info.alpha_is_assumed && alpha_varies(image_, kOpaque);   // else it may be anything, such as infrared
    if (image_.channels() < 3) notes.push_back("is grey: its red, green and blue are taken as equal");
    if (use_alpha_) notes.push_back("pixels that its alpha channel has as transparent, in full or in part, are left out");
    if (decode_) {
      const std::size_t codes = info.bits == 8 ? 256 : 65536;
      for (std::size_t i = 0; i < codes; ++i) curve_.push_back(static_cast<float>(linear_from_srgb(static_cast<double>(i) / static_cast<double>(codes - 1))));
    }
    if (!info.is_float) quantum = decode_ ? static_cast<double>(curve_[1]) : 1.0 / (std::pow(2.0, info.bits) - 1);
  }

  void read(Band& band) override {
    const std::size_t num = static_cast<std::size_t>(image_.channels()), count = static_cast<std::size_t>(width) * static_cast<std::size_t>(band.rows);
    values_.resize(count * num);
    image_.read_rows(band.y0, band.rows, values_.data());
    const bool grey = num < 3;
    for (std::size_t i = 0; i < count; ++i) {
      const float* in = values_.data() + i * num;
      float rgb[3] = {in[0], in[grey ? 0 : 1], in[grey ? 0 : 2]};
      if (limit_ > 0 && (rgb[0] >= static_cast<float>(limit_) || rgb[1] >= static_cast<float>(limit_) || rgb[2] >= static_cast<float>(limit_))) band.flags[i] |= kSaturated;
      for (std::size_t c = 0; c < 3; ++c)
        if (clipped[c] && rgb[c] >= *clipped[c]) band.flags[i] |= kSaturated;
      if (decode_)
        for (float& v : rgb) v = curve_[static_cast<std::size_t>(std::lround(v * static_cast<float>(curve_.size() - 1)))];
      if (use_alpha_ && !(in[num - 1] >= kOpaque)) rgb[0] = std::numeric_limits<float>::quiet_NaN();   // no data
      set_pixel(band, i, rgb);
    }
  }

 private:
  static constexpr float kOpaque = 0.998f;   // the largest code but one of 8 bits is not: what is transparent in part is mixed with something else
  ImageSource image_;
  bool decode_ = false, use_alpha_ = false;
  double limit_ = 0;
  std::vector<float> curve_, values_;
};

class MosaicSource : public Source {
 public:
  MosaicSource(const fs::path& path, const DevelopOptions& options) : raw_(path), limit_(options.saturation * options.white.value_or(1.0)) {
    width = raw_.info().width_px;
    height = raw_.info().height_px;
    notes = raw_.info().notes;
    quantum = 1 / (raw_.info().white - raw_.info().black);
    dilate = true;
    if (options.find_clipping && !options.white) find_heaps();
  }
  void read(Band& band) override {
    const std::size_t count = static_cast<std::size_t>(width) * static_cast<std::size_t>(band.rows);
    values_.resize(count * 3);
    saturated_.resize(count);
    raw_.read_rows(band.y0, band.rows, limit_, heaps_, values_.data(), saturated_.data());
    for (std::size_t i = 0; i < count; ++i) {
      if (saturated_[i]) band.flags[i] |= kSaturated;
      set_pixel(band, i, values_.data() + 3 * i);
    }
  }

 private:
  void find_heaps() {
    heaps_ = raw_.heaps();
    const double limit_dn = raw_.info().black + limit_ * (raw_.info().white - raw_.info().black);
    std::string levels;
    for (std::size_t c = 0; c < 3; ++c)
      if (heaps_[c] && *heaps_[c] < limit_dn) levels += concat(levels.empty() ? "" : ", ", std::array{"red", "green", "blue"}[c], " from ", *heaps_[c], " on");
    if (!levels.empty()) notes.push_back(concat("raw values heap up below the white level of ", raw_.info().white, " that is known of the camera: taken as clipped (", levels, ")"));
  }

  RawSource raw_;
  double limit_;
  std::array<std::optional<int>, 3> heaps_;
  std::vector<float> values_;
  std::vector<std::uint8_t> saturated_;
};

/// The user's mask, read in step with the photograph.
class MaskSource {
 public:
  MaskSource(const fs::path& path, const fs::path& photograph, int width, int height) {
    std::error_code ignored;
    if (!fs::exists(path, ignored)) throw Error(concat(photograph.string(), ": its mask is missing: ", path.string()));
    image_.emplace(path);
    if (image_->width() != width || image_->height() != height)
      throw Error(concat(path.string(), ": the mask is ", image_->width(), " x ", image_->height(), " pixels, its photograph ", photograph.string(), " is ", width, " x ", height,
                         image_->width() / 2 == width && image_->height() / 2 == height ? " (camera RAW is read at half size: its masks have to be of that size)" : ""));
    use_alpha_ = image_->info().has_alpha && alpha_says_something();
  }

  void apply(Band& band) {
    const std::size_t num = static_cast<std::size_t>(image_->channels()), colours = image_->info().has_alpha ? num - 1 : num;
    load(band.y0, band.rows);
    for (std::size_t i = 0; i < band.flags.size(); ++i) {
      const float* v = values_.data() + i * num;
      float level = use_alpha_ ? v[num - 1] : 0;
      if (!use_alpha_)
        for (std::size_t c = 0; c < colours; ++c) level += v[c] / static_cast<float>(colours);
      brightest_ = std::max(brightest_, level);
      if (level >= 0.5f) band.flags[i] |= kUsableByMask;  // NaN fails
    }
  }

  /// Of all that was applied, as a share of white.
  float brightest() const { return brightest_; }

 private:
  void load(int y0, int rows) {
    values_.resize(static_cast<std::size_t>(image_->width()) * static_cast<std::size_t>(rows) * static_cast<std::size_t>(image_->channels()));
    image_->read_rows(y0, rows, values_.data());
  }
  /// An alpha channel that is white all over says nothing; then the colours are the mask.
  bool alpha_says_something() {
    const std::size_t num = static_cast<std::size_t>(image_->channels());
    for (int y = 0; y < image_->height(); y += kBandRows) {
      load(y, std::min(kBandRows, image_->height() - y));
      for (std::size_t i = num - 1; i < values_.size(); i += num)
        if (!(values_[i] >= 0.5f)) return true;
    }
    return false;
  }
  std::optional<ImageSource> image_;
  bool use_alpha_ = false;
  float brightest_ = 0;
  std::vector<float> values_;
};

/// Grows saturation by a square of 2 * radius + 1 pixels while rows pass: a row leaves once the `radius` rows below it are known.
class RowDilation {
 public:
  RowDilation(int width, int height, int radius) : width_(width), height_(height), radius_(radius), ring_(static_cast<std::size_t>(2 * radius + 1)) {}

  /// Takes the flags of row y and calls out(row, flags) for each row that is complete.
  template <class Out>
  void push(const std::uint8_t* flags, Out&& out) {
    Row& row = slot(pushed_);
    row.flags.assign(flags, flags + width_);
    row.wide.assign(static_cast<std::size_t>(width_), 0);
    for (int x = 0; x < width_; ++x)
      if (flags[x] & kSaturated)
        std::fill(row.wide.begin() + std::max(0, x - radius_), row.wide.begin() + std::min(width_, x + radius_ + 1), std::uint8_t{kSaturated});
    ++pushed_;
    while (left_ < height_ && (left_ + radius_ < pushed_ || pushed_ == height_)) leave(out);
  }

 private:
  struct Row {
    std::vector<std::uint8_t> flags, wide;
  };
  Row& slot(int y) { return ring_[static_cast<std::size_t>(y) % ring_.size()]; }
  template <class Out>
  void leave(Out& out) {
    merged_ = slot(left_).flags;
    for (int y = std::max(0, left_ - radius_); y < std::min(pushed_, left_ + radius_ + 1); ++y)
      for (std::size_t x = 0; x < merged_.size(); ++x) merged_[x] |= slot(y).wide[x];
    out(left_, merged_);
    ++left_;
  }
  int width_, height_, radius_, pushed_ = 0, left_ = 0;
  std::vector<Row> ring_;
  std::vector<std::uint8_t> merged_;
};

std::unique_ptr<Source> open_source(const fs::path& photograph, const DevelopOptions& options) {
  if (options.encoding == Encoding::kRaw) return std::make_unique<MosaicSource>(photograph, options);
  return std::make_unique<PictureSource>(photograph, options);
}

/// Sizes a band for the rows from y0 on and fills it; flags say what can be used.
void read_band(Source& source, std::optional<MaskSource>& mask, int y0, Band& band) {
  band.y0 = y0;
  band.rows = std::min(kBandRows, source.height - y0);
  const std::size_t num_pixels = static_cast<std::size_t>(band.rows) * static_cast<std::size_t>(source.width);
  for (auto& plane : band.rgb) plane.resize(num_pixels);
  band.flags.assign(num_pixels, mask ? std::uint8_t{0} : std::uint8_t{kUsableByMask});
  source.read(band);
  if (mask) mask->apply(band);
}

std::vector<std::uint8_t> usable(const Band& band) {
  std::vector<std::uint8_t> good(band.flags.size());
  std::transform(band.flags.begin(), band.flags.end(), good.begin(), [](std::uint8_t f) { return static_cast<std::uint8_t>(f == kUsableByMask); });
  return good;
}

/// A pass over the picture before it is developed.
void find_clipping(Source& source, std::optional<MaskSource>& mask, Reporter& reporter) {
  std::array<PlateauFinder, 3> finders;
  Band band;
  for (int y0 = 0; y0 < source.height; y0 += kBandRows) {
    reporter.check();
    read_band(source, mask, y0, band);
    const std::vector<std::uint8_t> good = usable(band);
    for (std::size_t c = 0; c < 3; ++c) finders[c].add(band.rgb[c], good);
  }
  constexpr double kLeastCodes = 400;   // below, the values that a plateau is compared with are too few codes
  for (std::size_t c = 0; c < 3; ++c)
    if (const std::optional<float> level = finders[c].level(); level && static_cast<double>(*level) >= kLeastCodes * source.quantum) source.clipped[c] = level;
}

/// What becomes of a picture: each of its pixels, or cells of them. Colours come by bands, and flags by rows, some rows later.
class WorkingImage {
 public:
  WorkingImage(const fs::path& raster, const fs::path& photograph, const Source& source, const DevelopOptions& options)
      : source_(source), options_(options), cell_px_(options.cell_px), cells_(source.width, cell_px_),
        writer_(raster, whole_cells(source.width, photograph), whole_cells(source.height, photograph), {{"r", PlaneType::kF32}, {"g", PlaneType::kF32}, {"b", PlaneType::kF32}, {"mask", PlaneType::kU8}}),
        estimator_(writer_.width(), writer_.height()) {
    result_.width_px = writer_.width();
    result_.height_px = writer_.height();
    result_.notes = source.notes;
    start_band(0);
  }

  void add(const Band& band) {
    if (cell_px_ == 1) return write_colours(band);
    const auto width = static_cast<std::size_t>(source_.width);
    for (std::size_t y = 0; y < static_cast<std::size_t>(band.rows); ++y) {
      Row& row = waiting_.emplace_back();
      for (std::size_t c = 0; c < 3; ++c) row[c].assign(band.rgb[c].begin() + static_cast<std::ptrdiff_t>(y * width), band.rgb[c].begin() + static_cast<std::ptrdiff_t>((y + 1) * width));
    }
  }

  void add_flags(int row, const std::vector<std::uint8_t>& flags) {
    if (cell_px_ == 1) return write_flags(row, flags);
    const Row& colours = waiting_.front();
    if (cells_.push({colours[0], colours[1], colours[2]}, flags)) add_cells();
    waiting_.pop_front();
  }

  DevelopResult commit() {
    writer_.commit();
    return result_;
  }

  void set_noise(DevelopResult& result) const {
    const double pixels = cell_px_ * cell_px_;   // the mean of as many varies by less
    if (options_.noise) {
      result.noise = *options_.noise;
      result.noise.gain /= pixels;
      result.noise.read_sigma /= cell_px_;
      return;
    }
    // Rounding to codes is noise that flat areas hide.
    const double floor = std::max(source_.quantum / std::sqrt(12.0 * pixels), 1e-6);
    if (const auto fitted = estimator_.fit()) {
      result.noise = *fitted;
    } else {
      result.noise = {0, 0.01, true};
      result.notes.push_back("too few plain areas to estimate its noise; a standard deviation of 0.01 is assumed");
    }
    result.noise.read_sigma = std::max(result.noise.read_sigma, floor);
  }

 private:
  using Row = std::array<std::vector<float>, 3>;

  int whole_cells(int pixels, const fs::path& photograph) const {
    if (pixels < cell_px_) throw Error(concat(photograph.string(), ": is ", source_.width, " x ", source_.height, " pixels, less than one cell of ", cell_px_, " x ", cell_px_, " pixels"));
    return pixels / cell_px_;
  }

  void write_colours(const Band& band) {
    if (!options_.noise) estimator_.add_band(band.y0, band.rows, band.rgb, usable(band));
    constexpr std::array<const char*, 3> kPlanes = {"r", "g", "b"};
    for (std::size_t c = 0; c < 3; ++c) writer_.write_rows(kPlanes[c], band.y0, std::span<const float>(band.rgb[c]));
  }

  void write_flags(int row, const std::vector<std::uint8_t>& flags) {
    writer_.write_rows("mask", row, std::span<const std::uint8_t>(flags));
    for (const std::uint8_t m : flags) {
      result_.pixels_used += m == kUsableByMask;
      result_.pixels_masked += !(m & kUsableByMask);
      result_.pixels_saturated += (m & kSaturated) != 0;
      result_.pixels_not_finite += (m & kNotFinite) != 0;
    }
  }

  void start_band(int y0) {
    band_.y0 = y0;
    band_.rows = 0;
    for (auto& plane : band_.rgb) plane.clear();
    band_.flags.clear();
  }

  // The row of cells that is complete.
  void add_cells() {
    for (std::size_t c = 0; c < 3; ++c) band_.rgb[c].insert(band_.rgb[c].end(), cells_.rgb(c).begin(), cells_.rgb(c).end());
    band_.flags.insert(band_.flags.end(), cells_.flags().begin(), cells_.flags().end());
    write_flags(band_.y0 + band_.rows, cells_.flags());
    ++band_.rows;
    if (band_.rows < kBandRows && band_.y0 + band_.rows < writer_.height()) return;
    write_colours(band_);
    start_band(band_.y0 + band_.rows);
  }

  const Source& source_;
  const DevelopOptions& options_;
  const int cell_px_;
  Cells cells_;
  RasterWriter writer_;
  NoiseEstimator estimator_;
  DevelopResult result_;
  Band band_;                  ///< rows of cells that are complete
  std::deque<Row> waiting_;    ///< rows of the picture whose flags are not known yet
};

}  // namespace

Encoding encoding_from_name(const std::string& name) {
  if (name == "linear") return Encoding::kLinear;
  if (name == "srgb") return Encoding::kSrgb;
  if (name == "raw") return Encoding::kRaw;
  throw UsageError(concat("encoding \"", name, "\" is not known, expected linear, srgb or raw"));
}

PictureSize working_size(const fs::path& photograph, Encoding encoding) {
  if (encoding == Encoding::kRaw) {
    const auto [width, height] = RawSource::sensor_size_px(photograph);
    return {width / RawSource::kCellPx, height / RawSource::kCellPx, width, height};
  }
  const ImageSource image(photograph);
  return {image.width(), image.height(), image.width(), image.height()};
}

DevelopResult develop(const fs::path& photograph, const DevelopOptions& options, const fs::path& out_raster, Reporter& reporter) {
  if (!(options.saturation > 0) || options.dilate_px < 0 || options.dilate_px > 64 || (options.white && !(*options.white > 0)) || options.cell_px < 1 || options.cell_px > 64)
    throw std::invalid_argument("develop: saturation and white must be positive, dilate_px 0 to 64, cell_px 1 to 64");
  const std::unique_ptr<Source> source = open_source(photograph, options);
  std::optional<MaskSource> mask;
  if (options.mask) mask.emplace(*options.mask, photograph, source->width, source->height);
  WorkingImage image(out_raster, photograph, *source, options);
  RowDilation dilation(source->width, source->height, source->dilate ? options.dilate_px : 0);
  reporter.begin(concat("develop ", photograph.filename().string()), static_cast<std::uint64_t>(source->height), "rows");
  if (options.find_clipping && source->white_unknown) find_clipping(*source, mask, reporter);
  std::uint64_t clipped = 0;
  Band band;
  for (int y0 = 0; y0 < source->height; y0 += kBandRows) {
    reporter.check();
    read_band(*source, mask, y0, band);
    clipped += static_cast<std::uint64_t>(std::count(band.flags.begin(), band.flags.end(), kUsableByMask | kSaturated));
    image.add(band);
    for (int y = 0; y < band.rows; ++y)
      dilation.push(band.flags.data() + static_cast<std::size_t>(y) * static_cast<std::size_t>(source->width),
                    [&](int row, const std::vector<std::uint8_t>& flags) { image.add_flags(row, flags); });
    reporter.progress(static_cast<std::uint64_t>(band.y0 + band.rows));
  }
  DevelopResult result = image.commit();
  if (clipped > 0 && std::any_of(source->clipped.begin(), source->clipped.end(), [](const auto& level) { return level.has_value(); }))
    result.notes.push_back(concat(photograph.filename().string(), ": ", clipped, " pixels share the brightest value of the file: taken as clipped, they count as saturated"));
  if (mask && mask->brightest() < 0.5f)
    result.notes.push_back(concat("its mask leaves nothing: white is what is used, and the brightest place of the mask is ", std::lround(255 * mask->brightest()), " of 255"));
  image.set_noise(result);
  reporter.end();
  return result;
}

}  // namespace chiaro::stream
