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
  /// replaced: names of properties that the result has itself. Those, and what not every file has, are not carried; a note says so.
  /// memory_bytes: for readers of files that are not streamed through and through; throws Error where one needs more.
  SourceFiles(const stream::Manifest& manifest, std::vector<std::filesystem::path> files, const std::vector<std::string>& replaced, std::uint64_t memory_bytes, Reporter& report);
  /// files: where they are now, in the order of the manifest's.
  static bool unchanged(const stream::Manifest& manifest, const std::vector<std::filesystem::path>& files, std::string& why);

  bool position_is_double() const { return position_is_double_; }
  const std::vector<stream::PointProperty>& carried() const { return carried_; }

  /// The next points, at most max_points, all of one file. throws Error when a file has fewer points than at ingest.
  const stream::PointBlock& read(std::size_t max_points);
  /// Copies the carried properties of point i of the last block; returns the end.
  std::byte* copy_carried(std::size_t i, std::byte* to) const;

 private:
  /// Bytes of one carried property inside a file's packed extras.
  struct CarriedField {
    std::size_t offset = 0, bytes = 0;
  };
  static std::optional<CarriedField> find_field(const stream::PointSchema& schema, const stream::PointProperty& wanted);
  void choose_carried(const std::vector<std::string>& replaced, Reporter& report);

  const stream::Manifest& manifest_;
  std::vector<std::filesystem::path> files_;
  std::uint64_t memory_bytes_;
  std::vector<stream::PointSchema> schemas_;
  bool position_is_double_ = false;
  std::vector<stream::PointProperty> carried_;
  std::unique_ptr<stream::PointReader> reader_;
  std::size_t file_ = 0;
  std::uint64_t left_in_file_ = 0;
  std::vector<CarriedField> fields_;
  stream::PointBlock block_;
};

}  // namespace chiaro::tools
