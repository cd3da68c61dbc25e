/// The project file: what the user wants done, checked as a whole before anything starts. Contract: docs/project-file.md.
#pragma once
#include <array>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "stream/base/types.h"

namespace chiaro::tools {

enum class Normals { kAuto, kFile, kEstimate, kNone };
enum class Outliers { kNone, kStatistical };
enum class Alignment { kNone, kIcp };
/// kAuto: EXR and TIFF are linear, JPEG and PNG are sRGB, camera raw files are raw. Resolved per acquisition when the project is loaded.
enum class Encoding { kAuto, kLinear, kSrgb, kRaw };
enum class AmbientModel { kAuto, kNone, kUniform, kSh1, kSh2 };
/// kAuto: a floor outside the cloud is looked for, and taken where the photographs speak for it.
enum class FloorModel { kAuto, kNone };
/// How light falls off over the pictures: not, as by the lens, as by the flash. kAuto: as the photographs say.
enum class FalloffModel { kAuto, kNone, kLens, kFlash };
enum class SolveMethod { kJoint, kSingle, kAdam, kDirect, kNone };
/// Factors between photographs that the blend takes out: none, one each, one a channel.
enum class BlendGain { kNone, kGrey, kChannels };
/// New points where the photographs show more than the cloud samples.
enum class BlendRefine { kNone, kImage };
/// What an acquisition is for: the photographs themselves, or the same views without the flash, which measure the ambient light.
enum class AcquisitionRole { kFlash, kNoFlash };

/// The words of the project file for these.
const char* name_of(Normals value);
const char* name_of(Outliers value);
const char* name_of(Alignment value);
const char* name_of(Encoding value);
const char* name_of(AmbientModel value);
const char* name_of(FloorModel value);
const char* name_of(FalloffModel value);
const char* name_of(SolveMethod value);
const char* name_of(BlendGain value);
const char* name_of(BlendRefine value);
const char* name_of(AcquisitionRole value);

struct CloudInput {
  std::vector<std::filesystem::path> files;  ///< absolute, at least one, no duplicates; the order of the file, matches of a glob in natural order
  Normals normals = Normals::kAuto;
  Outliers outliers = Outliers::kNone;
  Alignment align = Alignment::kNone;        ///< of the second and further files onto the first
};

/// Variance of a linear value = gain * value + read_sigma^2, in the photographs' radiometric unit.
struct NoiseInput {
  double gain = 0, read_sigma = 0;           ///< >= 0, not both 0
};

struct FlashInput {
  Vec3d offset_in_camera = Vec3d::Zero();    ///< project units; camera axes x right, y down, z forward
  std::optional<std::array<double, 2>> intensity_range;  ///< W/sr in the photographs' radiometric unit, 0 < min <= max, about +-2 sigma; absent: unknown
};

/// What the lenses were set to.
struct FocusInput {
  double f_number = 0, focal_length = 0, distance = 0;   ///< > 0; lengths in project units, distance > focal_length: of the plane in focus from the camera
};

struct ReferenceInput {
  std::size_t photograph = 0;                ///< index in the acquisition's photographs
  std::vector<Vec2d> polygon;                ///< pixels, corners at integers; at least 3 vertices, area > 0
  std::array<double, 3> albedo{};            ///< linear, in the photographs' colour space, (0, 1]
  double sigma = 0.01;                       ///< relative, > 0
};

struct PhotographInput {
  std::filesystem::path file;                ///< absolute
  std::string stem;                          ///< file name without extension
  std::string key;                           ///< name of its folder in the output: the stem, or ACQUISITION.STEM where two acquisitions share the stem
  std::filesystem::path mask;                ///< absolute; empty = use all pixels
};

struct Acquisition {
  std::string name;
  AcquisitionRole role = AcquisitionRole::kFlash;
  std::vector<PhotographInput> photographs;  ///< natural order of their paths, no duplicates, stems unique
  Encoding encoding = Encoding::kAuto;       ///< never kAuto after load_project
  std::string masks;                         ///< pattern as written, "" = none
  std::filesystem::path cameras;             ///< absolute; exists
  std::optional<NoiseInput> noise;           ///< absent: estimated
  std::optional<FlashInput> flash;           ///< absent: no flash
  std::optional<FocusInput> focus;           ///< absent: taken as sharp everywhere
  std::optional<int> binning;                ///< side of the cells of pixels that become one, 1 .. 64; absent: as the cloud samples the photograph
  std::vector<ReferenceInput> references;
  AmbientModel ambient = AmbientModel::kAuto;
  FalloffModel falloff = FalloffModel::kAuto;
  FloorModel floor = FloorModel::kAuto;
  std::optional<std::array<double, 4>> floor_plane;   ///< n x, n y, n z, h: n . p = h in the cloud's frame, n pointing up, not 0
  std::optional<double> exposure_s;          ///< shutter time, > 0: the ambient light counts in proportion to it, the flash does not
  std::optional<std::size_t> lights_of;      ///< number of the acquisition whose lights (flash, ambient) these are too; always there for kNoFlash
};

struct BlendInput {
  std::string layer = "albedo";              ///< name of the layer that the run writes; never "input", which holds the cloud's own colour
  int bands = 2;                             ///< frequency bands on the surface, 2 .. 4
  bool denoise = true;                       ///< what a point's own sigma leaves open is taken from its neighbours
  bool keep = false;                         ///< keep the sums, so that photographs can be added or taken away later at the cost of what they see
  bool reject = true;                        ///< leave out readings that most photographs of a point contradict
  BlendGain gain = BlendGain::kGrey;
  bool align = true;                         ///< find photographs that lie beside what the others show, and read them there
  BlendRefine refine = BlendRefine::kNone;
  std::optional<std::uint64_t> refine_points;   ///< new points at most; absent: four times as many as the cloud has
};

struct ExportInput {
  std::string file = "albedo.ply";           ///< where none is named: LAYER.ply; relative to the run's folder; .ply, .las or .pcd
  bool fill = false;                         ///< fill unseen points from their neighbours; they keep photos = 0
};

struct Project {
  std::filesystem::path file;                ///< absolute path of the project file
  std::string name;                          ///< default: the file's stem
  std::string unit = "m";                    ///< of clouds, cameras and offsets: m, cm, mm
  double metres_per_unit = 1;
  CloudInput cloud;
  std::vector<Acquisition> acquisitions;     ///< at least one; names unique
  SolveMethod method = SolveMethod::kJoint;
  BlendInput blend;
  std::uint64_t memory_bytes = std::uint64_t{2} << 30;
  int threads = 0;                           ///< 0 = all
  std::uint64_t seed = 1;
  std::vector<ExportInput> exports{ExportInput{}};
  std::vector<std::string> notes;            ///< sentences for the user: masks that are missing, …
};

/// Reads, completes and checks a project file. Paths in it start at its folder.
///
/// overrides  `key=value` of --set, applied in order. Keys are dotted: `solve.method=adam`, `acquisition.day1.ambient.model=none` (by name),
///            `acquisition.0.encoding=srgb` (by number), `export.fill=true` (no name: every element). The value is TOML, else a plain text.
/// throws     UsageError for whatever is wrong with the file's text, with position ("project.toml:12:5: …") and, for names, the nearest known
///            one; also where files it names are missing. Error if the file itself cannot be read or is larger than 4 MiB.
Project load_project(const std::filesystem::path& path, std::span<const std::string> overrides = {});

/// NAME.out beside the project file.
std::filesystem::path default_output(const Project& project);

/// The whole project with all defaults as JSON, for the run record.
std::string to_json(const Project& project);

}  // namespace chiaro::tools
