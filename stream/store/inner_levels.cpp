#include "stream/store/inner_levels.h"

#include <algorithm>
#include <bit>
#include <cmath>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/store/morton.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace {

constexpr double kShare = 0.3;                     // of the children's surfels that a node keeps at most
constexpr std::size_t kMostMembers = 65536;        // of one voxel that are looked at one by one

std::uint64_t code_in_parent(const ChunkEntry& child, const SurfelBlock& b, std::size_t lane) {
  return (child.morton & 7) << 48 | morton_encode(b.x[lane], b.y[lane], b.z[lane]);
}

// The same as three numbers of 17 bits.
std::array<std::uint32_t, 3> place_in_parent(const ChunkEntry& child, const SurfelBlock& b, std::size_t lane) {
  const auto octant = [&](int a) { return static_cast<std::uint32_t>(child.morton >> a & 1) << 16; };
  return {octant(0) | b.x[lane], octant(1) | b.y[lane], octant(2) | b.z[lane]};
}

std::uint32_t differing_bits(const std::array<std::uint32_t, 3>& a, const std::array<std::uint32_t, 3>& b) { return (a[0] ^ b[0]) | (a[1] ^ b[1]) | (a[2] ^ b[2]); }

struct Member {
  Vec3d position;  ///< in units of the parent's step, from its lower corner
  Vec3f normal;
  float radius;
  std::uint8_t flags;
};

class NodeBuilder {
 public:
  NodeBuilder(const ReadBlocks& read, const Manifest& manifest, const std::vector<ChunkEntry>& entries, const ChunkEntry& node, std::uint32_t chunk_surfels)
      : read_(read), entries_(entries), most_(chunk_surfels) {
    out_.entry = node;
    frame_ = frame_of(manifest, node);
  }

  InnerNode run(int voxel_bits) {
    const int bits = voxel_bits < 0 ? choose_voxel_bits() : voxel_bits;
    out_.entry.source_offset = static_cast<std::uint64_t>(bits);
    voxel_bits_ = bits;
    VoxelCursor cursor(bits);
    for_each_child([&](std::uint32_t number, const ChunkEntry& child, const std::vector<SurfelBlock>& blocks) {
      const Order order = order_of(number, child, blocks);
      cursor.next_child(child, blocks, order.slots, order.differences);
      add_members(child, blocks, cursor);
    });
    finish_group();
    seal();
    return std::move(out_);
  }

 private:
  template <class F>
  void for_each_child(const F& body) const {
    for (std::uint32_t c = 0; c < out_.entry.num_children; ++c) {
      body(c, entries_[out_.entry.first_child + c], read_(out_.entry.first_child + c));
    }
  }

  struct Order {
    std::span<const std::uint16_t> slots, differences;
  };
  struct KeptOrder {
    std::vector<std::uint16_t> slots, differences;
  };

  // Children are gone through twice; more than eight are the parts of full cells, whose orders would take too much memory.
  Order order_of(std::uint32_t number, const ChunkEntry& child, const std::vector<SurfelBlock>& blocks) {
    if (number < orders_.size() && !orders_[number].slots.empty()) return {orders_[number].slots, orders_[number].differences};
    const std::span<const std::uint16_t> slots = morton_.of(blocks, child.count), differences = morton_.differences();
    if (number < orders_.size()) orders_[number] = {{slots.begin(), slots.end()}, {differences.begin(), differences.end()}};
    return {slots, differences};
  }

  int choose_voxel_bits() {
    std::array<std::uint64_t, 18> first_differs{};  // how many neighbours part at this depth
    std::uint64_t total = 0;
    std::array<std::uint32_t, 3> last{};
    for_each_child([&](std::uint32_t number, const ChunkEntry& child, const std::vector<SurfelBlock>& blocks) {
      const Order order = order_of(number, child, blocks);
      const auto place = [&](std::uint16_t slot) { return place_in_parent(child, blocks[slot / 16], slot % 16); };
      if (const std::uint32_t differ = differing_bits(place(order.slots.front()), last); total > 0 && differ != 0) ++first_differs[static_cast<std::size_t>(18 - std::bit_width(differ))];
      for (const std::uint16_t differ : order.differences.subspan(1))
        if (differ != 0) ++first_differs[static_cast<std::size_t>(18 - std::bit_width(differ))];
      last = place(order.slots.back());
      total += order.slots.size();
    });
    const auto limit = std::min<std::uint64_t>(most_, static_cast<std::uint64_t>(kShare * static_cast<double>(total)));
    int bits = 0;
    std::uint64_t voxels = 1;
    while (bits < kLocalBits && voxels + first_differs[static_cast<std::size_t>(bits + 1)] <= limit) voxels += first_differs[static_cast<std::size_t>(++bits)];
    return bits;
  }

