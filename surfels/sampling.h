/// How finely photographs sample the cloud.
#pragma once
#include <vector>

#include "stream/photo/camera.h"
#include "stream/store/store.h"

namespace chiaro::surfels {

/// Places on the cloud and how far apart its points are there.
class SpacingSamples {
 public:
  /// Of a cloud of few leaves, some surfels of each; of others the middle of each leaf's box, which is near to the surface then. throws Error where the store is damaged.
  explicit SpacingSamples(const stream::Store& store);

  /// How far apart neighbouring points lie in a photograph, in pixels: nine in ten of those that may be in it, hidden or not, lie farther apart. 0 where none is in the picture.
  double spacing_px(const stream::Camera& camera) const;

 private:
  struct Sample {
    Vec3d position_in_world;
    double spacing, points;
  };
  std::vector<Sample> samples_;
};

/// Side of the cells of pixels that may be taken as one: points lie four cells apart and more, and four million cells stay, beyond which time and disk matter more than
/// what is painted finer than that. At most 64.
int cell_for(double spacing_px, int width_px, int height_px);
/// The same for a cloud however coarse.
int most_cell(int width_px, int height_px);

}  // namespace chiaro::surfels
