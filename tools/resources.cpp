#include "tools/resources.h"

#include <algorithm>

#include "stream/base/budget.h"
#include "stream/base/error.h"

namespace chiaro::tools {

namespace {

constexpr std::uint64_t kMiB = 1u << 20, kLeast = 32 * kMiB;
constexpr std::uint64_t kUsuallyHeld = 16 * kMiB;   ///< at most, by the program and its libraries; 12 on Debian 12

std::uint64_t slack_of(std::uint64_t memory_bytes) { return std::clamp(memory_bytes / 8, 24 * kMiB, 256 * kMiB); }

}  // namespace

std::uint64_t budget_bytes(std::uint64_t memory_bytes) {
  const std::uint64_t held = std::max(kUsuallyHeld, resident_bytes()), slack = slack_of(memory_bytes);
  if (memory_bytes < held + slack + kLeast)
    throw UsageError(concat("--memory ", format_bytes(memory_bytes), " is too little; at least ", format_bytes((held + slack + kLeast + kMiB) / kMiB * kMiB), " are needed"));
  return memory_bytes - held - slack;
}

std::uint64_t plannable_bytes(std::uint64_t memory_bytes) {
  const std::uint64_t taken = kUsuallyHeld + slack_of(memory_bytes);
  return memory_bytes > taken ? memory_bytes - taken : 0;
}

}  // namespace chiaro::tools
