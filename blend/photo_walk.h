/// Photographs against the leaves they see: one photograph at a time, by bands of image rows as high as the budget allows, leaves in parallel.
#pragma once
#include <cstdint>
#include <functional>
#include <span>
#include <string_view>
#include <vector>

#include "blend/blend.h"
#include "blend/leaf_file.h"
#include "blend/photo_window.h"
#include "blend/sample.h"

namespace chiaro::blend {

class PhotoWalk {
 public:
  /// photographs: in the order in which they are to be added; they and all references outlive this.
  PhotoWalk(const stream::Store& store, std::vector<const BlendPhotograph*> photographs, const WindowOptions& options, MemoryBudget& budget, Reporter& report);

  struct Visit {
    std::size_t leaf = 0;
    std::uint32_t photograph = 0;
    const PhotoWindow* window = nullptr;
    std::uint64_t surfels_in_view = 0;   ///< of all leaves that the photograph may see
    int y0 = 0, y1 = 0;   ///< image rows whose surfels are to be read; the rows before y0 are in the file already
  };
  /// Takes every photograph to every leaf that it may see, from where `file` says it got to; the visitor writes the leaf with mark {photograph, y1}
  /// where it changes something. Different leaves at the same time. state_bytes: of one surfel, that a visitor holds beside the geometry.
  /// first: by leaf, the photograph from which on it is to be visited; empty: all from the beginning.
  /// margin: rows of the window beyond those of the surfels.
  void into(LeafFile& file, std::string_view title, int margin, std::uint64_t state_bytes, const std::function<void(const Visit&)>& visit, std::span<const std::uint32_t> first = {});

  /// Only looks: photograph k to every leaf that it may see.
  void look(std::uint32_t k, int margin, std::uint64_t state_bytes, const std::function<void(const Visit&)>& visit);

  /// Calls task(i) for all of a number of leaves, as many at a time as threads and budget allow.
  void for_leaves(std::size_t count, std::uint64_t state_bytes, const std::function<void(std::size_t)>& task);

  std::uint64_t chunks_visited() const { return chunks_visited_; }
  /// Photographs whose pixels were read, in the order of this walk.
  const std::vector<bool>& photographs_read() const { return read_; }

  /// Image rows of each leaf, in the store's order of leaves; empty where a photograph cannot see it.
  std::vector<RowSpan> leaf_rows(const stream::Camera& camera) const;

 private:
  void take(std::uint32_t k, const LeafFile* file, int margin, std::uint64_t state_bytes, const std::function<void(const Visit&)>& visit, std::span<const std::uint32_t> first);
  int band_rows(int width, int height, int beyond) const;

  const stream::Store& store_;
  std::vector<const BlendPhotograph*> photographs_;
  WindowOptions options_;
  MemoryBudget& budget_;
  Reporter& report_;
  std::uint32_t largest_leaf_ = 0;
  std::uint64_t chunks_visited_ = 0;
  std::vector<bool> read_;
};

}  // namespace chiaro::blend
