/// Albedo of a new view's pixels as the photographs show it: they resolve paint edges that lie between the points of the cloud.
///
/// A pixel's surface point is looked up in every photograph that sees it (depth in its G-buffer agrees, not at an edge). The mean of their albedos is weighted
/// by how well each resolves the surface (cosine / footprint)^2, by distance from depth edges, by 1 / sigma^2, by agreement with the albedo of the points, which
/// has been blended robustly (highlights and moved objects that it left out do not come back), and by how near the directions of its flash and the view's are:
/// relief between the points shades albedo of its own in each photograph, the same that it shades in a view lit from the same side.
#pragma once
#include <cstdint>
#include <filesystem>
#include <optional>
#include <span>
#include <vector>

#include "stream/base/report.h"
#include "stream/photo/camera.h"
#include "stream/photo/raster.h"

namespace chiaro::optimize {

/// What a run left of a photograph.
struct DetailPhotograph {
  stream::Camera camera;
  std::filesystem::path gbuffer, albedo;   ///< rasters of surfels/gbuffer.h and optimize/albedo.h
  std::optional<Vec3d> flash_in_world;     ///< absent: taken without one
  // What blending found (blend/blend.h): without it a photograph that it corrected would come back as it was.
  Vec3f gain = Vec3f::Ones();              ///< its albedo times this agrees with the others
  Vec2f shift_px = Vec2f::Zero();          ///< it shows things that much to the right of and below where its camera puts them
  float trust = 1;                         ///< factor of its weight
};

struct DetailView {
  stream::Lens lens;
  stream::Pose pose;
  std::optional<Vec3d> flash_in_world;     ///< absent: the albedo itself is wanted, whatever lights it
};

/// Some rows of a view.
struct ViewRows {
  int y0 = 0, rows = 0, width = 0;
  std::vector<float> depth;       ///< distance along the ray from the camera centre, project units; 0 = leave the pixel alone
  std::vector<float> radius;      ///< of the surfel there, project units
  std::vector<Vec3f> albedo;      ///< of the points
};

/// Memory of sharpening() beside its arguments.
std::uint64_t sharpening_bytes(std::size_t pixels, std::span<const DetailPhotograph> photographs);

/// Sharpened albedo of the rows over `albedo`, per pixel and channel; 1 where no photograph helps. Memory: some rows of one photograph at a time.
/// throws Error if a raster is missing, damaged, or of another size than its camera.
std::vector<Vec3f> sharpening(const DetailView& view, const ViewRows& rows, std::span<const DetailPhotograph> photographs);

}  // namespace chiaro::optimize
