/// The light of an acquisition: transport on a proxy, observations of every photograph, and the lights that explain them all (design decision 5).
#pragma once
#include <filesystem>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "optimize/error_model.h"
#include "optimize/floor.h"
#include "optimize/gather.h"
#include "optimize/light_pattern.h"
#include "optimize/light_solve.h"
#include "optimize/observe.h"
#include "optimize/own_light.h"
#include "stream/base/budget.h"
#include "stream/base/report.h"
#include "stream/store/store.h"

namespace chiaro::optimize {

enum class Method { kJoint, kSingle, kAdam, kDirect };
enum class SkyModel { kNone, kUniform, kSh1, kSh2, kAuto };

struct ReferenceTarget {
  std::size_t photograph = 0;              ///< index into AcquisitionInput::photographs
  std::vector<Vec2d> polygon;              ///< pixels, corners at integers
  std::array<double, 3> albedo{};
  double sigma = 0.01;
};

struct AcquisitionInput {
  std::vector<ObserveInput> photographs;
  std::vector<std::string> names;
  std::optional<std::array<double, 2>> intensity_range;   ///< about +-2 sigma
  std::vector<ReferenceTarget> references;
  SkyModel sky = SkyModel::kAuto;          ///< kAuto: as much as an information criterion finds worth its parameters
  Method method = Method::kJoint;
  FalloffModel falloff = FalloffModel::kAuto;   ///< joint: how light may fall off over the pictures
  bool try_floor = true;                   ///< a floor outside the cloud is taken where the same criterion speaks for it
  std::optional<std::array<double, 4>> floor_plane;   ///< n x, n y, n z, h: n . p = h in the world, n up; absent: found (optimize/floor.h)
};

struct AcquisitionOptions {
  std::uint64_t proxy_surfels = 400000;    ///< wanted; the levels of the octree come in steps (surfels/working_set.h)
  std::uint64_t max_proxy_surfels = 800000;
  int rays = 64;
  std::uint64_t seed = 1;
  int outer_iterations = 12;
  std::size_t light_samples = 20000;       ///< surfels that the lights are solved from
  std::size_t max_light_samples = 400000;  ///< readings of them: with hundreds of photographs that each see a surfel, fewer surfels do
};

/// What speaks for one model of the ambient light: Bayesian information criterion, smaller is better.
struct SkyEvidence {
  std::string model;
  int parameters = 0;
  double criterion = 0;                    ///< beside the uniform grey sky's
};

/// What the albedo stage needs, on disk under `folder`: transport.bin, observation_K.bin, gathered_K.bin (G of photograph K, N * 3 floats).
struct AcquisitionResult {
  std::vector<LightSolution> lights;       ///< one for the acquisition (joint), or one per flash photograph (single, adam)
  std::vector<std::size_t> light_of_photograph;
  std::vector<OwnLight> own_lights;        ///< of each photograph: factors on its ambient light, and of its brightness that was taken out; 1 where it is like the others (optimize/own_light.h)
  LightSpread spread{};                    ///< over the photographs, where they vary (optimize/own_light.h)
  LightPattern pattern;                    ///< where the flash stands, and how light falls off over the pictures (joint)
  std::vector<bool> strangers;             ///< of each photograph: it shows something else than the others, and took no part (optimize/strangers.h)
  std::size_t proxy_surfels = 0, proxy_seen = 0;
  double back_share = 0;
  int outer_iterations = 0;
  double last_change = 0;
  std::string sky_model;                   ///< "none", "uniform", "sh1", "sh2", with " coloured" where the sky has a colour of its own, " + floor" where a floor was found
  std::vector<SkyEvidence> sky_evidence;   ///< of the models that kAuto tried
  std::optional<double> gloss_evidence;    ///< criterion of a coat over all surfaces beside none, as of SkyEvidence; absent where it was not tried
  std::vector<ErrorModel> errors;          ///< one for each of `lights`
  std::vector<std::string> notes;
};

/// The transport of an acquisition, loaded: shared by the light, albedo and render stages.
struct Scene {
  Proxy proxy;
  std::unique_ptr<NearestPoints> nearest;
  Transport transport;
  std::optional<Floor> floor;
};

/// Chooses the proxy cut, orients it by what the photographs see, gathers, and writes folder/proxy.bin and folder/transport.bin.
/// others: folders that this wrote for other acquisitions of the store. Where one chose the same, turned the same way, what was gathered there is taken: the same bits, without the rays.
/// throws Error, Cancelled.
void gather_scene(const stream::Store& store, const AcquisitionInput& input, const AcquisitionOptions& options, const std::filesystem::path& folder,
                  std::span<const std::filesystem::path> others, MemoryBudget& budget, Reporter& report);

/// Reads what gather_scene left. throws Error if it is damaged or belongs to another store.
Scene load_scene(const stream::Store& store, const std::filesystem::path& folder);

/// Finds the lights; writes folder/gathered_K.bin and folder/albedo.bin (3 floats a proxy surfel: the albedo of all photographs together).
AcquisitionResult solve_acquisition(const stream::Store& store, const Scene& scene, const AcquisitionInput& input, const AcquisitionOptions& options,
                                    const std::filesystem::path& folder, MemoryBudget& budget, Reporter& report);

/// flash_by_floor() of a photograph: N floats; there where the scene has a floor.
std::filesystem::path floor_flash_path(const std::filesystem::path& folder, std::size_t photograph);
std::filesystem::path gathered_path(const std::filesystem::path& folder, std::size_t photograph);
std::filesystem::path proxy_albedo_path(const std::filesystem::path& folder);

/// Surfels that a budget of `bytes` holds with `rays` hits each.
std::uint64_t proxy_surfels_within(std::uint64_t bytes, int rays);

}  // namespace chiaro::optimize
