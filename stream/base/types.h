/// Small vectors, ids and pixel rectangles used by every folder.
#pragma once
#include <Eigen/Core>
#include <Eigen/Geometry>
#include <cstdint>
#include <functional>

namespace chiaro {

using Vec2f = Eigen::Vector2f;
using Vec2d = Eigen::Vector2d;
using Vec3f = Eigen::Vector3f;
using Vec3d = Eigen::Vector3d;
using Mat3d = Eigen::Matrix3d;

/// Axis-aligned box; empty while min > max.
struct Box3d {
  Vec3d min = Vec3d::Constant(1e300);
  Vec3d max = Vec3d::Constant(-1e300);
  bool empty() const { return !(min.x() <= max.x()); }
  void extend(const Vec3d& p) {
    min = min.cwiseMin(p);
    max = max.cwiseMax(p);
  }
};

/// Half-open rectangle of pixels: columns [x0, x1), rows [y0, y1).
struct PixelRect {
  int x0 = 0, y0 = 0, x1 = 0, y1 = 0;
  int width() const { return x1 - x0; }
  int height() const { return y1 - y0; }
};

/// One surfel of a store: chunk number in the store's index and slot in that chunk (a chunk holds at most 65 536 surfels).
struct SurfelId {
  std::uint32_t chunk = kNone;
  std::uint16_t slot = 0;
  static constexpr std::uint32_t kNone = 0xffffffffu;
  bool valid() const { return chunk != kNone; }
  std::uint64_t packed() const { return (std::uint64_t{chunk} << 16) | slot; }
  static SurfelId from_packed(std::uint64_t v) { return {static_cast<std::uint32_t>(v >> 16), static_cast<std::uint16_t>(v & 0xffffu)}; }
  friend bool operator==(const SurfelId&, const SurfelId&) = default;
};

}  // namespace chiaro
