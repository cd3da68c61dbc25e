#include "tools/resources.h"

#include <algorithm>

#include "stream/base/budget.h"
#include "stream/base/error.h"

namespace chiaro::tools {

std::uint64_t budget_bytes(std::uint64_t memory_bytes) {
  constexpr std::uint64_t kMiB = 1u << 20, kLeast = 32 * kMiB;
  const std::uint64_t held = resident_bytes(), slack = std::clamp(memory_bytes / 8, 24 * kMiB, 256 * kMiB);
  if (memory_bytes < held + slack + kLeast)
    throw UsageError(concat("--memory ", format_bytes(memory_bytes), " is too little; at least ", format_bytes((held + slack + kLeast + kMiB) / kMiB * kMiB), " are needed"));
  return memory_bytes - held - slack;
}

}  // namespace chiaro::tools
