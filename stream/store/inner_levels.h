/// Which surfels of its children an inner surfel replaces, and the inner levels made by that rule.
///
/// The cell of an inner node is cut into 2^g voxels an axis. A child's surfel belongs to the voxel that its stored position falls into: its Morton
/// code in the parent, 17 bits an axis (the child's octant and its 16 stored bits), shortened to g bits. Children are in Morton order and are gone through in that
/// order, whatever the order of their slots, so the members of a voxel follow each other; voxels in that order are the surfels of the node.
#pragma once
#include <array>
#include <functional>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/file.h"
#include "stream/base/report.h"
#include "stream/store/store.h"
#include "stream/store/surfel_order.h"

namespace chiaro::stream {

/// Numbers the surfels of a node's children by the inner surfel that replaces them; children are passed one after the other.
class VoxelCursor {
 public:
  explicit VoxelCursor(int voxel_bits) : shift_(17 - voxel_bits) {}
  /// order, differences: of the child's surfels, as MortonOrder gives them; not empty.
  void next_child(const ChunkEntry& child, const std::vector<SurfelBlock>& blocks, std::span<const std::uint16_t> order, std::span<const std::uint16_t> differences);
  /// Calls body(voxel, slots) for each voxel that the last child occupies: its number among those of the node, and the child's slots in it.
  template <class F>
  void for_each_voxel(const F& body) const {
    for (std::size_t i = 0; i + 1 < begins_.size(); ++i) body(static_cast<std::uint32_t>(first_ + i), order_.subspan(begins_[i], begins_[i + 1] - begins_[i]));
  }
  std::uint32_t num_voxels() const { return num_voxels_; }

 private:
  int shift_;
  std::span<const std::uint16_t> order_;
  std::vector<std::uint32_t> begins_;   // of each voxel in the order, and the end
  std::uint32_t first_ = 0, num_voxels_ = 0;
  std::array<std::uint32_t, 3> last_{};
};

struct InnerNode {
  ChunkEntry entry;                 ///< its offset is still to be chosen
  std::vector<SurfelBlock> blocks;
};
/// Blocks of the chunk with this number in the index; what it gives must be whole.
using ReadBlocks = std::function<std::vector<SurfelBlock>(std::uint32_t chunk)>;
/// One inner node from its children: count, bounds, radius, spacing, CRC, blocks. voxel_bits: g, or < 0 to choose it by the rule of build_inner_levels().
InnerNode make_inner_node(const Manifest& manifest, const std::vector<ChunkEntry>& entries, const ChunkEntry& node, const ReadBlocks& read, std::uint32_t chunk_surfels,
                          int voxel_bits = -1);

/// Fills all inner entries (count, bounds, radius, spacing, CRC; source_offset = g) from the deepest level up and appends their blocks at
/// `geometry_end`. g is the largest that leaves at most 30 % of the children's surfels and at most chunk_surfels. Returns the new end.
std::uint64_t build_inner_levels(File& geometry, std::uint64_t geometry_end, const Manifest& manifest, std::vector<ChunkEntry>& entries, std::uint32_t chunk_surfels,
                                 MemoryBudget& budget, Reporter& report);

/// The index of a tree from its leaves (Morton order, parts in order): entries of all levels, sorted and linked.
std::vector<ChunkEntry> link_index(const std::vector<ChunkEntry>& leaves);

}  // namespace chiaro::stream
