#include "stream/store/octree_build.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <chrono>
#include <fstream>
#include <cstring>
#include <limits>
#include <set>

#include "memory_cloud.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/base/vector_width.h"
#include "stream/store/layer.h"
#include "stream/store/store.h"

namespace chiaro::stream {
namespace {

namespace fs = std::filesystem;
constexpr double kDegrees = 180 / 3.14159265358979323846;

std::map<std::string, std::string> bytes_of(const fs::path& folder) {
  std::map<std::string, std::string> all;
  for (const auto& f : fs::recursive_directory_iterator(folder))
    if (f.is_regular_file()) all[fs::relative(f.path(), folder).string()] = read_text(f.path());
  return all;
}

// Each accepted point is in exactly one leaf, where it belongs, within a step of where it was.
void expect_all_points_stored(const Store& store, const MemoryCloud& cloud, const std::set<std::uint64_t>& rejected = {}) {
  std::vector<int> seen(cloud.position.size());
  for (const std::uint32_t leaf : store.leaves()) {
    const Chunk chunk = store.read_chunk(leaf);
    const auto sources = store.read_sources(leaf);
    const Box3d bounds = store.bounds(leaf);
    Box3d found;
    for (std::uint32_t slot = 0; slot < chunk.count; ++slot) {
      ASSERT_LT(sources[slot], seen.size());
      ++seen[sources[slot]];
      const Surfel s = chunk.surfel(slot);
      ASSERT_LE((s.position_in_world - cloud.position[sources[slot]]).cwiseAbs().maxCoeff(), 0.51 * chunk.frame.step);
      ASSERT_EQ(s.flags & SurfelBlock::kPadding, 0);
      ASSERT_GT(s.radius, 0);
      found.extend(s.position_in_world);
    }
    EXPECT_EQ(found.min, bounds.min);
    EXPECT_EQ(found.max, bounds.max);
  }
  for (std::size_t i = 0; i < seen.size(); ++i) ASSERT_EQ(seen[i], rejected.count(i) ? 0 : 1) << "point " << i;
}

TEST(Build, ASinglePointIsAStore) {
  const ScratchFolder scratch;
  MemoryCloud cloud;
  cloud.position = {{4512.25, -3.5, 17}};
  const Manifest m = build(cloud, scratch.path() / "a.chiaro");
  EXPECT_EQ(m.points_stored, 1u);
  const Store store(scratch.path() / "a.chiaro");
  expect_all_points_stored(store, cloud);
  const Surfel s = store.read_chunk(store.leaves()[0]).surfel(0);
  EXPECT_LT((s.position_in_world - cloud.position[0]).norm(), 1e-3);
  EXPECT_TRUE(s.flags & SurfelBlock::kIsolated);
}

TEST(Build, EveryPointIsInExactlyOneLeafWhereItBelongs) {
  const ScratchFolder scratch;
  const MemoryCloud cloud = sphere_cloud(60000, 2.0, 0.001, {500000, 5000000, 100});
  build(cloud, scratch.path() / "a.chiaro", 2048);
  const Store store(scratch.path() / "a.chiaro");
  EXPECT_GT(store.leaves().size(), 30u);
  expect_all_points_stored(store, cloud);
}

TEST(Build, PointsThatAreNotFiniteAreRejectedAndCounted) {
  const ScratchFolder scratch;
  MemoryCloud cloud = plane_cloud(5000);
  cloud.position[0].x() = NAN;
  cloud.position[77].y() = std::numeric_limits<double>::infinity();
  cloud.position[4999].z() = -2e9;
  const Manifest m = build(cloud, scratch.path() / "a.chiaro");
  EXPECT_EQ(m.points_read, 5000u);
  EXPECT_EQ(m.points_stored, 4997u);
  EXPECT_EQ(m.points_rejected.at("not finite"), 2u);
  EXPECT_EQ(m.points_rejected.at("out of range"), 1u);
  expect_all_points_stored(Store(scratch.path() / "a.chiaro"), cloud, {0, 77, 4999});
}

TEST(Build, RejectedNumbersAreLeftOut) {
  const ScratchFolder scratch;
  const MemoryCloud cloud = plane_cloud(3000);
  CloudInput input = input_of(cloud);
  input.rejected = [](std::uint64_t n) { return n % 1000 == 3; };
  MemoryBudget budget(1 << 28);
  const Manifest m = build_store_from(input, scratch.path() / "a.chiaro", {}, budget, silent_reporter());
  EXPECT_EQ(m.points_rejected.at("outlier"), 3u);
  expect_all_points_stored(Store(scratch.path() / "a.chiaro"), cloud, {3, 1003, 2003});
}

TEST(Build, NoUsablePointIsAnError) {
  const ScratchFolder scratch;
  MemoryCloud cloud;
  EXPECT_THROW(build(cloud, scratch.path() / "a.chiaro"), Error);
  cloud.position.assign(10, Vec3d::Constant(NAN));
  EXPECT_THROW(build(cloud, scratch.path() / "a.chiaro"), Error);
  EXPECT_FALSE(fs::exists(scratch.path() / "a.chiaro"));
}

TEST(Build, DuplicatesAreKeptInContinuedChunks) {
  const ScratchFolder scratch;
  MemoryCloud cloud = plane_cloud(1000);
  for (int i = 0; i < 100000; ++i) cloud.position.push_back({0.3, 0.4, 0});
  build(cloud, scratch.path() / "a.chiaro");
  const Store store(scratch.path() / "a.chiaro");
  expect_all_points_stored(store, cloud);
  int parts = 0;
  for (const auto& e : store.chunks()) parts += e.part > 0;
  EXPECT_EQ(parts, 1);
}

TEST(Build, OneFarPointDegradesNobody) {
  const ScratchFolder scratch;
  MemoryCloud cloud = sphere_cloud(50000, 0.5);
  build(cloud, scratch.path() / "near.chiaro");
  cloud.position.push_back({200000, 0, 0});
  build(cloud, scratch.path() / "far.chiaro");
  const Store near(scratch.path() / "near.chiaro"), far(scratch.path() / "far.chiaro");
  expect_all_points_stored(far, cloud);
  const double spacing = std::sqrt(3.14159 / 50000);
  for (const std::uint32_t leaf : far.leaves()) EXPECT_LT(far.frame(leaf).step, spacing / 15);
  std::size_t isolated = 0;
  for (const std::uint32_t leaf : far.leaves()) {
    const Chunk c = far.read_chunk(leaf);
    for (std::uint32_t i = 0; i < c.count; ++i) isolated += (c.surfel(i).flags & SurfelBlock::kIsolated) != 0;
  }
  EXPECT_EQ(isolated, 1u);
}

TEST(Build, OutliersNearASurfaceStaySmall) {
  const ScratchFolder scratch;
  MemoryCloud cloud = plane_cloud(40000);  // spacing 0.005
  for (int i = 0; i < 5; ++i) cloud.position.push_back({0.1 + 0.2 * i, 0.5, 0.04 + 0.02 * i});
  build(cloud, scratch.path() / "a.chiaro");
  const Store store(scratch.path() / "a.chiaro");
  for (const std::uint32_t leaf : store.leaves()) {
    const Chunk c = store.read_chunk(leaf);
    const auto sources = store.read_sources(leaf);
    for (std::uint32_t i = 0; i < c.count; ++i) {
      ASSERT_LT(c.surfel(i).radius, 0.03f);
      ASSERT_EQ((c.surfel(i).flags & SurfelBlock::kIsolated) != 0, sources[i] >= 40000) << sources[i];
    }
  }
}

TEST(Build, ScanLinesFarApartAreClosed) {
  const ScratchFolder scratch;
  MemoryCloud cloud;  // points every 2 mm on lines every 10 mm
  for (int line = 0; line < 60; ++line)
    for (int i = 0; i < 300; ++i) cloud.position.push_back({0.002 * i + 0.0005 * uniform(static_cast<std::uint64_t>(i), 1), 0.01 * line, 0.0001 * uniform(static_cast<std::uint64_t>(i), 2)});
  build(cloud, scratch.path() / "a.chiaro");
  const Store store(scratch.path() / "a.chiaro");
  for (const std::uint32_t leaf : store.leaves()) {
    const Chunk c = store.read_chunk(leaf);
    for (std::uint32_t i = 0; i < c.count; ++i) {
      const Surfel s = c.surfel(i);
      if (s.position_in_world.x() < 0.02 || s.position_in_world.x() > 0.58 || s.position_in_world.y() < 0.02 || s.position_in_world.y() > 0.57) continue;
      ASSERT_GT(s.radius, 0.005f);
      ASSERT_LT(s.radius, 0.02f);
      ASSERT_GT(std::abs(s.normal.z()), 0.99f);
    }
  }
}

TEST(Build, LinesPlanesAndVolumesAreStored) {
  const ScratchFolder scratch;
  MemoryCloud line, volume;
  for (int i = 0; i < 5000; ++i) line.position.push_back({0.001 * i, 0.002 * i, 1});
  for (int x = 0; x < 30; ++x)
    for (int y = 0; y < 30; ++y)
      for (int z = 0; z < 30; ++z) volume.position.push_back({0.1 * x, 0.1 * y, 0.1 * z});
  const MemoryCloud plane = plane_cloud(20000);
  int n = 0;
  for (const MemoryCloud* cloud : std::initializer_list<const MemoryCloud*>{&line, &volume, &plane}) {
    const fs::path out = scratch.path() / concat("s", n++, ".chiaro");
    build(*cloud, out, 512);
    expect_all_points_stored(Store(out), *cloud);
  }
  const Store store(scratch.path() / "s2.chiaro");
  for (const std::uint32_t leaf : store.leaves()) {
    const Chunk c = store.read_chunk(leaf);
    for (std::uint32_t i = 0; i < c.count; ++i) ASSERT_GT(std::abs(c.surfel(i).normal.z()), 0.9999f);
  }
}

TEST(Build, NeitherThreadsNorMemoryChangeAByte) {
  const ScratchFolder scratch;
  MemoryCloud cloud = sphere_cloud(120000, 1.0, 0.0003);
  for (int i = 0; i < 3000; ++i) cloud.position.push_back({0.3, 0.4, 0.7});
  for (std::size_t i = 0; i < cloud.position.size(); ++i) cloud.colour.push_back({static_cast<std::uint16_t>(i), 7, 65535});
  std::vector<std::map<std::string, std::string>> results;
  for (const auto& [threads, memory] : {std::pair{1, 512ull << 20}, std::pair{8, 512ull << 20}, std::pair{2, 48ull << 20}}) {
    const ThreadLimit limit(threads);
    const fs::path out = scratch.path() / concat("s", results.size(), ".chiaro");
    build(cloud, out, 1000, memory);
    results.push_back(bytes_of(out));
  }
  EXPECT_GT(results[0].at("geometry.bin").size(), 1000000u);
  EXPECT_TRUE(results[0] == results[1]) << "threads";
  EXPECT_TRUE(results[0] == results[2]) << "memory";
}

TEST(Build, TheProcessorChangesNoByte) {
  const ScratchFolder scratch;
  MemoryCloud cloud = sphere_cloud(40000, 1.0, 0.0003);
  for (std::size_t i = 0; i < 20000; ++i) cloud.position.push_back({uniform(i, 0) - 0.5, uniform(i, 1) - 0.5, 0.3});  // edges where it cuts the sphere
  build(cloud, scratch.path() / "wide.chiaro", 4096);
  for (const VectorWidth width : {VectorWidth::kPlain, VectorWidth::kAvx2}) {
    limit_vectors(width);
    const fs::path out = scratch.path() / concat("narrow", static_cast<int>(width), ".chiaro");
    build(cloud, out, 4096);
    EXPECT_TRUE(bytes_of(scratch.path() / "wide.chiaro") == bytes_of(out)) << static_cast<int>(width);
  }
  limit_vectors(VectorWidth::kAvx512);
}

TEST(Build, APreviewNeedsNoNeighbours) {
  const ScratchFolder scratch;
  const std::size_t n = 60000;
  const MemoryCloud cloud = sphere_cloud(n, 1.0);
  BuildOptions options;
  options.normals = NormalSource::kNone;
  options.chunk_surfels = 4096;
  MemoryBudget budget(1 << 28);
  const fs::path out = scratch.path() / "a.chiaro";
  build_store_from(input_of(cloud), out, options, budget, silent_reporter());
  EXPECT_TRUE(verify_store(out, budget, silent_reporter()).problems.empty());
  const Store store(out);
  expect_all_points_stored(store, cloud);
  const double spacing = std::sqrt(4 * 3.14159265 / static_cast<double>(n));
  std::vector<double> angles;
  for (const std::uint32_t leaf : store.leaves()) {
    EXPECT_NEAR(store.chunks()[leaf].spacing / spacing, 1, 0.3);
    EXPECT_NEAR(store.chunks()[leaf].radius_max / spacing, 1.5, 0.5);
    const Chunk c = store.read_chunk(leaf);
    const auto sources = store.read_sources(leaf);
    for (std::uint32_t i = 0; i < c.count; ++i) {
      ASSERT_EQ(c.surfel(i).flags, SurfelBlock::kEstimated | SurfelBlock::kIsolated);
      angles.push_back(std::acos(std::min(1.0, std::abs(c.surfel(i).normal.cast<double>().dot(sphere_direction(sources[i]))))) * kDegrees);
    }
  }
  std::nth_element(angles.begin(), angles.begin() + static_cast<std::ptrdiff_t>(n / 2), angles.end());
  EXPECT_LT(angles[n / 2], 5);
}

TEST(Build, MemoryStaysWithinTheBudget) {
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
  GTEST_SKIP() << "sanitizers keep freed memory and shadows of their own: resident memory says nothing here";
#endif
  const ScratchFolder scratch;
  constexpr std::size_t kPoints = 500000;
  const MemoryCloud cloud = sphere_cloud(kPoints, 10.0, 0.001);
  MemoryBudget budget(48 << 20);
  const std::uint64_t before = resident_bytes();
  const auto start = std::chrono::steady_clock::now();
  build_store_from(input_of(cloud), scratch.path() / "a.chiaro", {}, budget, silent_reporter());
  const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  EXPECT_LE(budget.peak_bytes(), budget.limit_bytes());
  EXPECT_LE(peak_resident_bytes(), before + budget.limit_bytes() + (60 << 20));
  std::printf("%.2f Mpoint/s, budget peak %.1f MiB, resident +%.1f MiB\n", 1e-6 * kPoints / seconds, static_cast<double>(budget.peak_bytes()) / 1048576,
              (static_cast<double>(peak_resident_bytes()) - static_cast<double>(before)) / 1048576);
}

TEST(Build, ChunkBordersLeaveNoTraceInNormalsAndRadii) {
  const ScratchFolder scratch;
  const MemoryCloud cloud = sphere_cloud(60000, 1.0, 0.0004);
  std::vector<std::vector<Vec3f>> normals;
  std::vector<std::vector<float>> radii;
  for (const std::uint32_t chunk_surfels : {2048u, 65536u}) {
    const fs::path out = scratch.path() / concat(chunk_surfels, ".chiaro");
    build(cloud, out, chunk_surfels);
    const Store store(out);
    normals.emplace_back(cloud.position.size());
    radii.emplace_back(cloud.position.size());
    for (const std::uint32_t leaf : store.leaves()) {
      const Chunk c = store.read_chunk(leaf);
      const auto sources = store.read_sources(leaf);
      for (std::uint32_t i = 0; i < c.count; ++i) {
        normals.back()[sources[i]] = c.surfel(i).normal;
        radii.back()[sources[i]] = c.surfel(i).radius;
      }
    }
  }
  // Positions are rounded to other steps in other cells: a 256th of the spacing here.
  double sum = 0;
  std::size_t other_normal = 0, other_radius = 0;
  for (std::size_t i = 0; i < normals[0].size(); ++i) {
    const double angle = std::acos(std::min(1.0f, std::abs(normals[0][i].dot(normals[1][i])))) * kDegrees;
    sum += angle;
    other_normal += angle > 1;  // a neighbour at the rim of the search can fall in or out
    other_radius += std::abs(std::log2(radii[0][i] / radii[1][i])) > 0.15f;
  }
  EXPECT_LT(sum / static_cast<double>(normals[0].size()), 0.05);
  EXPECT_LT(other_normal, normals[0].size() / 200);
  EXPECT_LT(other_radius, normals[0].size() / 200);
}

TEST(Build, NormalsOfANoisySphereAreRight) {
  const ScratchFolder scratch;
  const std::size_t n = 100000;
  const double spacing = std::sqrt(4 * 3.14159265 / static_cast<double>(n));
  const MemoryCloud cloud = sphere_cloud(n, 1.0, 0.1 * spacing);
  build(cloud, scratch.path() / "a.chiaro", 16384);
  const Store store(scratch.path() / "a.chiaro");
  double sum = 0;
  for (const std::uint32_t leaf : store.leaves()) {
    const Chunk c = store.read_chunk(leaf);
    const auto sources = store.read_sources(leaf);
    for (std::uint32_t i = 0; i < c.count; ++i) sum += std::acos(std::min(1.0, std::abs(c.surfel(i).normal.cast<double>().dot(sphere_direction(sources[i]))))) * kDegrees;
  }
  std::printf("mean normal error %.2f degrees\n", sum / static_cast<double>(n));
  EXPECT_LT(sum / static_cast<double>(n), 2.0);
}

TEST(Build, NormalsFromTheFileAreKeptAndBadOnesEstimated) {
  const ScratchFolder scratch;
  MemoryCloud cloud = sphere_cloud(20000, 1.0);
  for (std::size_t i = 0; i < cloud.position.size(); ++i) cloud.normal.push_back((5 * sphere_direction(i)).cast<float>());
  cloud.normal[5] = Vec3f::Zero();
  cloud.normal[6].x() = NAN;
  const Manifest m = build(cloud, scratch.path() / "a.chiaro");
  EXPECT_TRUE(m.normals_from_file);
  const Store store(scratch.path() / "a.chiaro");
  for (const std::uint32_t leaf : store.leaves()) {
    const Chunk c = store.read_chunk(leaf);
    const auto sources = store.read_sources(leaf);
    for (std::uint32_t i = 0; i < c.count; ++i) {
      const Surfel s = c.surfel(i);
      const bool bad = sources[i] == 5 || sources[i] == 6;
      ASSERT_EQ(s.flags, bad ? SurfelBlock::kEstimated : SurfelBlock::kOriented);
      ASSERT_GT(s.normal.dot(sphere_direction(sources[i]).cast<float>()), bad ? 0.99f : 0.9999f);
    }
  }
}

// Discs near a point, by a plain grid.
class DiscGrid {
 public:
  explicit DiscGrid(const std::vector<Surfel>& discs) : discs_(discs) {
    float most = 0;
    for (const Surfel& s : discs) most = std::max(most, s.radius);
    cell_ = 2 * most;
    for (std::size_t i = 0; i < discs.size(); ++i) cells_[key(discs[i].position_in_world)].push_back(i);
  }
  // Does a ray that crosses the unit sphere at `on_sphere` hit a disc there?
  bool hit(const Vec3d& on_sphere, const Vec3d& direction) const {
    const auto c = key(on_sphere);
    for (int dx = -1; dx <= 1; ++dx)
      for (int dy = -1; dy <= 1; ++dy)
        for (int dz = -1; dz <= 1; ++dz) {
          const auto it = cells_.find({c[0] + dx, c[1] + dy, c[2] + dz});
          if (it == cells_.end()) continue;
          for (const std::size_t i : it->second) {
            const Surfel& s = discs_[i];
            const Vec3d n = s.normal.cast<double>();
            const double slope = n.dot(direction);
            if (std::abs(slope) < 1e-6) continue;
            const Vec3d at = on_sphere + direction * (n.dot(s.position_in_world - on_sphere) / slope);
            if ((at - s.position_in_world).norm() <= s.radius) return true;
          }
        }
    return false;
  }

