/// A floor that is near, lit by the flash, and not in the cloud: what the cloud's lower side receives from it (physics.md E.5).
///
/// The floor is an endless, even, grey, diffuse plane under everything. It hides the sky below the horizon, and gives back its share of flash and ambient light:
/// radiosity = albedo * (flash_intensity * d(y) + pi * ambient radiance). One unknown, its albedo, serves for both lights: apart they cannot be told.
#pragma once
#include <filesystem>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "optimize/gather.h"
#include "optimize/proxy.h"
#include "stream/base/report.h"

namespace chiaro::optimize {

/// normal . p = height, scene frame of the proxy; the normal points up, to where everything is.
struct Floor {
  Vec3f normal = Vec3f::UnitZ();
  float height = 0;
};

/// The plane that the lowest points stand on. Down is where the cameras' lower edges point on average, or the axis of the cloud's frame that is nearest to it, if
/// within 25 degrees: scans are levelled, photographers tilt their heads. Empty if the cameras do not agree where down is.
std::optional<Floor> find_floor(const Proxy& proxy, std::span<const Mat3d> rotations_camera_from_world);

/// What the floor hides of the sky: N * kSkyTerms, in the terms of Transport::sky, smoothed like them. From the same rays as the transport.
std::vector<float> hidden_by_floor(const Proxy& proxy, const Transport& transport, const Smoother& smoother, const Floor& floor);

/// Irradiance of the surfels by way of a white floor per unit of intensity of each flash, 1/unit^2: N values each, smoothed. Shadows of the proxy on the floor are cast. The way
/// of each ray is found once for all flashes; each gets the same bits as by itself.
std::vector<std::vector<float>> flash_by_floor(const Proxy& proxy, const Transport& transport, const Smoother& smoother, const surfels::Tracer& tracer, const Floor& floor,
                                               std::span<const Vec3d> flashes_in_world);

/// On disk: the plane and hidden_by_floor(), or that there is none. throws Error on anything else.
void write_floor(const std::optional<Floor>& floor, const std::vector<float>& hidden, const std::filesystem::path& path);
std::optional<Floor> read_floor(const std::filesystem::path& path, std::size_t num_surfels, std::vector<float>& hidden);

}  // namespace chiaro::optimize
