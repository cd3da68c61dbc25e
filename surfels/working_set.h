/// Which chunks a photograph needs: an octree cut at about a pixel inside its frustum, coarser outside it (where surfels only reflect and occlude),
/// and nothing that is hidden.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/report.h"
#include "stream/photo/camera.h"
#include "stream/store/store.h"

namespace chiaro::surfels {

/// A view whose pixels decide the level of detail.
struct View {
  stream::Lens lens;
  stream::Pose pose;
  PixelRect rect;                     ///< the part of the image that is looked at
  std::vector<Vec3d> lights_in_world; ///< points (the flash) from which the visible surface is seen too, wherever they stand: their occluders are kept
};

struct CutOptions {
  double pixel_error = 1.0;        ///< surfel spacing allowed inside the frustum, in pixels
  double margin_px = 16;           ///< the frustum is grown by this
  bool cull_hidden = true;         ///< test chunks front to back against a coarse depth pyramid
  std::uint64_t max_bytes = 0;     ///< of geometry; 0 = no limit
};

struct WorkingSet {
  std::vector<std::uint32_t> chunks;  ///< store indices, ascending
  std::uint64_t surfels = 0;
  std::uint64_t bytes = 0;            ///< geometry plus acceleration structure, estimated
  std::uint64_t chunks_hidden = 0;    ///< left out because something nearer covers them
  std::uint64_t chunks_outside = 0;   ///< outside the frustum
  bool complete = true;               ///< false: max_bytes was reached, split the rectangle
};

/// The cut for rays that start in the view's pixels and for shadow rays to its lights. The level of a chunk does not depend on the rectangle: it is that of its distance from the
/// camera, or of twice its distance from a light where that is less. So the edge of a shadow is known to two pixels or so where the light is no farther from what it lights than the
/// camera is; else to as many more as it is farther, for what stands nearer to the light than to the surface (the G-buffer's `penumbra` says how many).
WorkingSet select_visible(const stream::Store& store, const View& view, const CutOptions& options, MemoryBudget& budget, Reporter& report);

/// A cut of the whole scene for light transport: finest where the photographs see most detail (the level is chosen by solid angle seen from the
/// nearest camera, equalised over the cut). Levels come in steps, of eight and more at the root: the cut is as near to `wanted` surfels as the steps allow,
/// by ratio, and never above `most`, where the root itself is not.
WorkingSet select_proxy(const stream::Store& store, std::span<const View> views, std::uint64_t wanted, std::uint64_t most);

}  // namespace chiaro::surfels
