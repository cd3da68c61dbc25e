/// Many photographs into one albedo per surfel: streaming, one photograph at a time over the store's chunks, in object-space bands.
///
/// source: after Pintus, Gobbetti, Callieri, "Fast Low-Memory Seamless Photo Blending on Massive Point Clouds using a Streaming Framework", JOCCH 2011.
#pragma once
#include <array>
#include <filesystem>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "blend/inspect.h"
#include "stream/base/budget.h"
#include "stream/base/file.h"
#include "stream/base/report.h"
#include "stream/photo/camera.h"
#include "stream/store/store.h"

namespace chiaro::blend {

struct BlendPhotograph {
  std::string name;
  stream::Camera camera;
  std::filesystem::path gbuffer;   ///< raster of surfels/gbuffer.h
  std::filesystem::path albedo;    ///< raster with planes r g b (albedo, linear, f32; NaN = no value) and sigma (f32, relative sd that is independent between photographs); optional plane shared (f32, relative sd that the photographs of a surfel have in common)
  std::filesystem::path radiance;  ///< raster of stream/photo/develop.h: u8 plane `mask`, bit 1 usable, 2 saturated, 4 not finite
};

/// Factors that bring photographs to the same brightness, from the surfels that they share: none, one each, or one a channel.
enum class Gain { kNone, kGrey, kChannels };

/// What a blend of the same photographs on other points has found of them, in the caller's order.
struct Findings {
  std::vector<std::array<double, 3>> gain;
  std::vector<Alignment> alignment;
  double scatter = 0;
  Tolerance tolerance;
};

struct BlendOptions {
  std::string layer = "albedo";
  std::string provenance_json = "{}";
  int bands = 2;                   ///< 2 .. 4; each one more splits the lowest once more, at twice the radius
  double low_band_px = 8;          ///< radius of the filter that splits the highest band from the next, in typical pixels
  double border_px = 12;           ///< weights rise from 0 at image borders, mask borders and silhouettes over this many pixels
  double high_band_power = 1.5;      ///< weights of the high band are raised to this power: better photographs count more
  double shared_sigma = 0;         ///< relative sd that all photographs share (lights): added to the result, does not average out
  bool reject = true;              ///< readings that a majority of the photographs contradicts are left out
  Gain gain = Gain::kGrey;
  bool align = true;               ///< photographs that lie beside what the others show are read where they show it
  bool denoise = false;            ///< what a surfel's own sigma leaves open is taken from its neighbours (blend/denoise.h)
  std::filesystem::path keep;      ///< folder in which the sums stay for a later blend with photographs added or taken away, and from which this one begins; empty: none
  std::optional<Findings> known;   ///< factors, places and scatter are not looked for but taken from here
  std::function<std::uint64_t(const std::filesystem::path&)> free_bytes = free_disk_bytes;   ///< of the disk that holds a folder
  void validate() const;
};

struct PhotographStats {
  std::uint64_t samples = 0;       ///< readings that are in the result
  std::uint64_t rejected = 0;      ///< readings that the majority outvoted
  std::array<double, 3> gain{1, 1, 1};   ///< its values were multiplied by this
  Inspection inspection;
  Alignment alignment;
};

/// What denoising has done: sums over the points that have a sigma.
struct Denoising {
  std::uint64_t points = 0, points_changed = 0;
  double sigma_before = 0, sigma_after = 0;
  void add(const Denoising& other);
};

struct BlendStats {
  std::uint64_t points = 0, points_seen = 0, points_disputed = 0, samples = 0, chunks_visited = 0;   ///< disputed: a reading was outvoted there
  double scatter = 0;              ///< median distance of two readings of a point, relative, largest channel
  Tolerance tolerance;
  std::uint64_t leaves = 0, leaves_kept = 0;  ///< with readings; of these, taken over from the kept blend as they were
  std::uint64_t photographs_read = 0;         ///< whose pixels were needed
  std::uint64_t scratch_bytes = 0;            ///< most that the state takes on the disk
  std::optional<Denoising> denoising;         ///< none: it was not asked for
  WindowOptions window;                       ///< what weights and bands were measured against
  std::vector<PhotographStats> photographs;   ///< in the caller's order
};

/// Writes layer `options.layer` (albedo, sigma, photos) of the store and filters it to the inner nodes. Photographs are taken twice: once to hear what
/// each says of a surfel, once to add up what the majority does not contradict. State lives on disk beside the store (scratch), one chunk and one band
/// of image rows in memory at a time. The result does not depend on threads, budget or order of photographs.
/// With options.keep, a blend of nearly the same photographs goes on from the one before: only leaves that the change may touch are added up anew, from
/// the photographs that see them. The result has the same bits as one from the beginning.
/// throws Error (also where the disk has no space for the state), Cancelled.
BlendStats blend(const stream::Store& store, std::span<const BlendPhotograph> photographs, const BlendOptions& options,
                 const std::filesystem::path& scratch, MemoryBudget& budget, Reporter& report);

}  // namespace chiaro::blend
