/// The user's --memory and --threads as the objects that libraries take.
#pragma once
#include <cstdint>

namespace chiaro::tools {

/// What may be handed out through a MemoryBudget so that the process as a whole stays below memory_bytes: less what it holds now (16 MiB at least, so that runs are
/// given the same), and a share for stacks, allocator slack and small things (an eighth, at least 24 MiB, at most 256 MiB).
/// throws UsageError if less than 32 MiB would remain, naming the least that works.
std::uint64_t budget_bytes(std::uint64_t memory_bytes);

/// That from memory_bytes alone: what results and keys depend on must not change with what the process holds at its start, which is never the same twice.
std::uint64_t plannable_bytes(std::uint64_t memory_bytes);

}  // namespace chiaro::tools
