/// One surfel read in one photograph: is it visible there, and what does the photograph say about it.
#pragma once
#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "blend/photo_window.h"
#include "stream/photo/camera.h"
#include "stream/store/store.h"

namespace chiaro::blend {

struct Sample {
  float weight = 0, sigma = 0, shared = 0;
  Vec3f low = Vec3f::Zero(), high = Vec3f::Zero();
  float footprint = 0;   ///< side of a square as large as the pixel is on the surface, project units
  std::array<Vec3f, kMostWider> wider{Vec3f::Zero(), Vec3f::Zero()};   ///< means over wider surroundings than `low`, as many as the window has
};

/// How far a surfel may lie from what the pixel sees and still be the same surface: the discs' own size, and the depth that one pixel spans at this
/// slant. Local lengths only, so that the unit and the scale of the model do not matter.
float visibility_tolerance(float surfel_radius, float pixel_radius, float footprint, float cosv);

/// A photograph as surfels are read in it.
class SurfelReader {
 public:
  /// shift_px: how far beside the surfel's own pixel the photograph shows it. Surfels belong to image rows [y0, y1), or are not read. References outlive this.
  SurfelReader(const stream::Camera& camera, const PhotoWindow& window, const Vec2f& shift_px, int y0, int y1)
      : camera_(camera), window_(window), shift_px_(shift_px), centre_in_world_(camera.pose.centre_in_world()), y0_(y0), y1_(y1) {}

  /// The surfel's own pixel; nullopt outside the rows or the image.
  std::optional<Vec2d> project(const stream::Surfel& surfel) const;
  /// Compares the surfel's distance with the tangent planes of the four pixels around it, and reads bilinearly from those that agree; pixels beyond a depth
  /// edge take no part. Where the photograph is read beside, the planes of the pixels there are carried on to the surfel.
  /// nullopt: hidden, turned away (oriented normals), or nothing usable there.
  std::optional<Sample> read(const stream::Surfel& surfel, const Vec2d& pixel) const;
  std::optional<Sample> read(const stream::Surfel& surfel) const {
    const auto pixel = project(surfel);
    return pixel ? read(surfel, *pixel) : std::nullopt;
  }

 private:
  const stream::Camera& camera_;
  const PhotoWindow& window_;
  Vec2f shift_px_;
  Vec3d centre_in_world_;
  int y0_, y1_;
};

/// Calls reading(slot, reader's index, sample) for all readings of a chunk: surfel by surfel, and of each in the order of readers.
template <class Reading>
void for_readings(const stream::Chunk& chunk, std::span<const SurfelReader> readers, const Reading& reading) {
  for (std::uint32_t slot = 0; slot < chunk.count; ++slot) {
    const stream::Surfel surfel = chunk.surfel(slot);
    for (std::size_t i = 0; i < readers.size(); ++i)
      if (const auto sample = readers[i].read(surfel)) reading(slot, i, *sample);
  }
}

/// Image rows that a box may project to: half-open, empty if it is not in view. Conservative: the whole image where the box reaches behind the camera.
struct RowSpan {
  int y0 = 0, y1 = 0;
  bool overlaps(int a, int b) const { return y0 < b && a < y1; }
};
RowSpan rows_of_box(const stream::Camera& camera, const Box3d& box);

}  // namespace chiaro::blend
