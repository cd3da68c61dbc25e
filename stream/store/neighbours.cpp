#include "stream/store/neighbours.h"

#include <algorithm>
#include <cstring>

namespace chiaro::stream {
namespace {

constexpr float kFar = 1e30f;
using FlatBox = HaloChunk::FlatBox;

FlatBox empty_box() { return {{kFar, kFar, kFar}, {-kFar, -kFar, -kFar}}; }

void extend(FlatBox& a, const FlatBox& b) {
  for (std::size_t i = 0; i < 3; ++i) {
    a.min[i] = std::min(a.min[i], b.min[i]);
    a.max[i] = std::max(a.max[i], b.max[i]);
  }
}

float gap_squared(const FlatBox& a, const FlatBox& b) {
  float sum = 0;
  for (std::size_t i = 0; i < 3; ++i) {
    const float gap = std::max(0.0f, std::max(a.min[i] - b.max[i], b.min[i] - a.max[i]));
    sum += gap * gap;
  }
  return sum;
}

EightBoxes no_boxes() {
  EightBoxes b;
  for (std::size_t a = 0; a < 3; ++a)
    for (std::size_t i = 0; i < 8; ++i) {
      b.min[a][i] = kFar;
      b.max[a][i] = -kFar;
    }
  return b;
}

void put(BoxLevels& levels, std::size_t level, std::size_t number, const FlatBox& box) {
  if (number / 8 >= levels[level].size()) levels[level].push_back(no_boxes());
  EightBoxes& b = levels[level][number / 8];
  for (std::size_t a = 0; a < 3; ++a) {
    b.min[a][number % 8] = box.min[a];
    b.max[a][number % 8] = box.max[a];
  }
}

// Four side by side, and these together at the end: of a whole group.
void extent_of(const float* v, float& low, float& high) {
  std::array<float, 4> least, most;
  for (std::size_t k = 0; k < 4; ++k) least[k] = most[k] = v[k];
  for (std::size_t i = 4; i < HaloChunk::kGroup; i += 4)
    for (std::size_t k = 0; k < 4; ++k) {
      least[k] = v[i + k] < least[k] ? v[i + k] : least[k];
      most[k] = v[i + k] > most[k] ? v[i + k] : most[k];
    }
  low = std::min(std::min(least[0], least[1]), std::min(least[2], least[3]));
  high = std::max(std::max(most[0], most[1]), std::max(most[2], most[3]));
}

void build_levels(HaloChunk& c) {
  std::vector<FlatBox> boxes(c.x.size() / HaloChunk::kGroup, empty_box());
  const std::size_t whole = c.size / HaloChunk::kGroup;
  const float* const columns[3] = {c.x.data(), c.y.data(), c.z.data()};
  for (std::size_t group = 0; group < whole; ++group)
    for (std::size_t a = 0; a < 3; ++a) extent_of(columns[a] + group * HaloChunk::kGroup, boxes[group].min[a], boxes[group].max[a]);
  for (std::size_t i = whole * HaloChunk::kGroup; i < c.size; ++i) extend(boxes[whole], {{c.x[i], c.y[i], c.z[i]}, {c.x[i], c.y[i], c.z[i]}});
  for (;;) {
    c.levels.emplace_back();
    for (std::size_t i = 0; i < boxes.size(); ++i) put(c.levels, c.levels.size() - 1, i, boxes[i]);
    std::vector<FlatBox> above((boxes.size() + 7) / 8, empty_box());
    for (std::size_t i = 0; i < boxes.size(); ++i) extend(above[i / 8], boxes[i]);
    boxes = std::move(above);
    if (boxes.size() == 1) break;
  }
  c.bounds = boxes[0];
}

}  // namespace

HaloChunk::FlatBox HaloChunk::box_of_group(std::uint32_t group) const {
  const EightBoxes& b = levels[0][group / 8];
  const std::size_t i = group % 8;
  return {{b.min[0][i], b.min[1][i], b.min[2][i]}, {b.max[0][i], b.max[1][i], b.max[2][i]}};
}

std::uint64_t HaloChunk::bytes_for(std::uint32_t count) { return 34ull * count + 1024; }

namespace {

// The first so many surfels of a block, each on a spot of its own?
bool all_differ(const SurfelBlock& b, std::uint32_t count) {
  std::uint32_t same = 0;
  for (std::uint32_t lane = 1; lane < count; ++lane) same |= static_cast<std::uint32_t>((b.x[lane] == b.x[lane - 1]) & (b.y[lane] == b.y[lane - 1]) & (b.z[lane] == b.z[lane - 1]));
  return same == 0;
}

// Appends the points of blocks to a chunk that has room for all.
class HaloFiller {
 public:
  HaloFiller(HaloChunk& chunk, float step, bool with_normals) : c_(chunk), step_(step), with_normals_(with_normals) {}

