#include "tools/compare_picture.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "stream/photo/image_io.h"

namespace chiaro::tools {
namespace {

constexpr int kSheetPx = 1600, kMostHighPx = 4 * kSheetPx, kGapPx = 12, kScalePx = 16;
constexpr std::array<std::uint8_t, 3> kBackground{40, 40, 40}, kNotCompared{128, 128, 128};

double extent_along(const Vec3d& axis, const Vec3d& size) { return axis.cwiseAbs().dot(size); }

}  // namespace

std::array<std::uint8_t, 3> DifferencePicture::colour(double difference, double range) {
  if (!std::isfinite(difference)) return kNotCompared;
  // Two hues of like lightness that colour-blind eyes tell apart, from Brewer's red-blue scale.
  constexpr std::array<double, 3> kMiddle{247, 247, 247}, kDarker{33, 102, 172}, kBrighter{178, 24, 43};
  const double t = std::min(1.0, std::abs(difference) / range);
  const auto& end = difference < 0 ? kDarker : kBrighter;
  std::array<std::uint8_t, 3> result;
  for (std::size_t c = 0; c < 3; ++c) result[c] = static_cast<std::uint8_t>(std::lround(kMiddle[c] + t * (end[c] - kMiddle[c])));
  return result;
}

DifferencePicture::DifferencePicture(const Box3d& bounds, std::uint64_t num_points, double range) : range_(range) {
  const Vec3d x = Vec3d::UnitX(), y = Vec3d::UnitY(), z = Vec3d::UnitZ();
  const std::array<std::array<Vec3d, 3>, 6> axes{{{x, -z, y}, {y, -z, -x}, {-x, -z, -y}, {-y, -z, x}, {x, -y, -z}, {x, y, z}}};
  const double largest = std::max(1e-9, (bounds.max - bounds.min).maxCoeff());
  const Vec3d size = (bounds.max - bounds.min).cwiseMax(1e-3 * largest);   // flat clouds have sides too
  pitch_ = std::max(2 * (size.x() + size.y()) / (kSheetPx - 5 * kGapPx), size.z() / kMostHighPx);   // towers stay narrow
  // Points as large as they would be if they covered the box evenly: fewer holes to look through.
  const double area = 2 * (size.x() * size.y() + size.y() * size.z() + size.z() * size.x());
  const double spacing = std::sqrt(area / static_cast<double>(std::max<std::uint64_t>(1, num_points)));
  half_ = static_cast<int>(std::clamp(std::lround(spacing / pitch_), 0L, 8L));
  int at_x = kGapPx, at_y = kGapPx, row = 0;
  for (std::size_t i = 0; i < views_.size(); ++i) {
    View& v = views_[i];
    v.right = axes[i][0];
    v.down = axes[i][1];
    v.ahead = axes[i][2];
    v.width = 1 + static_cast<int>(extent_along(v.right, size) / pitch_);
    v.height = 1 + static_cast<int>(extent_along(v.down, size) / pitch_);
    v.right0 = std::min(v.right.dot(bounds.min), v.right.dot(bounds.max));
    v.down0 = std::min(v.down.dot(bounds.min), v.down.dot(bounds.max));
    v.ahead0 = std::min(v.ahead.dot(bounds.min), v.ahead.dot(bounds.max));
    if (i == 4) {   // top and bottom stand under the sides
      at_x = kGapPx;
      at_y += row + kGapPx;
      row = 0;
    }
    v.x0 = at_x;
    v.y0 = at_y;
    at_x += v.width + kGapPx;
    row = std::max(row, v.height);
    width_ = std::max(width_, at_x);
  }
  height_ = at_y + row + kGapPx + kScalePx + kGapPx;
  const std::size_t n = static_cast<std::size_t>(width_) * static_cast<std::size_t>(height_);
  depth_.assign(n, std::numeric_limits<float>::infinity());
  pixels_.resize(3 * n);
  for (std::size_t i = 0; i < n; ++i) std::copy(kBackground.begin(), kBackground.end(), &pixels_[3 * i]);
  draw_scale();
}

void DifferencePicture::draw_scale() {
  for (int x = kGapPx; x < width_ - kGapPx; ++x) {
    const double t = 2 * (static_cast<double>(x - kGapPx) + 0.5) / (width_ - 2 * kGapPx) - 1;
    const auto c = colour(t * range_, range_);
    for (int y = height_ - kGapPx - kScalePx; y < height_ - kGapPx; ++y) std::copy(c.begin(), c.end(), &pixels_[3 * (static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x))]);
  }
}

void DifferencePicture::add(const Vec3d& position, double difference) {
  if (!position.allFinite()) return;
  const auto c = colour(difference, range_);
  for (const View& v : views_) {
    const int cx = static_cast<int>((v.right.dot(position) - v.right0) / pitch_), cy = static_cast<int>((v.down.dot(position) - v.down0) / pitch_);
    const auto depth = static_cast<float>((v.ahead.dot(position) - v.ahead0) / pitch_);   // a float is too coarse for world coordinates
    for (int y = std::max(0, cy - half_); y <= std::min(v.height - 1, cy + half_); ++y)
      for (int x = std::max(0, cx - half_); x <= std::min(v.width - 1, cx + half_); ++x) {
        const std::size_t i = static_cast<std::size_t>(v.y0 + y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(v.x0 + x);
        if (!(depth < depth_[i])) continue;
        depth_[i] = depth;
        std::copy(c.begin(), c.end(), &pixels_[3 * i]);
      }
  }
}

std::array<std::uint8_t, 3> DifferencePicture::pixel(int x, int y) const {
  const std::size_t i = 3 * (static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x));
  return {pixels_[i], pixels_[i + 1], pixels_[i + 2]};
}

void DifferencePicture::write(const std::filesystem::path& file) const { stream::write_png_srgb8(file, width_, height_, pixels_); }

}  // namespace chiaro::tools
