#include <algorithm>
#include <array>
#include <mutex>

#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/store/inner_levels.h"
#include "stream/store/layer.h"
#include "stream/store/morton.h"
#include "stream/store/octree_build.h"
#include "stream/store/store_format.h"
#include "stream/store/surfel_order.h"

namespace chiaro::stream {
namespace {

constexpr std::size_t kMostProblems = 1000;  // more tell nothing new

class Verifier {
 public:
  Verifier(const std::filesystem::path& path, MemoryBudget& budget, Reporter& report) : path_(path), budget_(budget), report_(report) {}

  VerifyResult run() {
    try {
      const Store store(path_);
      result_.chunks = store.chunks().size();
      check_totals(store);
      check_geometry(store);
      check_inner(store);
      check_sources(store);
      for (const std::string& name : layer_names(store)) check_layer(store, name);
      check_layer_folders(store);
    } catch (const Error& e) {
      problem(e.what());
    }
    return std::move(result_);
  }

 private:
  void problem(const std::string& text) {
    const std::lock_guard lock(mutex_);
    if (result_.problems.size() < kMostProblems) result_.problems.push_back(text);
  }

  // Runs body(chunk) for all chunks; an Error becomes a problem. Problems come in the order of the chunks.
  template <class Body>
  void for_each_chunk(const Store& store, const std::string& stage, const Body& body) {
    const std::size_t n = store.chunks().size();
    constexpr std::size_t kWave = 256;
    report_.begin(stage, n, "chunks");
    for (std::size_t first = 0; first < n; first += kWave) {
      report_.check();
      std::vector<std::string> found(std::min(kWave, n - first));
      parallel_blocks(found.size(), 1, [&](std::size_t i, std::size_t) {
        try {
          body(static_cast<std::uint32_t>(first + i));
        } catch (const Error& e) {
          found[i] = e.what();
        }
      });
      for (const std::string& text : found)
        if (!text.empty()) problem(text);
      report_.progress(first + found.size());
    }
    report_.end();
  }

  static std::string where(const Store& store, std::uint32_t chunk) { return concat(geometry_path(store.path()).string(), ": chunk ", chunk); }

  // What opening a store leaves out.
  void check_totals(const Store& store) {
    const auto expect_size = [&](const std::filesystem::path& path, std::uint64_t expected) {
      if (const std::uint64_t size = std::filesystem::file_size(path); size != expected) problem(concat(path.string(), ": ", size, " bytes, expected ", expected));
    };
    expect_size(geometry_path(path_), geometry_file_bytes(store.chunks()));
    expect_size(source_path(path_), store.manifest().points_stored * kSourceBytes);
    Box3d bounds;
    for (const std::uint32_t leaf : store.leaves()) {
      bounds.extend(store.bounds(leaf).min);
      bounds.extend(store.bounds(leaf).max);
    }
    if (bounds.min != store.manifest().bounds.min || bounds.max != store.manifest().bounds.max) problem(concat(manifest_path(path_).string(), ": bounds are not those of the leaves"));
  }

  void check_geometry(const Store& store) {
    const File geometry(geometry_path(path_), File::Mode::kRead);
    for_each_chunk(store, "verify geometry", [&](std::uint32_t i) {
      if (const auto at = byte_behind(geometry, store.chunks()[i])) throw Error(concat(geometry.path().string(), ": byte ", *at, " between chunks is not zero"));
      const Chunk chunk = store.read_chunk(i);
      const ChunkEntry& e = store.chunks()[i];
      std::array<std::uint16_t, 3> low{65535, 65535, 65535}, high{0, 0, 0};
      std::uint8_t largest = 0;
      for (std::uint32_t slot = 0; slot < chunk.blocks.size() * 16; ++slot) {
        const SurfelBlock& b = chunk.blocks[slot / 16];
        const std::size_t lane = slot % 16;
        const bool padding = (b.flags[lane] & SurfelBlock::kPadding) != 0;
        if (padding != (slot >= e.count)) throw Error(concat(where(store, i), ", slot ", slot, ": ", padding ? "padding inside the chunk" : "a surfel behind the end"));
        if (padding) continue;
        const std::array<std::uint16_t, 3> q{b.x[lane], b.y[lane], b.z[lane]};
        for (std::size_t a = 0; a < 3; ++a) {
          low[a] = std::min(low[a], q[a]);
          high[a] = std::max(high[a], q[a]);
        }
        largest = std::max(largest, b.log_radius[lane]);
      }
      check_order(store, i, chunk);
      if (low != e.tight_min || high != e.tight_max) throw Error(concat(where(store, i), ": bounds in the index are not those of the surfels"));
      if (largest != 255) throw Error(concat(where(store, i), ": the largest radius is not the one in the index"));
    });
  }

  // Those on one spot follow each other; inner nodes are in Morton order.
  static void check_order(const Store& store, std::uint32_t i, const Chunk& chunk) {
    MortonOrder morton;
    const std::span<const std::uint16_t> order = morton.of(chunk.blocks, chunk.count);
    const auto code = [&](std::uint16_t slot) {
      const SurfelBlock& b = chunk.blocks[slot / 16];
      return morton_encode(b.x[slot % 16], b.y[slot % 16], b.z[slot % 16]);
    };
    for (std::size_t k = 1; k < order.size(); ++k) {
      const bool follows = order[k] == order[k - 1] + 1;
      if (follows) continue;
      if (!store.chunks()[i].is_leaf()) throw Error(concat(where(store, i), ", slot ", order[k], ": not in Morton order"));
      if (code(order[k]) == code(order[k - 1])) throw Error(concat(where(store, i), ", slot ", order[k], ": apart from others on the same spot"));
    }
  }

