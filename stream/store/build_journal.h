/// What a build has finished, kept in NAME.chiaro.part so that a killed build goes on from there.
#pragma once
#include <filesystem>
#include <optional>
#include <vector>

#include "stream/store/count_grid.h"
#include "stream/store/store.h"

namespace chiaro::stream {

/// Each phase can be repeated from its beginning without changing its result.
enum class BuildPhase { kStarted, kSpilled, kLeaves, kSurfels, kInner, kLayers };

struct BuildJournal {
  BuildPhase phase = BuildPhase::kStarted;
  Manifest manifest;                    ///< as far as known; manifest.key identifies inputs and options
  RootCube root;
  double typical_spacing = 0;
  bool has_colour = false;
  std::uint64_t estimated_normals = 0;  ///< points without a usable normal from their file
  std::uint64_t spill_bytes = 0;        ///< of the pages in spill.bin
  std::uint64_t leaf_geometry_end = 0;  ///< end of the leaves in geometry.bin
  std::vector<Partition> partitions;
};

void write_journal(const std::filesystem::path& part, const BuildJournal& journal);
/// Nothing if there is no journal, it is damaged, or its key is another: the build then starts over.
std::optional<BuildJournal> read_journal(const std::filesystem::path& part, const std::string& key);
void remove_journal(const std::filesystem::path& part);

}  // namespace chiaro::stream