  void add(const SurfelBlock& b, std::uint32_t first_slot, std::uint32_t count) {
    const std::array<std::uint16_t, 3> first{b.x[0], b.y[0], b.z[0]};
    if (count == kBlockSurfels && all_differ(b, count) && (first_slot == 0 || first != before_)) {
      add_whole(b, first_slot);
    } else {
      if (with_normals_) decode_normals(b, nx_.data(), ny_.data(), nz_.data());
      for (std::uint32_t lane = 0; lane < count; ++lane) add_one(b, first_slot + lane, lane);
    }
    before_ = {b.x[count - 1], b.y[count - 1], b.z[count - 1]};
  }

 private:
  void add_whole(const SurfelBlock& b, std::uint32_t first_slot) {
    const std::size_t i = c_.size;
    place(b.x, &c_.x[i]);
    place(b.y, &c_.y[i]);
    place(b.z, &c_.z[i]);
    if (with_normals_) decode_normals(b, &c_.nx[i], &c_.ny[i], &c_.nz[i]);
    for (std::uint32_t lane = 0; lane < kBlockSurfels; ++lane) {
      c_.flags[i + lane] = b.flags[lane] & SurfelBlock::kFlags;
      c_.first_slot[i + lane] = first_slot + lane;
    }
    c_.size += kBlockSurfels;
  }

  void place(const std::array<std::uint16_t, kBlockSurfels>& q, float* to) const {
    for (std::size_t lane = 0; lane < kBlockSurfels; ++lane) to[lane] = (static_cast<float>(q[lane]) + 0.5f) * step_;
  }

  void add_one(const SurfelBlock& b, std::uint32_t slot, std::uint32_t lane) {
    const std::array<std::uint16_t, 3> q{b.x[lane], b.y[lane], b.z[lane]};
    if (slot > 0 && q == before_) return;
    before_ = q;
    const std::size_t i = c_.size++;
    c_.first_slot[i] = slot;
    c_.x[i] = (static_cast<float>(q[0]) + 0.5f) * step_;
    c_.y[i] = (static_cast<float>(q[1]) + 0.5f) * step_;
    c_.z[i] = (static_cast<float>(q[2]) + 0.5f) * step_;
    if (with_normals_) {
      c_.nx[i] = nx_[lane];
      c_.ny[i] = ny_[lane];
      c_.nz[i] = nz_[lane];
    }
    c_.flags[i] = b.flags[lane] & SurfelBlock::kFlags;
  }

