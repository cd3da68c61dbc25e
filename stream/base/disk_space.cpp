#include "stream/base/disk_space.h"

#include "stream/base/budget.h"
#include "stream/base/error.h"

namespace chiaro {

void require_disk_space(const std::filesystem::path& where, std::string_view who, std::uint64_t needed_bytes, std::uint64_t free_bytes) {
  if (free_bytes < needed_bytes) throw Error(concat(where.string(), ": no space: ", who, " needs ", format_bytes(needed_bytes), ", the disk has ", format_bytes(free_bytes), " free"));
}

}  // namespace chiaro
