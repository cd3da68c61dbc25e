/// A cell in a tangent plane. Internal to stream/store.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

namespace chiaro::stream {

/// A convex polygon around the origin of the tangent plane, clipped by half-planes. Fixed room: each cut adds at most one corner.
class TangentCell {
 public:
  explicit TangentCell(float half_size) : box_(half_size * 0.9999f) {
    corners_[0][0] = {-half_size, -half_size};
    corners_[0][1] = {half_size, -half_size};
    corners_[0][2] = {half_size, half_size};
    corners_[0][3] = {-half_size, half_size};
    size_ = 4;
    measure();
  }
  float farthest_squared() const { return farthest_squared_; }
  bool bounded() const { return bounded_; }
  float farthest_bounded_squared() const { return farthest_bounded_squared_; }
  /// Calls visit(x, y) for each corner of the cell.
  template <class Visit>
  void for_corners(const Visit& visit) const {
    for (int i = 0; i < size_; ++i) visit(corners_[now_][static_cast<std::size_t>(i)].x, corners_[now_][static_cast<std::size_t>(i)].y);
  }

  // Would clip() change anything?
  bool cuts(float u, float v, float distance) const {
    const Corner* corner = corners_[now_].data();
    float most = -1;
    for (int i = 0; i < size_; ++i) most = std::max(most, u * corner[i].x + v * corner[i].y);
    return most > distance;
  }

  // Keeps the points with x * u + y * v <= distance.
  void clip(float u, float v, float distance) {
    if (size_ + 1 >= kMost) return;
    std::array<float, kMost> side;
    const Corner* corner = corners_[now_].data();
    for (int i = 0; i < size_; ++i) side[i] = u * corner[i].x + v * corner[i].y - distance;
    Corner* kept = corners_[1 - now_].data();
    int n = 0;
    for (int i = 0; i < size_; ++i) {
      const int j = i + 1 == size_ ? 0 : i + 1;
      if (side[i] <= 0) kept[n++] = corner[i];
      if ((side[i] <= 0) != (side[j] <= 0)) {
        const float t = side[i] / (side[i] - side[j]);
        kept[n++] = {corner[i].x + t * (corner[j].x - corner[i].x), corner[i].y + t * (corner[j].y - corner[i].y)};
      }
    }
    now_ = 1 - now_;
    size_ = n;
    measure();
  }

 private:
  static constexpr int kMost = 40;
  struct Corner {
    float x, y;
  };
  void measure() {
    farthest_squared_ = farthest_bounded_squared_ = 0;
    bounded_ = true;
    const Corner* corner = corners_[now_].data();
    for (int i = 0; i < size_; ++i) {
      const float d = corner[i].x * corner[i].x + corner[i].y * corner[i].y;
      const bool open = std::max(std::abs(corner[i].x), std::abs(corner[i].y)) >= box_;
      farthest_squared_ = std::max(farthest_squared_, d);
      bounded_ &= !open;
      farthest_bounded_squared_ = std::max(farthest_bounded_squared_, open ? 0.0f : d);
    }
  }
  float box_;
  std::array<std::array<Corner, kMost>, 2> corners_;
  int now_ = 0, size_ = 0;
  float farthest_squared_ = 0, farthest_bounded_squared_ = 0;
  bool bounded_ = false;
};

}  // namespace chiaro::stream
