/// The planes of a G-buffer that follow from its other planes: how far edges are, in depth and of cast shadows. Internal to surfels.
#pragma once
#include "stream/photo/camera.h"
#include "stream/photo/raster.h"

namespace chiaro::surfels {

constexpr float kPenumbraReach = 24;   ///< pixels: no shadow's edge is less certain

/// Plane `edge`, from depth, normals, footprint, coverage and radius; see write_gbuffer().
void write_edge_distance(stream::RasterWriter& out, const stream::Camera& camera);
/// Plane `shadow`, from `penumbra`.
void write_shadow_doubt(stream::RasterWriter& out);

}  // namespace chiaro::surfels
