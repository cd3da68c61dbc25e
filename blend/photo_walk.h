/// Photographs against the leaves they see: as many photographs together as memory holds, leaves in parallel. A leaf's state is read and written once for all
/// of a group. A photograph that is too large comes alone, by bands of image rows as high as the budget allows.
#pragma once
#include <cstdint>
#include <functional>
#include <memory>
#include <span>
#include <string_view>
#include <vector>

#include "blend/blend.h"
#include "blend/leaf_file.h"
#include "blend/photo_window.h"
#include "blend/sample.h"
#include "blend/window_cache.h"

namespace chiaro::blend {

class PhotoWalk {
 public:
  /// photographs: in the order in which they are to be added; they and all references outlive this.
  PhotoWalk(const stream::Store& store, std::vector<const BlendPhotograph*> photographs, WindowCache& windows, MemoryBudget& budget, Reporter& report);

  /// One photograph before a leaf.
  struct View {
    std::uint32_t photograph = 0;
    const PhotoWindow* window = nullptr;
    std::uint64_t surfels_in_view = 0;   ///< of all leaves that the photograph may see
    int y0 = 0, y1 = 0;                  ///< image rows whose surfels are to be read; the rows before y0 are in the file already
  };
  struct Visit {
    std::size_t leaf = 0;
    std::span<const View> views;         ///< one at least, in the order of photographs
    /// Where the leaf is once all of them are in.
    Mark reached() const { return {views.back().photograph, static_cast<std::uint32_t>(views.back().y1)}; }
  };
  using Visitor = std::function<void(const Visit&)>;

  /// Takes every photograph to every leaf that it may see, from where `file` says it got to; the visitor writes the leaf with mark reached() where it changes
  /// something. Different leaves at the same time. state_bytes: of one surfel, that a visitor holds beside the geometry.
  /// first: by leaf, the photograph from which on it is to be visited; empty: all from the beginning.
  /// margin: rows of the window beyond those of the surfels.
  void into(LeafFile& file, std::string_view title, int margin, std::uint64_t state_bytes, const Visitor& visit, std::span<const std::uint32_t> first = {});

  /// Only looks: these photographs, in ascending order, to every leaf that they may see. taken: called with how many of them are through.
  void look(std::span<const std::uint32_t> photographs, int margin, std::uint64_t state_bytes, const Visitor& visit, const std::function<void(std::size_t)>& taken = {});

  /// Calls task(i) for all of a number of leaves, as many at a time as threads and budget allow.
  void for_leaves(std::size_t count, std::uint64_t state_bytes, const std::function<void(std::size_t)>& task);

  std::uint64_t chunks_visited() const { return chunks_visited_; }
  /// Photographs whose pixels were read, in the order of this walk.
  const std::vector<bool>& photographs_read() const { return read_; }

  /// Image rows of each leaf, in the store's order of leaves; empty where a photograph cannot see it.
  std::vector<RowSpan> leaf_rows(const stream::Camera& camera) const;
  /// What they take; the budget is charged for those of all photographs that are held together.
  std::uint64_t rows_bytes() const { return store_.leaves().size() * sizeof(RowSpan); }

 private:
  struct Member;
  struct Task {
    const LeafFile* file;
    std::string_view title;
    int margin;
    std::uint64_t state_bytes;
    const Visitor& visit;
    std::span<const std::uint32_t> first;
  };
  /// The first photographs of a list, as many as fit; returns how many of the list are through.
  std::size_t take(std::span<const std::uint32_t> photographs, const Task& task);
  Member member_for(std::uint32_t k) const;
  bool is_wanted(const Member& m, std::size_t leaf, const Task& task) const;
  bool is_wanted_anywhere(const Member& m, const Task& task) const;
  void take_in_bands(Member& m, const Task& task);
  void visit_leaves(std::span<const Member> group, const Task& task);

  const stream::Store& store_;
  std::vector<const BlendPhotograph*> photographs_;
  WindowCache& windows_;
  MemoryBudget& budget_;
  Reporter& report_;
  std::uint32_t largest_leaf_ = 0;
  std::uint64_t chunks_visited_ = 0;
  std::vector<bool> read_;
};

/// A photograph as a walk holds it, read `shift_px` beside where its camera says.
inline SurfelReader reader_of(const PhotoWalk::View& view, const stream::Camera& camera, const Vec2f& shift_px) { return {camera, *view.window, shift_px, view.y0, view.y1}; }

}  // namespace chiaro::blend
