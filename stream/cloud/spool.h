/// Points of a format that is slow to decode, kept for a second reading.
#pragma once
#include <cstdint>
#include <filesystem>
#include <functional>
#include <map>
#include <memory>

#include "stream/cloud/point_stream.h"

namespace chiaro::stream {

/// Whoever reads clouds twice from their beginning (counting, then distributing) opens them through a spool: the second reading of LAZ then comes
/// from a scratch file of 12 bytes a point, 3 or 6 more with colour (positions that do not lie on a 32-bit grid take 24, normals 12). Other
/// formats are decoded as quickly as such a file is read, or would make it large. The file has no name, so that nothing is left of it, and gives back its space while it is read. A spool is a convenience: where the
/// disk is short or fails, the source is decoded once more.
class PointSpool {
 public:
  explicit PointSpool(std::filesystem::path folder) : folder_(std::move(folder)) {}

  /// What the reading is for: points of the first one are kept, and the second one gets those, if all were read.
  enum class Reading { kFirst, kSecond };
  /// The points of open_source(), without extras where they were kept or come from the scratch file. Not for several threads at once.
  std::unique_ptr<PointReader> open(std::size_t cloud, Reading reading, const std::function<std::unique_ptr<PointReader>()>& open_source);
  /// Gives up the scratch files, and with them their disk space.
  void drop() { clouds_.clear(); }

  struct Spooled;

 private:
  std::filesystem::path folder_;
  std::map<std::size_t, std::shared_ptr<Spooled>> clouds_;
};

}  // namespace chiaro::stream
