#include "tools/report_weights.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace chiaro::tools {
namespace {

/// Rows of a band with its halo that take about this much; the least that blending itself takes of them.
int rows_within(int width, int halo, int height) {
  constexpr std::uint64_t kBandBytes = 64u << 20;
  constexpr int kLeastRows = 16;
  const std::uint64_t row_bytes = static_cast<std::uint64_t>(width) * blend::window_bytes_per_pixel();
  return static_cast<int>(std::clamp<std::int64_t>(static_cast<std::int64_t>(kBandBytes / row_bytes) - 2 * halo, kLeastRows, std::max(kLeastRows, height)));
}

}  // namespace

float shown_weight(float worth, bool is_ratio) {
  if (!(worth > 0)) return 0;
  return is_ratio ? worth / (1 + worth) : std::min(worth, 1.0f);
}

std::vector<ReportPicture> draw_weights(const RunFolder& folder, const stream::Camera& camera, const blend::WindowOptions& options, int max_width, Reporter& report) {
  const std::string& key = camera.photograph;
  const blend::PhotographRasters rasters(camera.lens, folder.gbuffer(key), folder.albedo(key), folder.radiance(key));
  const int step = (rasters.width() + max_width - 1) / max_width, across = (rasters.width() + step - 1) / step, down = (rasters.height() + step - 1) / step;
  const int halo = blend::halo_rows(options, blend::footprints(rasters).smallest());
  const int band = (rows_within(rasters.width(), halo, rasters.height()) + step - 1) / step * step;   // bands begin at rows that are drawn
  constexpr std::size_t kProduct = blend::kCriteria.size();
  std::vector<std::vector<double>> values(kProduct + 1);
  for (int y0 = 0; y0 < rasters.height(); y0 += band) {
    report.check();
    for (const blend::SeenEvidence& seen : blend::load_evidence(rasters, camera, y0, std::min(rasters.height(), y0 + band), step, halo, options)) {
      float product = seen.is_read ? 1 : 0;
      for (std::size_t c = 0; c < kProduct; ++c) {
        const blend::Criterion& criterion = blend::kCriteria[c];
        const float worth = criterion.worth(seen.evidence, options.scale());
        product *= worth;
        values[c].push_back(seen.is_on_surface ? static_cast<double>(shown_weight(worth, criterion.is_ratio)) : NAN);
      }
      values[kProduct].push_back(seen.is_on_surface ? static_cast<double>(shown_weight(product, true)) : NAN);
    }
  }
  std::vector<ReportPicture> pictures;
  for (std::size_t c = 0; c <= kProduct; ++c)
    pictures.push_back({c < kProduct ? std::string(blend::kCriteria[c].name) : kWeightProduct, across, down, png_scale(across, down, values[c], false)});
  return pictures;
}

}  // namespace chiaro::tools
