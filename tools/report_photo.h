/// One photograph of a finished run, measured and shrunk to pictures, by bands of rows: memory does not depend on its size.
#pragma once
#include <array>
#include <cstdint>
#include <memory>
#include <string>
#include <type_traits>
#include <vector>

#include "stream/base/report.h"
#include "tools/report_palette.h"
#include "tools/run_folder.h"

namespace chiaro::tools {

/// Counts of positive values in bins of 0.5 %; what is not positive counts as the least.
class LogHistogram {
 public:
  void add(double value);
  void add(const LogHistogram& other);
  std::uint64_t count() const { return count_; }
  /// Value below which a share of the counts lies, within 0.5 %; NaN without counts.
  double quantile(double share) const;

 private:
  static constexpr int kBinsPerOctave = 128, kLeastLog2 = -40, kOctaves = 80;
  std::vector<std::uint64_t> bins_ = std::vector<std::uint64_t>(kBinsPerOctave * kOctaves);
  std::uint64_t count_ = 0;
};

/// Files of one photograph: work/photographs/KEY rasters and photographs/KEY pictures.
class ReportPhoto {
 public:
  /// throws Error naming the file if one is missing or damaged, or two differ in size. with_light: light.exr is meant to be there.
  ReportPhoto(const RunFolder& folder, const std::string& key, bool with_light);
  ReportPhoto(ReportPhoto&&) noexcept;
  ~ReportPhoto();
  int width() const;
  int height() const;
  const std::string& key() const;

  struct Band;
  struct Impl;
  Impl& impl() { return *impl_; }

 private:
  std::unique_ptr<Impl> impl_;
};

/// Values of all three channels on pixels that can be used: what the exposure is chosen from.
LogHistogram radiance_histogram(ReportPhoto& photo);

/// Values of pixels, for the ranges of the pictures. 330 KB: one for all photographs together.
struct PictureRanges {
  LogHistogram difference, sigma, indirect, ambient;
  void add(const PictureRanges& other);
};

/// Differences and PSNR are over the pixels that have a prediction; values divided by `white`.
struct PhotoMeasures {
  std::uint64_t pixels = 0;
  std::uint64_t usable = 0;        ///< allowed by the mask, not saturated, finite
  std::uint64_t on_cloud = 0;      ///< usable, and a ray meets the cloud
  std::uint64_t solved = 0;        ///< has an albedo
  std::uint64_t predicted = 0;     ///< solved, and the blended result has an albedo there
  double psnr_linear = 0;          ///< dB, peak = white; infinite where equal
  double psnr_srgb = 0;            ///< dB of sRGB-encoded values, peak 1
  double ssim = 0;                 ///< of sRGB-encoded luminance
  double residual_rms = 0;         ///< over white
  double residual_relative = 0;    ///< rms of the residual over rms of the photograph
  double median_sigma = 0;         ///< of solved pixels
  std::array<double, 3> shares{};  ///< mean of direct, indirect, ambient over solved pixels; NaN without light pictures
};
static_assert(std::is_trivially_copyable_v<PhotoMeasures>);   // one for each photograph is held: 150 bytes, and nothing behind them
/// ranges: the photograph's values are added.
PhotoMeasures measure(ReportPhoto& photo, double white, PictureRanges& ranges, Reporter& report);

/// Scales that all photographs of a report share.
struct PictureScales {
  double white = 1;         ///< radiance that shows as white
  double albedo_white = 1;  ///< albedo that shows as white
  double difference = 0.1;  ///< end of the scale: mean over channels of |photograph - prediction| over white
  double sigma = 0.1;       ///< end of the scale: relative standard deviation
  double indirect = 1, ambient = 1;  ///< ends of the scales: share of the irradiance
  double edge_px = 16;      ///< depth edges are marked up to this distance
};

struct ReportPicture {
  std::string kind;  ///< photograph, prediction, albedo, difference, direct, indirect, ambient, sigma, coverage
  int width = 0, height = 0;
  std::string png;
};

/// All pictures, at most max_width pixels wide: means over square blocks of pixels that have a value; blocks less than half covered show no_value().
std::vector<ReportPicture> draw(ReportPhoto& photo, const PictureScales& scales, int max_width, Reporter& report);

}  // namespace chiaro::tools
