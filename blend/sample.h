/// One surfel read in one photograph: is it visible there, and what does the photograph say about it.
#pragma once
#include <algorithm>
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

/// A surfel before a camera, where nothing but what lies before it may hide it.
struct SurfelView {
  Vec2d pixel;
  Vec3f direction;   ///< from the camera, of unit length
  float distance = 0, radius = 0;
};

/// The pixels around a place that may be read, with their bilinear shares.
struct FourPixels {
  std::array<const WindowPixel*, 4> pixel{};
  std::array<float, 4> share{}, du{}, dv{};   ///< du, dv: pixels from the surfel's own place
  float most_weight = 0;                      ///< that a reading can have: of all four
};

/// A photograph as surfels are read in it.
class SurfelReader {
 public:
  /// shift_px: how far beside the surfel's own pixel the photograph shows it. Surfels belong to image rows [y0, y1), or are not read. References outlive this.
  SurfelReader(const stream::Camera& camera, const PhotoWindow& window, const Vec2f& shift_px, int y0, int y1);

  /// nullopt: turned away (oriented normals), or outside the rows or the image.
  std::optional<SurfelView> before(const stream::Surfel& surfel) const;
  FourPixels around(const SurfelView& view) const { return pixels_around(view, view.pixel + shift_px_.cast<double>()); }
  /// Compares the surfel's distance with the tangent planes of the four pixels around it, and reads bilinearly from those that agree; pixels beyond a depth
  /// edge take no part. Where the photograph is read beside, the planes of the pixels there are carried on to the surfel.
  /// four: around(view). nullopt: hidden, or nothing usable there.
  std::optional<Sample> read(const SurfelView& view, const FourPixels& four) const;
  std::optional<Sample> read(const stream::Surfel& surfel) const {
    const auto view = before(surfel);
    return view ? read(*view, around(*view)) : std::nullopt;
  }

 private:
  FourPixels pixels_around(const SurfelView& view, const Vec2d& place) const;

  const stream::Camera& camera_;
  const PhotoWindow& window_;
  Vec2f shift_px_;
  Vec3d centre_in_world_;
  Vec3f right_in_world_;   // the image's x axis
  bool is_pinhole_;
  int y0_, y1_;
};

/// Surfels that readings come from together: few enough to stay in the nearest cache.
inline constexpr std::uint32_t kSurfelsTogether = 256;

/// Calls reading(slot, reader's index, sample) for all readings of a chunk, of each surfel in the order of readers: photograph by photograph over the surfels
/// [k kSurfelsTogether, (k + 1) kSurfelsTogether) before the next ones, so that what is known of a photograph and its pixels is at hand.
/// wanted(slot, reader's index, weight): whether a reading of that weight or less is to be made.
template <class Reading, class Wanted>
void for_readings(const stream::Chunk& chunk, std::span<const SurfelReader> readers, const Reading& reading, const Wanted& wanted) {
  std::vector<stream::Surfel> surfels;
  for (std::uint32_t first = 0; first < chunk.count; first += kSurfelsTogether) {
    surfels.clear();
    for (std::uint32_t slot = first; slot < std::min(chunk.count, first + kSurfelsTogether); ++slot) surfels.push_back(chunk.surfel(slot));
    for (std::size_t i = 0; i < readers.size(); ++i)
      for (std::uint32_t k = 0; k < surfels.size(); ++k) {
        const auto view = readers[i].before(surfels[k]);
        if (!view) continue;
        const FourPixels four = readers[i].around(*view);
        if (!(four.most_weight > 0) || !wanted(first + k, i, four.most_weight)) continue;
        if (const auto sample = readers[i].read(*view, four)) reading(first + k, i, *sample);
      }
  }
}
template <class Reading>
void for_readings(const stream::Chunk& chunk, std::span<const SurfelReader> readers, const Reading& reading) {
  for_readings(chunk, readers, reading, [](std::uint32_t, std::size_t, float) { return true; });
}

/// Image rows that a box may project to: half-open, empty if it is not in view. Conservative: the whole image where the box reaches behind the camera.
struct RowSpan {
  int y0 = 0, y1 = 0;
  bool overlaps(int a, int b) const { return y0 < b && a < y1; }
};
RowSpan rows_of_box(const stream::Camera& camera, const Box3d& box);

}  // namespace chiaro::blend
