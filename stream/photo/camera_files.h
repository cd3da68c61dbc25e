/// Camera files of other programs, brought to the one convention of camera.h. source: docs of each format; see camera_files.cpp.
#pragma once
#include <filesystem>
#include <span>
#include <string>
#include <vector>

#include "stream/photo/camera.h"

namespace chiaro::stream {

/// Reads every posed camera of
///   a COLMAP folder: cameras + images, .bin or .txt (also its sub-folders 0, sparse, sparse/0), or one of these files;
///   a Metashape cameras file (.xml).
/// Cameras come in file order, checked by check_camera(), in the file's world frame (Metashape: the chunk or component transform is applied).
///
/// notes   sentences about what was left out (cameras without a pose, disabled ones) are appended.
/// throws  Error with file, line or offset and camera: not a camera file, broken counts, values that are not finite, unknown lens models,
///         singular rotations. No size in a file leads to an allocation beyond the file's own size.
std::vector<Camera> read_cameras(const std::filesystem::path& folder_or_file, std::vector<std::string>& notes);

/// The camera of a photograph: by file name, then, among several of one name, by the longest common end of the two paths; without an equal file
/// name by the name without extension (Metashape labels lack it; a developed photograph may have another one).
///
/// returns  nullptr where no camera fits.
/// throws   Error naming the candidates where two fit equally well.
const Camera* find_camera(std::span<const Camera> cameras, const std::string& photograph_path);

/// The lens of a COLMAP model by name ("PINHOLE", ... "FULL_OPENCV", "OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE") and its parameters
/// in COLMAP's order. throws Error naming `where`, the model and the number of parameters.
Lens lens_from_colmap(const std::string& model, int width_px, int height_px, std::span<const double> params, const std::string& where);

}  // namespace chiaro::stream