  void add_members(const ChunkEntry& child, const std::vector<SurfelBlock>& blocks, const VoxelCursor& cursor) {
    const Vec3d octant(65536.0 * static_cast<double>(child.morton & 1), 65536.0 * static_cast<double>(child.morton >> 1 & 1), 65536.0 * static_cast<double>(child.morton >> 2 & 1));
    const RadiusTable radii(child.radius_max);
    cursor.for_each_voxel([&](std::uint32_t group, std::span<const std::uint16_t> slots) {
      if (group != group_) {
        finish_group();
        group_ = group;
      }
      if (num_members_ == 0) voxel_ = code_in_parent(child, blocks[slots.front() / 16], slots.front() % 16) >> (3 * (17 - voxel_bits_));
      for (const std::uint16_t slot : slots) {
        const SurfelBlock& b = blocks[slot / 16];
        const std::size_t lane = slot % 16;
        add({(octant + Vec3d(b.x[lane] + 0.5, b.y[lane] + 0.5, b.z[lane] + 0.5)) / 2, decode_normal(b.normal_u[lane], b.normal_v[lane]), radii.decode(b.log_radius[lane]), b.flags[lane]});
      }
    });
  }

  void add(const Member& m) {
    ++num_members_;
    position_sum_ += m.position;
    largest_radius_ = std::max(largest_radius_, m.radius);
    any_flags_ = static_cast<std::uint8_t>(any_flags_ | m.flags);
    all_flags_ = static_cast<std::uint8_t>(all_flags_ & m.flags);
    // A sign that is not known follows the members before.
    const bool turn = !(m.flags & SurfelBlock::kOriented) && normal_sum_.dot(m.normal.cast<double>()) < 0;
    normal_sum_ += (turn ? -1.0 : 1.0) * m.normal.cast<double>();
    if (members_.size() < kMostMembers) members_.push_back(m);
  }

  void finish_group() {
    if (num_members_ == 0) return;
    const auto slot = static_cast<std::uint32_t>(radii_.size());
    if (slot % 16 == 0) out_.blocks.emplace_back();
    SurfelBlock& b = out_.blocks.back();
    const std::size_t lane = slot % 16;
    const Vec3d mean = position_sum_ / static_cast<double>(num_members_);
    const auto voxel = morton_decode(voxel_);
    Vec3d stored;
    std::array<std::uint16_t, 3> q;
    for (std::size_t a = 0; a < 3; ++a) {
      const int shift = kLocalBits - voxel_bits_;
      const std::uint32_t low = voxel[a] << shift, high = low + ((1u << shift) - 1);
      q[a] = static_cast<std::uint16_t>(std::clamp(static_cast<std::uint32_t>(mean[static_cast<int>(a)]), low, high));
      stored[static_cast<int>(a)] = q[a] + 0.5;
    }
    b.x[lane] = q[0];
    b.y[lane] = q[1];
    b.z[lane] = q[2];
    const double length = normal_sum_.norm();
    const Vec3f normal = length > 1e-3 ? Vec3f((normal_sum_ / length).cast<float>()) : members_[0].normal;
    const auto code = encode_normal(normal);
    b.normal_u[lane] = code[0];
    b.normal_v[lane] = code[1];
    constexpr std::uint8_t kAll = SurfelBlock::kOriented | SurfelBlock::kIsolated;
    b.flags[lane] = static_cast<std::uint8_t>((any_flags_ & SurfelBlock::kEstimated) | (all_flags_ & kAll));
    radii_.push_back(covering_radius(stored, normal));
    position_sum_ = Vec3d::Zero();
    normal_sum_ = Vec3d::Zero();
    num_members_ = 0;
    largest_radius_ = 0;
    any_flags_ = 0;
    all_flags_ = 0xff;
    members_.clear();
  }

