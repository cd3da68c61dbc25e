// How fast this machine moves bytes: the yardstick for what streams through memory. Prints one line of JSON.
//   usage: bandwidth [THREADS] [MIB]        default: all cores, 256 MiB an array
// copy: b[i] = a[i], as STREAM counts it, bytes read plus bytes written (the line that a store fetches first is not counted); best of seven. The arrays are
// larger than caches. checksum: CRC-32C of one array, one thread, bytes read: what every chunk and leaf costs that goes to or comes from the disk.
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <vector>

#include "stream/base/hash.h"
#include "stream/base/parallel.h"

namespace {

template <class Task>
double best_seconds(const Task& task) {
  double best = std::numeric_limits<double>::infinity();
  for (int round = 0; round < 7; ++round) {
    const auto began = std::chrono::steady_clock::now();
    task(round);
    best = std::min(best, std::chrono::duration<double>(std::chrono::steady_clock::now() - began).count());
  }
  return best;
}

}  // namespace

int main(int argc, char** argv) {
  const int threads = argc > 1 ? std::atoi(argv[1]) : 0;
  const long mib = argc > 2 ? std::atol(argv[2]) : 256;
  if (threads < 0 || mib < 1 || mib > 16384) {
    std::fprintf(stderr, "usage: bandwidth [THREADS] [MIB]\n");
    return 2;
  }
  const chiaro::ThreadLimit limit(threads);
  const std::size_t count = static_cast<std::size_t>(mib) * (1 << 20) / sizeof(double);
  std::vector<double> a(count, 1.5), b(count, 0.5);
  const double bytes = static_cast<double>(count * sizeof(double));
  const double copy = best_seconds([&](int round) {
    a[static_cast<std::size_t>(round)] = round;   // nothing that the compiler could foresee
    chiaro::parallel_blocks(count, 1 << 18, [&](std::size_t begin, std::size_t end) { std::copy(a.begin() + static_cast<std::ptrdiff_t>(begin), a.begin() + static_cast<std::ptrdiff_t>(end), b.begin() + static_cast<std::ptrdiff_t>(begin)); });
  });
  std::uint32_t sum = 0;
  const double checksum = best_seconds([&](int) { sum ^= chiaro::crc32c(a.data(), count * sizeof(double)); });
  std::printf("{\"threads\": %d, \"copy_bytes_per_s\": %.3e, \"checksum_bytes_per_s\": %.3e, \"last\": %g, \"sum\": %u}\n", chiaro::ThreadLimit::current(), 2 * bytes / copy, bytes / checksum, b[count - 1], sum);
  return 0;
}
