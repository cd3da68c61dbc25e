/// k nearest of a set of points, by kd-tree (nanoflann).
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>

#include "stream/base/types.h"

namespace chiaro {

/// Thread-safe queries; the same points in the same order give the same answers.
class NearestPoints {
 public:
  explicit NearestPoints(std::span<const Vec3f> points);  ///< keeps the span: the points must outlive it
  NearestPoints(NearestPoints&&) noexcept;
  ~NearestPoints();
  /// Fills up to k indices and squared distances, nearest first; returns how many.
  std::size_t find(const Vec3f& point, std::size_t k, std::uint32_t* index, float* distance2) const;
  /// Most memory that a set of points takes beside the points themselves.
  static std::uint64_t bytes_per_point() { return 16; }

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace chiaro
