/// One surfel read in one photograph: is it visible there, and what does the photograph say about it.
#pragma once
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "blend/photo_window.h"
#include "stream/photo/camera.h"
#include "stream/store/store.h"

namespace chiaro::blend {

struct Sample {
  std::uint32_t slot = 0;
  float weight = 0, sigma = 0, shared = 0;
  Vec3f low = Vec3f::Zero(), high = Vec3f::Zero();
  float footprint = 0;   ///< side of a square as large as the pixel is on the surface, project units
};

/// How far a surfel may lie from what the pixel sees and still be the same surface: the discs' own size, and the depth that one pixel spans at this
/// slant. Local lengths only, so that the unit and the scale of the model do not matter.
float visibility_tolerance(float surfel_radius, float pixel_radius, float footprint, float cosv);

/// Projects the surfel through the lens, compares its distance with the tangent planes of the four pixels around it, and reads bilinearly from those
/// that agree; pixels beyond a depth edge take no part. nullopt: outside the image, hidden, turned away (oriented normals), or nothing usable there.
std::optional<Vec2d> project_surfel(const stream::Camera& camera, const stream::Surfel& surfel);
/// shift_px: how far beside the surfel's own pixel the photograph shows it; the planes of the pixels there are carried on to the surfel.
std::optional<Sample> read_surfel(const stream::Camera& camera, const stream::Surfel& surfel, const Vec2d& pixel, const Vec2f& shift_px, const PhotoWindow& window);

/// All readings of a chunk whose surfels belong to image rows [y0, y1), by slot.
std::vector<Sample> sample_chunk(const stream::Chunk& chunk, const stream::Camera& camera, const Vec2f& shift_px, const PhotoWindow& window, int y0, int y1);

/// Image rows that a box may project to: half-open, empty if it is not in view. Conservative: the whole image where the box reaches behind the camera.
struct RowSpan {
  int y0 = 0, y1 = 0;
  bool overlaps(int a, int b) const { return y0 < b && a < y1; }
};
RowSpan rows_of_box(const stream::Camera& camera, const Box3d& box);

}  // namespace chiaro::blend
