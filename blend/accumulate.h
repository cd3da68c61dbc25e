/// Sums per surfel over the photographs, on disk: one record a leaf chunk, read and rewritten whole by one task at a time.
///
/// Each leaf has two slots in the file. A write goes to the older one, with a checksum and a mark of how far it reaches (photograph, row), so that a
/// kill at any moment leaves the previous state whole; a resumed run continues each chunk from its own mark. Photographs are added in the order of
/// their names, each surfel once a photograph: the sums have the same bits however the work was cut.
#pragma once
#include <cstdint>
#include <filesystem>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "blend/sample.h"

namespace chiaro::blend {

/// The high band's sums are double for their range, not their precision: weights reach down to 1e-12 beside borders and are raised to p, then squared.
struct Accumulator {
  double high_weight = 0, high[3] = {0, 0, 0};   ///< sum of w^p, w^p * high band
  double high_variance = 0;                      ///< sum of (w^p sigma)^2
  float low_weight = 0, low[3] = {0, 0, 0};      ///< sum of w, w * low band
  float low_variance = 0;                        ///< sum of (w sigma)^2
  float shared = 0;                              ///< sum of w * shared deviation
  std::uint32_t photographs = 0;
  std::uint32_t reserved = 0;
};
static_assert(sizeof(Accumulator) == 72);

/// Adds one photograph's reading.
void add_sample(Accumulator& sum, const Sample& sample, float high_band_power);

struct BlendedSurfel {
  Vec3f albedo;            ///< NaN: unseen
  float sigma = 0;         ///< NaN: unseen
  std::uint16_t photographs = 0;
};
/// shared_sigma is a relative deviation that all photographs have in common; it joins the one that their pixels carry.
BlendedSurfel resolve(const Accumulator& sum, float shared_sigma);

/// How far a leaf has come: everything of photographs before `photograph`, and of that one the surfels in rows before `row`.
struct Mark {
  std::uint32_t photograph = 0, row = 0;
  friend auto operator<=>(const Mark&, const Mark&) = default;
};

class AccumulatorFile {
 public:
  /// Opens `path` if it was made with the same key for the same leaves, else starts it anew. throws Error.
  AccumulatorFile(const std::filesystem::path& path, const std::string& key, std::vector<std::uint32_t> surfels_of_leaf, std::uint32_t num_photographs);
  AccumulatorFile(AccumulatorFile&&) noexcept;
  ~AccumulatorFile();
  /// Photographs that are in completely.
  std::uint32_t photographs_done() const;
  /// Syncs, then notes that photographs [0, count) are in.
  void set_photographs_done(std::uint32_t count);
  Mark mark(std::size_t leaf) const;
  struct Record {
    std::vector<std::uint32_t> samples_of_photograph;
    std::vector<Accumulator> surfels;
  };
  /// The leaf's sums; zeros if it was never written. Thread-safe for different leaves. throws Error on a checksum that does not fit.
  Record read(std::size_t leaf) const;
  bool is_written(std::size_t leaf) const;
  void write(std::size_t leaf, const Mark& mark, const Record& record);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace chiaro::blend
