/// The files a store was made of, read once more: exact positions and the properties that ingest does not keep.
#pragma once
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "stream/base/report.h"
#include "stream/cloud/point_stream.h"
#include "stream/store/store.h"

namespace chiaro::tools {

/// The source files one after the other, as one run of points. Only made while all of them are what they were at ingest.
class SourceFiles {
 public:
  struct Carry {
    std::vector<std::string> replaced;   ///< names of properties that the result has itself. Those, and what not every file has, are not carried; a note says so. What files have in several types is written in one that holds all of them
    bool long_integers = true;           ///< the result's format has whole numbers of 64 bits; else they are carried as double, and a note says so
  };
  /// memory_bytes: for readers of files that are not streamed through and through; throws Error where one needs more.
  SourceFiles(const stream::Manifest& manifest, std::vector<std::filesystem::path> files, const Carry& carry, std::uint64_t memory_bytes, Reporter& report);
  /// files: where they are now, in the order of the manifest's.
  static bool unchanged(const stream::Manifest& manifest, const std::vector<std::filesystem::path>& files, std::string& why);

  bool position_is_double() const { return position_is_double_; }
  /// The coarsest step on which the positions of all files lie, where they are stored as whole numbers (LAS).
  std::optional<double> position_step() const;
  /// What the positions of all files lie on, where multiples of that step are something else: other steps for other axes, an offset between two multiples.
  std::optional<stream::PositionGrid> position_grid() const;
  /// WKT of the coordinate system that all files name; empty where they do not.
  std::string coordinate_system() const;
  /// As they are written: a name that not every format can hold is changed, and a note says so.
  const std::vector<stream::PointProperty>& carried() const { return carried_; }

  /// The next points, at most max_points, all of one file. throws Error when a file has fewer points than at ingest.
  const stream::PointBlock& read(std::size_t max_points);
  /// Copies the carried properties of point i of the last block; returns the end.
  std::byte* copy_carried(std::size_t i, std::byte* to) const;

 private:
  /// One carried property inside a file's packed extras.
  struct CarriedField {
    std::size_t offset = 0;
    stream::ScalarType type = stream::ScalarType::kF64, written = stream::ScalarType::kF64;   ///< there, and in the result
  };
  static std::optional<CarriedField> find_field(const stream::PointSchema& schema, const std::string& name);
  void choose_carried(const Carry& carry, Reporter& report);
  void choose(stream::PointProperty property, const Carry& carry, Reporter& report);
  void add_carried(const stream::PointProperty& property, const Carry& carry, Reporter& report);

  const stream::Manifest& manifest_;
  std::vector<std::filesystem::path> files_;
  std::uint64_t memory_bytes_;
  std::vector<stream::PointSchema> schemas_;
  bool position_is_double_ = false;
  std::vector<stream::PointProperty> carried_;   ///< as written
  std::vector<std::string> carried_from_;        ///< their names in the files
  std::unique_ptr<stream::PointReader> reader_;
  std::size_t file_ = 0;
  std::uint64_t left_in_file_ = 0;
  std::vector<CarriedField> fields_;
  stream::PointBlock block_;
};

}  // namespace chiaro::tools
