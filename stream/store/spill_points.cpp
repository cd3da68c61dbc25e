#include "stream/store/spill_points.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <optional>

#include "stream/base/disk_space.h"
#include "stream/base/error.h"
#include "stream/base/parallel.h"
#include "stream/cloud/spool.h"
#include "stream/store/leaf_build.h"
#include "stream/store/place_kernels.h"
#include "stream/store/spill.h"
#include "stream/store/store_format.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

constexpr std::size_t kCountedAtOnce = 65536, kSpilledAtOnce = 16384;   // points of a block; the grid starts from the first counted one
constexpr std::uint64_t kMostPartitionPoints = 400'000;
constexpr double kMaxCoordinate = 1e9;    // project units
constexpr std::uint64_t kMaxPoints = std::uint64_t{1} << 40;
constexpr const char* kOutOfRange = "out of range";
constexpr std::array<std::uint16_t, 3> kMidGrey{128 * 257, 128 * 257, 128 * 257};

/// A block of points on its way, and what is made of it.
template <class Made>
struct Piece {
  std::size_t cloud = 0;
  std::uint64_t first = 0;   ///< running number of its first point
  const PointSchema* schema = nullptr;
  PointBlock block;
  Made made;
};

/// Reads all clouds block by block, one after the other; work(piece) is called for several at a time, take(piece) in the order of the points.
template <class Made, class Work, class Take>
void for_each_block(const CloudInput& input, PointSpool& spool, PointSpool::Reading reading, std::size_t block_points, MemoryBudget& budget, const Work& work, const Take& take) {
  const std::size_t slot_bytes = block_points * (48 + Made::kBytesPerPoint);
  const std::uint64_t room = std::max<std::uint64_t>(2, budget.free_bytes() / 4 / slot_bytes);
  const auto slots = static_cast<std::size_t>(std::min<std::uint64_t>(static_cast<std::uint64_t>(std::clamp(ThreadLimit::current(), 1, 8)) + 1, room));
  const BudgetLease lease(budget, slots * slot_bytes, "blocks of points");
  std::vector<Piece<Made>> pieces(slots);
  std::uint64_t next = 0;
  for (std::size_t cloud = 0; cloud < input.files.size(); ++cloud) {
    const auto reader = spool.open(cloud, reading, [&] { return input.open(cloud); });
    reader->wants(reading == PointSpool::Reading::kFirst ? PointParts::kPositions : PointParts::kNoExtras);
    const auto read = [&](std::size_t slot) {
      Piece<Made>& piece = pieces[slot];
      if (!reader->read(piece.block, block_points)) return false;
      piece.cloud = cloud;
      piece.first = next;
      piece.schema = &reader->schema();
      next += piece.block.size();
      return true;
    };
    ordered_pipeline(slots, read, [&](std::size_t slot) { work(pieces[slot]); }, [&](std::size_t slot) { take(pieces[slot]); });
  }
}

struct Accepted {
  static constexpr std::size_t kBytesPerPoint = 24;
  bool all = false;
  std::vector<Vec3d> some;   ///< if not all
  std::map<std::string, std::uint64_t> rejected;
};

struct Prepared {
  static constexpr std::size_t kBytesPerPoint = 3 * 24 + 8 + 6;
  static constexpr std::uint32_t kRejected = 0xffffffffu;
  AxisColumns<double> position;
  AxisColumns<std::int64_t> cell, place;   ///< root coordinates; the same, or where `on_grid` the integers of the file
  std::vector<std::uint64_t> codes;
  std::vector<std::uint32_t> partition;    ///< of each point, or kRejected
  std::vector<std::uint8_t> usable, on_grid;
  void resize(std::size_t points) {
    position.resize(points);
    cell.resize(points);
    place.resize(points);
    codes.resize(points);
    partition.resize(points);
    usable.assign(points, 1);
    on_grid.assign(points, 1);
  }
};

