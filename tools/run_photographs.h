/// The stages that take each photograph by itself: its camera, its development, and what its pixels see of the cloud.
#pragma once
#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "stream/store/store.h"
#include "surfels/sampling.h"

namespace chiaro::tools {

struct Acquisition;
struct Photo;
struct RunContext;
struct Shoot;

/// The photographs of all acquisitions that have a camera; the others are left out. throws Error where none is left.
std::vector<Shoot> read_shoots(RunContext& run);

/// Photographs that turn out to be of no use are taken out of their shoot and named. throws Error where none is left in any.
class PhotographStages {
 public:
  PhotographStages(RunContext& run, const stream::Store& store, std::vector<Shoot>& shoots) : run_(run), store_(store), shoots_(shoots) {}

  /// By which cells each photograph is read, and what of the disk is kept of their pixels: announced, noted where the disk may be too small, and throws Error where it is.
  void plan();
  void develop(Shoot& shoot);
  void raycast(Shoot& shoot);
  /// Points are seen from their front alone. Where a scan's normals point inwards all of it stays unseen.
  void note_backs();
  /// Masks outline the object. Where they leave little of it and much else, they may be meant the other way round; where they leave much beside it, cameras may have another scale.
  void note_masks();

 private:
  void develop_one(const Acquisition& a, Photo& photo);
  int binning_of(const Acquisition& a, const Photo& photo);
  struct PhotographDisk {
    std::uint64_t bytes = 0;   ///< of the rasters that are there
    bool whole = false;        ///< none is missing
  };
  PhotographDisk disk_of(const std::string& key, bool with_albedo) const;
  /// What is said of many photographs alike is said once.
  void tell_development_notes();

  RunContext& run_;
  const stream::Store& store_;
  std::vector<Shoot>& shoots_;
  std::optional<surfels::SpacingSamples> spacing_;   ///< once a photograph is large enough to be read by cells
  std::map<std::string, std::vector<std::string>> development_notes_;   ///< and the files of which they are said
  std::uint64_t pixels_on_cloud_ = 0, pixels_from_behind_ = 0;
  std::map<std::string, std::uint64_t> pixels_left_by_mask_;            ///< of each photograph that has a mask
  struct {
    std::uint64_t used = 0, on_cloud = 0, used_on_cloud = 0;
  } masked_;                                                            ///< pixels of the photographs with masks
};

}  // namespace chiaro::tools
