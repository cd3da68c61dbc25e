/// The part of repair_store() that looks after one layer.
#pragma once
#include <string>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/store/repair.h"
#include "stream/store/store.h"

namespace chiaro::stream {

/// Repairs layers/NAME of a store that can be opened; lines go to `result`.
void repair_layer(const Store& store, const std::string& name, RepairResult& result, Reporter& report);

/// Appends a line unless there are kMostLines already.
void add_line(std::vector<std::string>& lines, const std::string& line);

/// The disk has no room for a repaired copy: nothing is lost by that, and the repair stops.
class NoRoom : public Error {
 public:
  using Error::Error;
};

/// Copies `size` bytes of a file (zeros where it is shorter) to an AtomicFile, which is then ready for patches. throws NoRoom.
void copy_for_repair(const File& from, std::uint64_t size, AtomicFile& to, Reporter& report);

}  // namespace chiaro::stream