class PointPasses {
 public:
  PointPasses(const CloudInput& input, const fs::path& part, const fs::path& out, const BuildOptions& options, MemoryBudget& budget, Reporter& report, BuildJournal& journal)
      : input_(input), part_(part), out_(out), spool_(part), options_(options), budget_(budget), report_(report), b_(journal) {}

  // Reason to leave a point out, or null.
  const char* rejection(std::uint64_t number, const Vec3d& p) const {
    if (const char* why = why_unusable(p)) return why;
    if (p.cwiseAbs().maxCoeff() > kMaxCoordinate) return kOutOfRange;
    if (input_.rejected && input_.rejected(number)) return input_.rejected_reason.c_str();
    return nullptr;
  }

  void accept(Piece<Accepted>& piece) const {
    const std::vector<Vec3d>& positions = piece.block.position;
    Accepted& made = piece.made;
    made.some.clear();
    made.rejected.clear();
    made.all = !input_.rejected && all_in_range(positions);
    if (made.all) return;
    for (std::size_t i = 0; i < positions.size(); ++i) {
      if (const char* reason = rejection(piece.first + i, positions[i])) ++made.rejected[reason];
      else made.some.push_back(positions[i]);
    }
  }

  static bool all_in_range(const std::vector<Vec3d>& positions) {
    bool all = true;
    for (const Vec3d& p : positions)
      for (int a = 0; a < 3; ++a) all &= std::abs(p[a]) <= kMaxCoordinate;   // not if it is no number
    return all;
  }

 public:
  void count() {
    Manifest& m = b_.manifest;
    m = Manifest{};
    m.key = build_key(input_, options_);
    m.unit = options_.unit;
    for (const auto& f : input_.files) m.source_files.push_back(f.string());
    m.source_fingerprints = input_.fingerprints;
    m.source_points.assign(input_.files.size(), 0);
    bool all_have_normals = true, one_lacks_normals = false, any_has_normals = false;
    CountGrid grid(budget_, budget_.limit_bytes() / 16);
    report_.begin("count points", declared_points(), "points");
    grids_.resize(input_.files.size());
    for_each_block<Accepted>(
        input_, spool_, PointSpool::Reading::kFirst, kCountedAtOnce, budget_, [&](Piece<Accepted>& piece) { accept(piece); },
        [&](const Piece<Accepted>& piece) {
          report_.check();
          const PointSchema& schema = *piece.schema;
          if (piece.first + piece.block.size() > kMaxPoints) throw Error(concat("more than ", kMaxPoints, " points"));
          b_.has_colour = b_.has_colour || schema.has_colour;
          grids_[piece.cloud] = schema.grid;
          colour_is_16_bit_ = colour_is_16_bit_ || schema.colour_is_16_bit;
          all_have_normals = all_have_normals && schema.has_normal;
          any_has_normals = any_has_normals || schema.has_normal;
          one_lacks_normals = one_lacks_normals || !schema.has_normal;
          for (const auto& [reason, n] : piece.made.rejected) m.points_rejected[reason] += n;
          grid.add(piece.made.all ? std::span<const Vec3d>(piece.block.position) : std::span<const Vec3d>(piece.made.some));
          m.source_points[piece.cloud] += piece.block.size();
          m.points_read += piece.block.size();
          report_.progress(m.points_read);
        });
    report_.end();
    m.points_stored = grid.points();
    if (m.points_stored == 0) throw Error(no_point_message());
    if ((options_.normals == NormalSource::kFile || options_.normals == NormalSource::kAxes) && one_lacks_normals) throw Error("normals = \"file\", but a cloud has no normals: use \"auto\" or \"estimate\"");
    m.normals_from_file = options_.normals != NormalSource::kEstimate && all_have_normals;
    has_normals_ = options_.normals != NormalSource::kEstimate && any_has_normals;
    bounds_extent_ = grid.bounds().max - grid.bounds().min;
    b_.root = grid.root();
    b_.typical_spacing = grid.typical_spacing();
    m.origin_in_world = b_.root.origin();
    m.edge = b_.root.edge();
    const auto cells = grid.cells(b_.root);
    const BudgetLease lease(budget_, cells.size() * sizeof(cells[0]), "counting grid");
    // Half a worker's room: the partitions of a build that is resumed with less memory should still fit. And no more than the processor's caches and the
    // allocator handle well.
    const std::uint64_t room = std::min(leaf_workers(budget_, options_.chunk_surfels).capacity / 2, kMostPartitionPoints);
    const std::uint64_t capacity = std::max<std::uint64_t>(room, options_.chunk_surfels);
    grid_level_ = grid.level(b_.root);
    b_.partitions = make_partitions(cells, grid_level_, options_.chunk_surfels, capacity);
  }