  // Reaches over every member's disc, but never further than across the voxel (or the largest member itself).
  float covering_radius(const Vec3d& stored, const Vec3f& normal) const {
    const double diagonal = std::sqrt(3.0) * std::ldexp(65536 * frame_.step, -voxel_bits_);
    const double most = std::max<double>(diagonal, largest_radius_);
    if (num_members_ > members_.size()) return static_cast<float>(most);
    double radius = 0;
    for (const Member& m : members_) {
      const Vec3d offset = frame_.step * (m.position - stored);
      const Vec3d in_plane = offset - normal.cast<double>() * normal.cast<double>().dot(offset);
      radius = std::max(radius, in_plane.norm() + m.radius);
    }
    return static_cast<float>(std::min(radius, most));
  }

  void seal() {
    ChunkEntry& e = out_.entry;
    e.count = static_cast<std::uint32_t>(radii_.size());
    e.radius_max = *std::max_element(radii_.begin(), radii_.end());
    e.spacing = static_cast<float>(std::ldexp(65536 * frame_.step, -voxel_bits_));
    e.tight_min = {65535, 65535, 65535};
    e.tight_max = {0, 0, 0};
    const RadiusTable radii(e.radius_max);
    for (std::uint32_t slot = 0; slot < out_.blocks.size() * 16; ++slot) {
      SurfelBlock& b = out_.blocks[slot / 16];
      const std::size_t lane = slot % 16;
      if (slot >= e.count) {
        const std::size_t last = (e.count - 1) % 16;
        b.x[lane] = b.x[last];
        b.y[lane] = b.y[last];
        b.z[lane] = b.z[last];
        b.normal_u[lane] = b.normal_u[last];
        b.normal_v[lane] = b.normal_v[last];
        b.log_radius[lane] = 0;
        b.flags[lane] = SurfelBlock::kPadding;
        continue;
      }
      b.log_radius[lane] = radii.encode(radii_[slot]);
      const std::array<std::uint16_t, 3> q{b.x[lane], b.y[lane], b.z[lane]};
      for (std::size_t a = 0; a < 3; ++a) {
        e.tight_min[a] = std::min(e.tight_min[a], q[a]);
        e.tight_max[a] = std::max(e.tight_max[a], q[a]);
      }
    }
    e.geometry_crc = crc32c(out_.blocks.data(), geometry_bytes(e.count));
  }

  const ReadBlocks& read_;
  const std::vector<ChunkEntry>& entries_;
  std::uint32_t most_;
  InnerNode out_;
  std::vector<float> radii_;
  ChunkFrame frame_;
  MortonOrder morton_;
  std::array<KeptOrder, 8> orders_;
  int voxel_bits_ = 0;
  std::uint32_t group_ = 0;
  std::uint64_t voxel_ = 0, num_members_ = 0;
  Vec3d position_sum_ = Vec3d::Zero(), normal_sum_ = Vec3d::Zero();
  float largest_radius_ = 0;
  std::uint8_t any_flags_ = 0, all_flags_ = 0xff;
  std::vector<Member> members_;
};

}  // namespace

InnerNode make_inner_node(const Manifest& manifest, const std::vector<ChunkEntry>& entries, const ChunkEntry& node, const ReadBlocks& read, std::uint32_t chunk_surfels,
                          int voxel_bits) {
  return NodeBuilder(read, manifest, entries, node, chunk_surfels).run(voxel_bits);
}

void VoxelCursor::next_child(const ChunkEntry& child, const std::vector<SurfelBlock>& blocks, std::span<const std::uint16_t> order, std::span<const std::uint16_t> differences) {
  order_ = order;
  const auto place = [&](std::uint16_t slot) { return place_in_parent(child, blocks[slot / 16], slot % 16); };
  if (num_voxels_ == 0 || differing_bits(place(order.front()), last_) >> shift_ != 0) ++num_voxels_;
  first_ = num_voxels_ - 1;
  begins_.resize(order.size() + 1);
  std::uint32_t n = 1;
  begins_[0] = 0;
  for (std::uint32_t i = 1; i < order.size(); ++i) {
    begins_[n] = i;
    n += std::uint32_t{differences[i]} >> shift_ != 0;
  }
  begins_[n] = static_cast<std::uint32_t>(order.size());
  begins_.resize(n + 1);
  num_voxels_ += n - 1;
  last_ = place(order.back());
}

