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

void build_levels(HaloChunk& c) {
  std::vector<FlatBox> boxes(c.x.size() / HaloChunk::kGroup, empty_box());
  for (std::size_t i = 0; i < c.size; ++i) extend(boxes[i / HaloChunk::kGroup], {{c.x[i], c.y[i], c.z[i]}, {c.x[i], c.y[i], c.z[i]}});
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

std::uint64_t HaloChunk::bytes_for(std::uint32_t count) { return 34ull * count + 1024; }

std::shared_ptr<const HaloChunk> make_halo_chunk(std::uint32_t index, const ChunkFrame& frame, const std::vector<SurfelBlock>& blocks, std::uint32_t count, bool with_normals) {
  auto chunk = std::make_shared<HaloChunk>();
  HaloChunk& c = *chunk;
  c.index = index;
  c.origin_in_world = frame.origin_in_world;
  const auto step = static_cast<float>(frame.step);
  const auto position = [&](std::uint32_t i) {
    const SurfelBlock& b = blocks[i / 16];
    return std::array<std::uint16_t, 3>{b.x[i % 16], b.y[i % 16], b.z[i % 16]};
  };
  for (std::uint32_t i = 0; i < count; ++i)
    if (i == 0 || position(i) != position(i - 1)) c.first_slot.push_back(i);
  c.size = static_cast<std::uint32_t>(c.first_slot.size());
  c.first_slot.push_back(count);
  const std::size_t padded = (c.size + HaloChunk::kGroup - 1) / HaloChunk::kGroup * HaloChunk::kGroup;
  c.x.assign(padded, kFar);
  c.y.assign(padded, kFar);
  c.z.assign(padded, kFar);
  c.flags.resize(padded);
  if (with_normals)
    for (std::vector<float>* v : {&c.nx, &c.ny, &c.nz}) v->resize(padded);
  for (std::uint32_t i = 0; i < c.size; ++i) {
    const std::uint32_t slot = c.first_slot[i];
    const auto q = position(slot);
    c.x[i] = (static_cast<float>(q[0]) + 0.5f) * step;
    c.y[i] = (static_cast<float>(q[1]) + 0.5f) * step;
    c.z[i] = (static_cast<float>(q[2]) + 0.5f) * step;
    if (with_normals) {
      const Vec3f n = decode_normal(blocks[slot / 16].normal_u[slot % 16], blocks[slot / 16].normal_v[slot % 16]);
      c.nx[i] = n.x();
      c.ny[i] = n.y();
      c.nz[i] = n.z();
    }
    c.flags[i] = blocks[slot / 16].flags[slot % 16] & SurfelBlock::kFlags;
  }
  build_levels(c);
  return chunk;
}

bool HaloCache::evict_one() {
  for (auto it = order_.rbegin(); it != order_.rend(); ++it) {
    const auto slot = slots_.find(*it);
    if (slot->second.chunk.use_count() > 1) continue;
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
    while (budget_.free_bytes() < bytes && evict_one()) {
    }
    lease = BudgetLease(budget_, bytes, "points around a chunk");
  }
  auto loaded = load_(chunk);
  const std::lock_guard lock(mutex_);
  const auto it = slots_.find(chunk);
  if (it != slots_.end()) return it->second.chunk;
  order_.push_front(chunk);
  slots_.emplace(chunk, Slot{loaded, std::move(lease), order_.begin()});
  return loaded;
}

void Candidates::reserve(std::size_t size) {
  if (x.size() >= size) return;
  size = std::max(size, 2 * x.size());
  x.resize(size);
  y.resize(size);
  z.resize(size);
  for (std::vector<float>* v : {&nx, &ny, &nz}) v->resize(size);
  flags.resize(size);
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

void Neighbourhood::gather_from(const HaloChunk& c, const FlatBox& box, float radius, const Vec3d* shift, bool with_normals, Candidates& out) {
  selection_.num = 0;
  select_from_tree({c.x.data(), c.y.data(), c.z.data(), c.x.size()}, c.levels, box.min, box.max, radius * radius, selection_);
  const std::size_t n = selection_.num;
  out.reserve(out.num + n + 8);
  for (std::size_t i = 0; i < n; ++i) {
    out.x[out.num + i] = selection_.x[i];
    out.y[out.num + i] = selection_.y[i];
    out.z[out.num + i] = selection_.z[i];
  }
  if (with_normals) {
    for (std::size_t i = 0; i < n; ++i) {
      const std::size_t from = selection_.index[i], to = out.num + i;
      out.nx[to] = c.nx[from];
      out.ny[to] = c.ny[from];
      out.nz[to] = c.nz[from];
      out.flags[to] = c.flags[from];
    }
  }
  if (shift) {
    for (std::size_t i = out.num; i < out.num + n; ++i) {
      out.x[i] = static_cast<float>(shift->x() + out.x[i]);
      out.y[i] = static_cast<float>(shift->y() + out.y[i]);
      out.z[i] = static_cast<float>(shift->z() + out.z[i]);
    }
  }
  out.num += n;
}

void Neighbourhood::gather(const FlatBox& box, float radius, bool with_normals, Candidates& out) {
  if (radius > near_radius_) find_near(2 * radius);
  out.num = 0;
  gather_from(*own_, box, radius, nullptr, with_normals, out);
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
    gather_from(*chunk, there, radius + 4e-7f * magnitude, &shift, with_normals, out);  // grown by the rounding of the shift
  }
  out.reserve(out.num + 8);
  for (std::size_t i = out.num; i < out.num + 8; ++i) out.x[i] = out.y[i] = out.z[i] = kFar;
}

}  // namespace chiaro::stream