  std::uint64_t declared_points() const {
    std::uint64_t sum = 0;
    for (std::size_t i = 0; i < input_.files.size(); ++i) {
      const std::uint64_t n = input_.open(i)->schema().declared_points;
      if (n == 0 || n > kMaxPoints) return 0;  // a header is never trusted: this is for the progress bar only
      sum += n;
    }
    return sum;
  }

  std::string no_point_message() const {
    std::string text = concat("no usable point: ", b_.manifest.points_read, " read");
    for (const auto& [reason, n] : b_.manifest.points_rejected) text += concat(", ", n, " rejected (", reason, ")");
    for (const auto& f : input_.files) text += concat("; ", f.string());
    return text;
  }

  void distribute() {
    const std::uint64_t n = b_.manifest.points_stored;
    const std::uint64_t spill_bytes = n * spill_bytes_per_point(axis_bits(), b_.manifest.points_read, b_.has_colour, colour_is_16_bit_, has_normals_) + (std::uint64_t{4} << 20) + n / 8;
    const std::uint64_t store_bytes = n * (b_.has_colour ? 26 : 17) * 7 / 5;
    std::uint64_t free = free_disk_bytes(part_);
    if (free < spill_bytes + store_bytes) {
      spool_.drop();
      free = free_disk_bytes(part_);
    }
    report_.note(concat(n, " points: ", format_bytes(spill_bytes), " of disk while building, about ", format_bytes(store_bytes), " for the store"));
    require_disk_space(out_, "the build", spill_bytes + store_bytes, free);
    File file(part_ / "spill.bin", File::Mode::kCreate);
    file.reserve(spill_bytes);
    SpillWriter writer(file, b_.root, b_.partitions, 0, budget_, budget_.free_bytes() / 4);
    b_.estimated_normals = 0;
    report_.begin("distribute points", b_.manifest.points_read, "points");
    for_each_block<Prepared>(
        input_, spool_, PointSpool::Reading::kSecond, kSpilledAtOnce, budget_, [&](Piece<Prepared>& piece) { prepare(piece, writer); },
        [&](const Piece<Prepared>& piece) {
          report_.check();
          for (std::size_t i = 0; i < piece.made.partition.size(); ++i) {
            if (piece.made.partition[i] == Prepared::kRejected) continue;
            const SpillPoint point = spill_point_of(piece, i);
            b_.estimated_normals += !point.has_normal;
            writer.append(piece.made.partition[i], point);
          }
          report_.progress(piece.first + piece.block.size());
        });
    b_.spill_bytes = writer.finish();
    file.truncate(b_.spill_bytes);
    file.sync();
    report_.end();
    if (options_.normals != NormalSource::kEstimate && b_.manifest.normals_from_file && b_.estimated_normals > 0)
      report_.note(concat(b_.estimated_normals, " points have a zero or damaged normal: estimated instead"));
  }

