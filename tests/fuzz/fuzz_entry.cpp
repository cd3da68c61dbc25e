/// One target as libFuzzer calls it.
#include <cstddef>
#include <cstdint>

#include "tests/fuzz/targets.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  static const chiaro::fuzz::Target& target = chiaro::fuzz::target(CHIARO_FUZZ_TARGET);
  target.run({data, size});
  return 0;
}