 private:
  std::array<long, 3> key(const Vec3d& p) const {
    return {std::lround(std::floor(p.x() / cell_)), std::lround(std::floor(p.y() / cell_)), std::lround(std::floor(p.z() / cell_))};
  }
  const std::vector<Surfel>& discs_;
  double cell_ = 1;
  std::map<std::array<long, 3>, std::vector<std::size_t>> cells_;
};

double coverage(const std::vector<Surfel>& discs) {
  const DiscGrid grid(discs);
  const std::size_t rays = 100000;
  std::size_t hits = 0;
  for (std::size_t i = 0; i < rays; ++i) {
    const Vec3d at = sphere_direction(i, 99);
    // Uniform over the disc that the sphere shows: from a random side.
    Vec3d direction = -(at + 0.9 * sphere_direction(i, 100)).normalized();
    hits += grid.hit(at, direction);
  }
  return static_cast<double>(hits) / static_cast<double>(rays);
}

TEST(Build, RaysHitADiscOnASampledSphereAtEveryLevel) {
  const ScratchFolder scratch;
  build(sphere_cloud(60000, 1.0), scratch.path() / "a.chiaro", 4096);
  const Store store(scratch.path() / "a.chiaro");
  std::vector<Surfel> leaves;
  std::map<int, std::vector<Surfel>> cut;  // all nodes of a level and the leaves above
  double area = 0;
  for (std::uint32_t i = 0; i < store.chunks().size(); ++i) {
    const Chunk c = store.read_chunk(i);
    for (std::uint32_t s = 0; s < c.count; ++s) {
      if (store.chunks()[i].is_leaf()) {
        leaves.push_back(c.surfel(s));
        area += 3.14159265 * c.surfel(s).radius * c.surfel(s).radius;
      } else {
        cut[store.chunks()[i].level].push_back(c.surfel(s));
      }
    }
  }
  const double hit = coverage(leaves);
  std::printf("coverage %.5f, discs cover %.2f times the area\n", hit, area / (4 * 3.14159265));
  EXPECT_GE(hit, 0.9999);
  EXPECT_LT(area / (4 * 3.14159265), 5.0);
  ASSERT_GE(cut[1].size(), 500u);
  const double inner = coverage(cut[1]);
  std::printf("coverage of level 1: %.5f with %zu surfels\n", inner, cut[1].size());
  EXPECT_GE(inner, 0.9999);
}

TEST(Build, DiscsReachLittleOverABorder) {
  const ScratchFolder scratch;
  const std::size_t n = 40000;
  build(plane_cloud(n), scratch.path() / "a.chiaro");
  const Store store(scratch.path() / "a.chiaro");
  const double spacing = 1 / std::sqrt(static_cast<double>(n));
  std::map<int, double> over;  // by place along the border x = 1
  for (const std::uint32_t leaf : store.leaves()) {
    const Chunk c = store.read_chunk(leaf);
    for (std::uint32_t i = 0; i < c.count; ++i) {
      const Surfel s = c.surfel(i);
      double& most = over[static_cast<int>(s.position_in_world.y() / spacing)];
      most = std::max(most, s.position_in_world.x() + static_cast<double>(s.radius) - 1);
    }
  }
  double sum = 0;
  for (const auto& [place, most] : over) sum += most / spacing;
  std::printf("mean overhang %.2f spacings\n", sum / static_cast<double>(over.size()));
  EXPECT_LT(sum / static_cast<double>(over.size()), 0.75);
}

// The roof of a house, sampled as the vertices of a mesh are: points on the ridge itself have a normal that is neither slope's.
TEST(Build, DiscsOnARidgeStayAsSmallAsTheirNeighbours) {
  const ScratchFolder scratch;
  MemoryCloud cloud;
  const int n = 60;
  const double step = 1.0 / n;
  for (int y = 0; y < n; ++y)
    for (int k = -n / 2; k <= n / 2; ++k) {
      // Every third row only has a point on the ridge, so that these do not bound each other's cells.
      if (k == 0 && y % 3 != 0) continue;
      cloud.position.push_back({k * step, (y + 0.3 * (std::abs(k) % 2)) * step, -std::abs(k) * step});
      cloud.normal.push_back(k == 0 ? Vec3f(0, 0, 1) : Vec3f(k > 0 ? 1.0f : -1.0f, 0, 1).normalized());
    }
  build(cloud, scratch.path() / "a.chiaro");
  const Store store(scratch.path() / "a.chiaro");
  int ridge = 0;
  for (const std::uint32_t leaf : store.leaves()) {
    const Chunk c = store.read_chunk(leaf);
    for (std::uint32_t i = 0; i < c.count; ++i) {
      const Surfel s = c.surfel(i);
      const Vec3d p = s.position_in_world;
      if (std::abs(p.x()) > 0.25 * step || p.y() < 4 * step || p.y() > 1 - 4 * step) continue;
      ++ridge;
      EXPECT_LT(static_cast<double>(s.radius), 1.45 * step) << p.y() * n;
    }
  }
  EXPECT_GE(ridge, 15);
}

TEST(Build, TheInputColourBecomesALayerOnEveryLevel) {
  const ScratchFolder scratch;
  MemoryCloud cloud = plane_cloud(20000);
  for (std::size_t i = 0; i < cloud.position.size(); ++i) cloud.colour.push_back({static_cast<std::uint16_t>(i), 1000, 65535});
  build(cloud, scratch.path() / "a.chiaro", 1024);
  const Store store(scratch.path() / "a.chiaro");
  EXPECT_THAT(layer_names(store), testing::ElementsAre("input"));
  const Layer layer(store, "input");
  for (std::uint32_t i = 0; i < store.chunks().size(); ++i) {
    const auto bytes = layer.read_chunk(i);
    const std::size_t n = store.chunks()[i].count;
    std::vector<std::uint16_t> v(3 * n);
    std::memcpy(v.data(), bytes.data(), bytes.size());
    for (std::size_t s = 0; s < n; ++s) {
      ASSERT_EQ(v[n + s], 1000);
      ASSERT_EQ(v[2 * n + s], 65535);
    }
    if (!store.chunks()[i].is_leaf()) continue;
    const auto sources = store.read_sources(i);
    for (std::size_t s = 0; s < n; ++s) ASSERT_EQ(v[s], static_cast<std::uint16_t>(sources[s]));
  }
}

TEST(Build, PointsOfAFileWithoutColoursAreGreyBesideOthers) {
  const ScratchFolder scratch;
  MemoryCloud painted = plane_cloud(2000), plain = plane_cloud(1000);
  painted.colour.assign(painted.position.size(), {257, 0, 65535});
  for (const bool painted_first : {true, false}) {
    CloudInput input = input_of(painted);
    input.files = {"first", "second"};
    input.fingerprints = {"first", "second"};
    input.open = [&](std::size_t i) { return std::make_unique<MemoryReader>((i == 0) == painted_first ? painted : plain); };
    MemoryBudget budget(1ull << 29);
    const fs::path out = scratch.path() / (painted_first ? "a.chiaro" : "b.chiaro");
    build_store_from(input, out, {}, budget, silent_reporter());
    const Store store(out);
    const auto colours = read_colour(Layer(store, "input"), store, 0);
    const auto sources = store.read_sources(0);
    ASSERT_EQ(colours.size(), 3000u);
    using Colour = std::array<std::uint16_t, 3>;
    for (std::size_t i = 0; i < colours.size(); ++i)
      ASSERT_EQ(colours[i], (sources[i] < (painted_first ? 2000u : 1000u)) == painted_first ? (Colour{257, 0, 65535}) : (Colour{32896, 32896, 32896}));
  }
}

}  // namespace
}  // namespace chiaro::stream