 private:
  void prepare(Piece<Prepared>& piece, const SpillWriter& writer) const {
    Prepared& made = piece.made;
    const std::vector<Vec3d>& positions = piece.block.position;
    made.resize(positions.size());
    for (std::size_t a = 0; a < 3; ++a) {
      std::vector<double>& axis = made.position.of[a];
      for (std::size_t i = 0; i < axis.size(); ++i) axis[i] = positions[i][static_cast<int>(a)];
      clear_unusable(axis, kMaxCoordinate, made.usable.data());
      quantise(axis, b_.root, a, made.cell.of[a].data());
    }
    if (input_.rejected)
      for (std::size_t i = 0; i < positions.size(); ++i) made.usable[i] = made.usable[i] && !input_.rejected(piece.first + i);
    place_on_grid(piece.cloud, made);
    morton_codes(made.cell, {kAxisBits - grid_level_, grid_level_}, made.codes);
    for (std::size_t i = 0; i < positions.size(); ++i)
      made.partition[i] = made.usable[i] ? static_cast<std::uint32_t>(writer.partition_of(made.codes[i] << (3 * (kMaxLevel - grid_level_)))) : Prepared::kRejected;
  }

  void place_on_grid(std::size_t cloud, Prepared& made) const {
    if (!grids_[cloud]) {
      made.on_grid.assign(made.on_grid.size(), 0);
      made.place = made.cell;
      return;
    }
    for (std::size_t a = 0; a < 3; ++a)
      integers_of(made.position.of[a], {grids_[cloud]->scale[static_cast<int>(a)], grids_[cloud]->add[static_cast<int>(a)]}, made.place.of[a].data(), made.on_grid.data());
    for (std::size_t i = 0; i < made.on_grid.size(); ++i)
      if (!made.on_grid[i])
        for (std::size_t a = 0; a < 3; ++a) made.place.of[a][i] = made.cell.of[a][i];
  }

  // Bits of the three coordinates of a point in the spill file, at most.
  int axis_bits() const {
    int most = 0;
    for (std::size_t cloud = 0; cloud < grids_.size(); ++cloud) {
      const std::optional<PositionGrid>& grid = grids_[cloud];
      int sum = 0;
      if (b_.manifest.source_points[cloud] == 0) continue;
      for (int a = 0; a < 3; ++a) {
        const double steps = grid ? bounds_extent_[a] / std::abs(grid->scale[a]) + 2 : 1e18;
        sum += std::min(kAxisBits, static_cast<int>(std::ceil(std::log2(steps))));
      }
      most = std::max(most, sum);
    }
    return most;
  }

  SpillPoint spill_point_of(const Piece<Prepared>& piece, std::size_t i) const {
    SpillPoint p;
    for (std::size_t a = 0; a < 3; ++a) p.place[a] = piece.made.place.of[a][i];
    if (piece.made.on_grid[i]) p.grid = &*grids_[piece.cloud];
    p.source = piece.first + i;
    if (piece.schema->has_normal && options_.normals != NormalSource::kEstimate) {
      const Vec3d normal = piece.block.normal[i].cast<double>();
      const double length = normal.norm();
      if (std::isfinite(length) && length > 1e-20) {
        p.normal = encode_normal((normal / length).cast<float>());
        p.has_normal = true;
      }
    }
    if (piece.schema->has_colour) p.colour = piece.block.colour[i];
    else if (b_.has_colour) p.colour = kMidGrey;   // other files have colours: not black, which would be one
    return p;
  }

  const CloudInput& input_;
  fs::path part_, out_;
  PointSpool spool_;   // for the second reading of formats that are slow to decode
  const BuildOptions& options_;
  MemoryBudget& budget_;
  Reporter& report_;
  BuildJournal& b_;
  std::vector<std::optional<PositionGrid>> grids_;   // of the clouds, as the count saw them
  Vec3d bounds_extent_ = Vec3d::Zero();
  int grid_level_ = 0;                               // of the cells that partitions are made of
  bool colour_is_16_bit_ = false, has_normals_ = false;
};

}  // namespace

void spill_points(const CloudInput& input, const fs::path& part, const fs::path& out, const BuildOptions& options, MemoryBudget& budget, Reporter& report, BuildJournal& journal) {
  PointPasses passes(input, part, out, options, budget, report, journal);
  passes.count();
  passes.distribute();
}

}  // namespace chiaro::stream