std::uint64_t build_inner_levels(File& geometry, std::uint64_t geometry_end, const Manifest& manifest, std::vector<ChunkEntry>& entries, std::uint32_t chunk_surfels,
                                 MemoryBudget& budget, Reporter& report) {
  std::uint64_t num_inner = 0;
  for (const ChunkEntry& e : entries) num_inner += !e.is_leaf();
  report.begin("inner levels", num_inner, "chunks");
  std::uint64_t done = 0;
  const std::uint64_t per_node = 80ull * chunk_surfels + kMostMembers * sizeof(Member) / 8;
  const auto workers = static_cast<std::size_t>(std::clamp<std::uint64_t>(budget.free_bytes() / 2 / per_node, 1, static_cast<std::uint64_t>(std::clamp(ThreadLimit::current(), 1, 64))));
  const std::size_t slots = workers + 1;
  const BudgetLease lease(budget, per_node * workers + 16ull * chunk_surfels * slots, "inner levels");
  const ReadBlocks read = [&](std::uint32_t chunk) { return read_blocks(geometry, entries[chunk]); };
  // Deeper levels stand behind in the index; a level is finished before the one above reads it.
  for (std::size_t end = entries.size(); end > 0;) {
    std::size_t begin = end;
    while (begin > 0 && entries[begin - 1].level == entries[end - 1].level) --begin;
    std::vector<std::size_t> nodes;
    for (std::size_t i = begin; i < end; ++i)
      if (!entries[i].is_leaf()) nodes.push_back(i);
    std::vector<InnerNode> made(slots);
    std::vector<std::size_t> node_in(slots);
    std::size_t next = 0;
    const auto start = [&](std::size_t slot) {
      if (next == nodes.size()) return false;
      node_in[slot] = nodes[next++];
      return true;
    };
    const auto make = [&](std::size_t slot) {
      report.check();
      made[slot] = make_inner_node(manifest, entries, entries[node_in[slot]], read, chunk_surfels);
    };
    const auto store = [&](std::size_t slot) {
      InnerNode node = std::move(made[slot]);
      node.entry.offset = geometry_end;
      geometry.write_at(geometry_end, node.blocks.data(), geometry_bytes(node.entry.count));
      geometry_end += (geometry_bytes(node.entry.count) + kChunkAlignment - 1) / kChunkAlignment * kChunkAlignment;
      entries[node_in[slot]] = node.entry;
      report.progress(++done);
    };
    ordered_pipeline(slots, start, make, store);
    end = begin;
  }
  report.end();
  return geometry_end;
}

std::vector<ChunkEntry> link_index(const std::vector<ChunkEntry>& leaves) {
  std::vector<std::vector<ChunkEntry>> levels(kMaxLevel + 1);
  for (const ChunkEntry& leaf : leaves) levels[leaf.level].push_back(leaf);
  for (int level = kMaxLevel; level > 0; --level) {
    std::vector<ChunkEntry>& here = levels[static_cast<std::size_t>(level)];
    std::vector<ChunkEntry>& above = levels[static_cast<std::size_t>(level - 1)];
    std::vector<ChunkEntry> parents;
    for (const ChunkEntry& e : here) {
      if (parents.empty() || parents.back().morton != e.morton >> 3) {
        parents.emplace_back();
        parents.back().morton = e.morton >> 3;
        parents.back().level = static_cast<std::uint8_t>(level - 1);
      }
      ++parents.back().num_children;
    }
    above.insert(above.end(), parents.begin(), parents.end());
    std::sort(above.begin(), above.end(), [](const ChunkEntry& a, const ChunkEntry& b) { return a.morton != b.morton ? a.morton < b.morton : a.part < b.part; });
  }
  std::vector<ChunkEntry> entries;
  for (auto& level : levels) entries.insert(entries.end(), level.begin(), level.end());
  std::uint32_t next = 1;
  for (std::uint32_t i = 0; i < entries.size(); ++i) {
    ChunkEntry& e = entries[i];
    if (e.is_leaf()) continue;
    e.first_child = next;
    for (std::uint32_t c = 0; c < e.num_children; ++c) entries[next + c].parent = i;
    next += e.num_children;
  }
  return entries;
}

}  // namespace chiaro::stream