  HaloChunk& c_;
  float step_;
  bool with_normals_;
  std::array<std::uint16_t, 3> before_{};
  std::array<float, kBlockSurfels> nx_, ny_, nz_;
};

std::size_t whole_groups(std::uint32_t count) { return (count + HaloChunk::kGroup - 1) / HaloChunk::kGroup * HaloChunk::kGroup; }

}  // namespace

std::shared_ptr<const HaloChunk> make_halo_chunk(std::uint32_t index, const ChunkFrame& frame, const std::vector<SurfelBlock>& blocks, std::uint32_t count, bool with_normals) {
  auto chunk = std::make_shared<HaloChunk>();
  HaloChunk& c = *chunk;
  c.index = index;
  c.origin_in_world = frame.origin_in_world;
  const auto resize = [&](std::size_t room) {
    for (std::vector<float>* v : {&c.x, &c.y, &c.z}) v->resize(room);
    if (with_normals)
      for (std::vector<float>* v : {&c.nx, &c.ny, &c.nz}) v->resize(room);
    c.flags.resize(room);
  };
  resize(whole_groups(count));
  c.first_slot.resize(count + 1);
  HaloFiller filler(c, static_cast<float>(frame.step), with_normals);
  for (std::uint32_t first = 0; first < count; first += kBlockSurfels) filler.add(blocks[first / kBlockSurfels], first, std::min<std::uint32_t>(kBlockSurfels, count - first));
  c.first_slot[c.size] = count;
  c.first_slot.resize(c.size + 1);
  resize(whole_groups(c.size));
  for (std::vector<float>* v : {&c.x, &c.y, &c.z}) std::fill(v->begin() + c.size, v->end(), kFar);
  c.any_oriented = std::any_of(c.flags.begin(), c.flags.begin() + c.size, [](std::uint8_t flags) { return (flags & SurfelBlock::kOriented) != 0; });
  build_levels(c);
  return chunk;
}

bool HaloCache::evict_one() {
  for (auto it = order_.rbegin(); it != order_.rend(); ++it) {
    const auto slot = slots_.find(*it);
    if (slot->second.chunk.use_count() > 1) continue;
    held_bytes_ -= slot->second.lease.bytes();
    order_.erase(slot->second.place);
    slots_.erase(slot);
    return true;
  }
  return false;
}

std::shared_ptr<const HaloChunk> HaloCache::get(std::uint32_t chunk) {
  {
    const std::lock_guard lock(mutex_);
    const auto it = slots_.find(chunk);
    if (it != slots_.end()) {
      order_.splice(order_.begin(), order_, it->second.place);
      return it->second.chunk;
    }
  }
  // Room is made before loading; two threads may load the same chunk, the second copy is then dropped.
  const std::uint64_t bytes = bytes_of_(chunk);
  BudgetLease lease;
  {
    const std::lock_guard lock(mutex_);
    while ((budget_.free_bytes() < bytes || held_bytes_ + bytes > most_bytes_) && evict_one()) {
    }
    lease = BudgetLease(budget_, bytes, "points around a chunk");
  }
  auto loaded = load_(chunk);
  const std::lock_guard lock(mutex_);
  const auto it = slots_.find(chunk);
  if (it != slots_.end()) return it->second.chunk;
  order_.push_front(chunk);
  held_bytes_ += lease.bytes();
  slots_.emplace(chunk, Slot{loaded, std::move(lease), order_.begin()});
  return loaded;
}

Neighbourhood::Neighbourhood(std::shared_ptr<const HaloChunk> own, const Box3d& own_bounds, const Find& find, HaloCache& cache)
    : own_(std::move(own)), own_bounds_(own_bounds), find_(find), cache_(cache) {
  find_near(static_cast<float>((own_bounds.max - own_bounds.min).maxCoeff() / 16));
}

void Neighbourhood::find_near(float radius) {
  near_radius_ = radius;
  near_.clear();
  Box3d grown = own_bounds_;
  grown.min -= Vec3d::Constant(1.001 * radius);
  grown.max += Vec3d::Constant(1.001 * radius);
  for (const auto& [chunk, box] : find_(grown)) {
    if (chunk == own_->index) continue;
    Near n{chunk, {}};
    for (int a = 0; a < 3; ++a) {
      const double low = box.min[a] - own_->origin_in_world[a], high = box.max[a] - own_->origin_in_world[a];
      const double slack = 1e-6 * std::max(std::abs(low), std::abs(high));  // doubles to floats, outwards
      n.box.min[static_cast<std::size_t>(a)] = static_cast<float>(low - slack);
      n.box.max[static_cast<std::size_t>(a)] = static_cast<float>(high + slack);
    }
    near_.push_back(n);
  }
}

void Neighbourhood::gather_from(const HaloChunk& c, const FlatBox& box, float radius, const Vec3d* shift, Selection& out) {
  const std::size_t first = out.num;
  CandidateView points{c.x.data(), c.y.data(), c.z.data(), c.x.size()};
  if (out.has_normals) {
    points.nx = c.nx.data();
    points.ny = c.ny.data();
    points.nz = c.nz.data();
  }
  select_from_tree(points, c.levels, box.min, box.max, radius * radius, out);
  if (out.has_normals && !c.any_oriented) std::fill(out.oriented.begin() + static_cast<std::ptrdiff_t>(first), out.oriented.begin() + static_cast<std::ptrdiff_t>(out.num), 0u);
  if (out.has_normals && c.any_oriented)
    for (std::size_t i = first; i < out.num; ++i) out.oriented[i] = 0u - static_cast<std::uint32_t>((c.flags[out.index[i]] & SurfelBlock::kOriented) != 0);
  if (!shift) return;
  for (std::size_t i = first; i < out.num; ++i) {
    out.x[i] = static_cast<float>(shift->x() + out.x[i]);
    out.y[i] = static_cast<float>(shift->y() + out.y[i]);
    out.z[i] = static_cast<float>(shift->z() + out.z[i]);
  }
}

void Neighbourhood::gather(const FlatBox& box, float radius, bool with_normals, Selection& out) {
  if (radius > near_radius_) find_near(2 * radius);
  out.num = 0;
  out.reserve(0, with_normals, with_normals);   // by which it is looked up whether signs are known
  gather_from(*own_, box, radius, nullptr, out);
  for (const Near& n : near_) {
    if (gap_squared(n.box, box) > radius * radius) continue;
    const auto chunk = cache_.get(n.chunk);
    const Vec3d shift = chunk->origin_in_world - own_->origin_in_world;
    FlatBox there = box;
    float magnitude = 0;
    for (std::size_t a = 0; a < 3; ++a) {
      there.min[a] = static_cast<float>(box.min[a] - shift[static_cast<int>(a)]);
      there.max[a] = static_cast<float>(box.max[a] - shift[static_cast<int>(a)]);
      magnitude = std::max({magnitude, std::abs(there.min[a]), std::abs(there.max[a])});
    }
    gather_from(*chunk, there, radius + 4e-7f * magnitude, &shift, out);  // grown by the rounding of the shift
  }
  out.pad();
}

}  // namespace chiaro::stream
