/// A complete small project with a known answer, written into a folder: a painted sphere in the open, photographed with a flash. A convex body has no
/// interreflection and each of its points sees exactly half of the sky's directions, so radiance is a closed form:
///   L = albedo / pi * (I cos(theta) / r^2 + pi La).
/// The pictures are rendered here by ray-sphere intersection, and the lens is inverted here too, so that nothing of the program under test is used but its EXR and PNG writers.
#pragma once
#include <array>
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "stream/base/types.h"

namespace chiaro::test {

struct TinySceneOptions {
  std::size_t points = 6000;
  bool with_normals = true;
  bool normals_inwards = false;
  bool with_colours = true;             ///< uchar red, green, blue: mid-grey
  int photographs = 3;                  ///< photo_00.exr, photo_01.exr, … at different distances
  double azimuth_step = 0.5;            ///< rad, from one photograph to the next
  bool from_level = false;              ///< all cameras at the height of the sphere's middle; else from above, at three heights
  int width_px = 96, height_px = 72;
  double focal_px = 110;
  double flash_intensity = 9;           ///< W/sr
  double ambient_radiance = 0.12;
  std::vector<double> ambient_factors;  ///< on it, of each photograph; those without have 1
  std::array<double, 2> intensity_range{8.95, 9.05};   ///< narrow by default: then the absolute scale is known
  bool write_range = true;
  double lens_loss = 0, flash_loss = 0; ///< of the light in the pictures' corners: by the lens, as (1 + a r^2)^-2 of the distance from the middle; by the flash, as a Gaussian of the angle off its axis
  double radial_k1 = 0;                 ///< not 0: COLMAP's SIMPLE_RADIAL, else PINHOLE
  bool uniform_paint = false;           ///< the same albedo everywhere
  bool masks = true;
  bool reference = false;               ///< a polygon of known albedo in photo_00
  bool flash = true;                    ///< false: no [acquisition.flash]
  std::array<double, 3> flash_in_camera{0.25, -0.2, 0.02};   ///< metres
  std::string unit = "m";               ///< of the files: m, cm, mm. The sphere's radius is one metre in any
  double noise_gain = 1e-5, read_sigma = 1e-4;   ///< declared only; the pictures carry no noise
};

struct TinyScene {
  std::filesystem::path folder, project;
  TinySceneOptions options;
  std::vector<Vec3d> positions;                 ///< in the order of cloud.ply, as stored there (float)
  std::vector<std::array<double, 3>> albedo;    ///< true albedo of each point
};

/// Albedo of the sphere's paint: smooth, of one chroma in large parts, 0.2 .. 0.8.
std::array<double, 3> tiny_albedo(const TinySceneOptions& options, const Vec3d& position);

/// Writes cloud.ply, photos/, masks/, sparse/ and project.toml into `folder` (made if absent); for judging, novel/views.toml and novel/novel_00.exr:
/// a view from elsewhere with the flash on the other side.
TinyScene write_tiny_scene(const std::filesystem::path& folder, const TinySceneOptions& options = {});

}  // namespace chiaro::test
