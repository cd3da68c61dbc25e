// In a file of its own, so that the compiler does not see through the pair and warn of free() behind new.
#include "allocation_watch.h"

#include <atomic>
#include <cstdlib>
#include <new>

namespace {
std::atomic<std::size_t> largest{0};
}

namespace chiaro::stream {
std::size_t take_largest_allocation() { return largest.exchange(0); }
}  // namespace chiaro::stream

void* operator new(std::size_t bytes) {
  for (std::size_t seen = largest; bytes > seen && !largest.compare_exchange_weak(seen, bytes);) {
  }
  if (void* at = std::malloc(bytes ? bytes : 1)) return at;
  throw std::bad_alloc();
}
void operator delete(void* at) noexcept { std::free(at); }
void operator delete(void* at, std::size_t) noexcept { std::free(at); }
