/// What every pixel of a photograph sees: depth, normal, surfel, footprint, and the flash irradiance averaged over the pixel.
///
/// A pixel is a mean over its footprint, so each quantity that is compared with it is one too: 4x4 rays a pixel, each with its own shadow ray to the
/// flash (measured: a single centre ray leaves the flash 5 % wrong). Four of them, one in each row and column, where these show one plane in even light.
#pragma once
#include <filesystem>
#include <optional>

#include "stream/base/budget.h"
#include "stream/base/report.h"
#include "stream/photo/camera.h"
#include "stream/store/store.h"
#include "surfels/working_set.h"

namespace chiaro::surfels {

struct GBufferOptions {
  int subpixels = 4;                        ///< rays a pixel: subpixels^2
  std::optional<Vec3d> flash_in_camera;     ///< project units; absent: no flash planes
  std::optional<std::filesystem::path> mask_raster;   ///< raster with u8 plane `mask`: pixels without bit 1 get one ray and no flash
  CutOptions cut;
  /// Discs with their structure that are held at a time, where fewer rows need fewer of them; about ten million. With more, the first row waits for seconds, and
  /// memory holds what no other row needs.
  std::uint64_t tile_bytes = std::uint64_t{256} << 20;
};

struct GBufferStats {
  std::uint64_t pixels = 0, pixels_hit = 0, rays = 0, shadow_rays = 0;
  std::uint64_t pixels_hit_in_mask = 0;     ///< of pixels_hit: those that the mask leaves; all of them without one
  std::uint64_t pixels_from_behind = 0;     ///< of pixels_hit: at their middle they show surfels whose normal, of known sign, points away from the camera
  std::uint64_t surfels = 0, chunks = 0, chunks_hidden = 0;
  int tiles = 0;                            ///< parts the image was split into, by its surfels or the budget
};

/// Writes a raster with the planes
///   depth f32      distance along the ray from the camera centre, mean of the rays that hit, project units; 0 = nothing
///   nx ny nz f32   world frame, unit, facing the camera
///   chunk u32, slot u16   surfel at the pixel's middle (chunk 0xffffffff = none)
///   radius f32     of that surfel, project units
///   footprint f32  side of the pixel on the surface, across the view: depth / focal length, project units
///   cosv f32       cosine between normal and view
///   coverage f32   share of the rays that hit, 0..1
///   edge f32       distance to the nearest depth edge, hole or image border, pixels (0 at the edge, at most 64)
/// and with a flash
///   flash f32      mean over the rays of visibility * cos / r^2, 1/m^2; rays that miss do not count
///   spread f32     standard deviation of that over its mean
///   lit f32        share of the rays that see the flash
///   penumbra f32   where a cast shadow's edge crosses the pixel: how far the edge may lie off, pixels; else 0
///   shadow f32     doubt whether the pixel is lit: 1 on a cast shadow's edge, falling to 0 as far away as the edge may lie
/// throws Error, Cancelled. Same bytes for any thread count and any number of tiles.
GBufferStats write_gbuffer(const stream::Store& store, const stream::Camera& camera, const GBufferOptions& options,
                           const std::filesystem::path& out, MemoryBudget& budget, Reporter& report);

}  // namespace chiaro::surfels