  // Each inner surfel stands for a voxel that its children occupy, and lies in it.
  void check_inner(const Store& store) {
    for_each_chunk(store, "verify inner levels", [&](std::uint32_t i) {
      const ChunkEntry& e = store.chunks()[i];
      if (e.is_leaf()) return;
      const Chunk chunk = store.read_chunk(i);
      const int bits = static_cast<int>(e.source_offset), shift = 3 * (kLocalBits - bits);
      VoxelCursor cursor(bits);
      MortonOrder morton;
      for (std::uint32_t c = 0; c < e.num_children; ++c) {
        const Chunk child = store.read_chunk(e.first_child + c);
        const ChunkEntry& child_entry = store.chunks()[e.first_child + c];
        const std::span<const std::uint16_t> order = morton.of(child.blocks, child.count);
        cursor.next_child(child_entry, child.blocks, order, morton.differences());
        cursor.for_each_voxel([&](std::uint32_t number, std::span<const std::uint16_t> slots) {
          if (number >= e.count) throw Error(concat(where(store, i), ": ", e.count, " surfels, its children occupy more voxels"));
          const SurfelBlock& p = chunk.blocks[number / 16];
          const std::size_t up = number % 16;
          for (const std::uint16_t slot : slots) {
            const SurfelBlock& b = child.blocks[slot / 16];
            const std::size_t lane = slot % 16;
            const std::uint64_t voxel = ((child_entry.morton & 7) << 48 | morton_encode(b.x[lane], b.y[lane], b.z[lane])) >> (3 * (17 - bits));
            if (morton_encode(p.x[up], p.y[up], p.z[up]) >> shift != voxel) throw Error(concat(where(store, i), ", slot ", number, ": does not lie in the voxel of its children"));
          }
        });
      }
      if (cursor.num_voxels() != e.count) throw Error(concat(where(store, i), ": ", e.count, " surfels, its children occupy ", cursor.num_voxels(), " voxels"));
    });
  }

  // Every source index once: a bitmap over as many numbers as the budget allows at a time.
  void check_sources(const Store& store) {
    const std::uint64_t numbers = store.manifest().points_read;
    for (const std::uint32_t leaf : store.leaves()) result_.surfels += store.chunks()[leaf].count;
    const std::uint64_t bitmap = std::min(numbers / 8 + 8, std::max<std::uint64_t>(4096, budget_.free_bytes() / 2));
    const BudgetLease lease(budget_, bitmap, "bitmap of source indices");
    std::vector<std::uint8_t> seen(bitmap);
    report_.begin("verify source indices", store.leaves().size() * ((numbers + 8 * bitmap - 1) / (8 * bitmap)), "chunks");
    std::uint64_t done = 0;
    for (std::uint64_t first = 0; first < numbers; first += 8 * bitmap) {
      std::fill(seen.begin(), seen.end(), std::uint8_t{0});
      for (const std::uint32_t leaf : store.leaves()) {
        report_.check();
        try {
          for (const std::uint64_t s : store.read_sources(leaf)) {
            if (s >= numbers) throw Error(concat(source_path(store.path()).string(), ": chunk ", leaf, ": source index ", s, " of ", numbers));
            if (s < first || s - first >= 8 * bitmap) continue;
            std::uint8_t& byte = seen[(s - first) / 8];
            const auto bit = static_cast<std::uint8_t>(1u << ((s - first) % 8));
            if (byte & bit) throw Error(concat(source_path(store.path()).string(), ": chunk ", leaf, ": source index ", s, " is there twice"));
            byte = static_cast<std::uint8_t>(byte | bit);
          }
        } catch (const Error& e) {
          if (first == 0 || std::string(e.what()).find("twice") != std::string::npos) problem(e.what());
        }
        report_.progress(++done);
      }
    }
    report_.end();
  }

  void check_layer_folders(const Store& store) {
    std::error_code code;
    for (std::filesystem::directory_iterator it(layers_path(path_), code), end; !code && it != end; it.increment(code)) {
      const std::string name = it->path().filename().string();
      if (!name.ends_with(".part") && !name.ends_with(".old") && !has_layer(store, name)) problem(concat(it->path().string(), ": has no layer.json"));
    }
  }

  void check_layer(const Store& store, const std::string& name) {
    try {
      const Layer layer(store, name);
      for_each_chunk(store, concat("verify layer ", name), [&](std::uint32_t i) { layer.read_chunk(i); });
    } catch (const Error& e) {
      problem(e.what());
    }
  }

  std::filesystem::path path_;
  MemoryBudget& budget_;
  Reporter& report_;
  std::mutex mutex_;
  VerifyResult result_;
};

}  // namespace

VerifyResult verify_store(const std::filesystem::path& path, MemoryBudget& budget, Reporter& report) { return Verifier(path, budget, report).run(); }

}  // namespace chiaro::stream
