/// Tells how much memory was asked for at once: a header must not drive allocations.
#pragma once
#include <cstddef>

namespace chiaro::stream {
/// Largest single allocation through operator new since the last call, bytes.
std::size_t take_largest_allocation();
}  // namespace chiaro::stream
