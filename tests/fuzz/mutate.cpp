#include "tests/fuzz/mutate.h"

#include <algorithm>
#include <cstring>

#include "stream/base/rng.h"

namespace chiaro::fuzz {
namespace {

class Mutator {
 public:
  Mutator(std::string bytes, std::uint64_t seed, std::uint64_t round) : bytes_(std::move(bytes)), seed_(seed), round_(round) {}

  std::string run(std::size_t max_bytes) {
    for (std::size_t n = 1 + draw(6); n > 0; --n) change();
    bytes_.resize(std::min(bytes_.size(), max_bytes));
    return std::move(bytes_);
  }

 private:
  std::size_t draw(std::size_t below) {
    const double u = static_cast<double>(uniform01(seed_, Purpose::kTest, round_, draws_++));
    return std::min(below - 1, static_cast<std::size_t>(u * static_cast<double>(below)));
  }

  void put(std::size_t at, const void* data, std::size_t size) { std::memcpy(bytes_.data() + at, data, std::min(size, bytes_.size() - at)); }

  void change() {
    if (bytes_.empty()) {
      bytes_.assign(1 + draw(64), static_cast<char>(draw(256)));
      return;
    }
    const std::size_t at = draw(bytes_.size()), length = std::min(bytes_.size() - at, std::size_t{1} << draw(9));
    switch (draw(9)) {
      case 0: bytes_[at] = static_cast<char>(bytes_[at] ^ (1 << draw(8))); break;
      case 1: bytes_[at] = static_cast<char>(draw(256)); break;
      case 2: {  // numbers at the ends of their range
        const std::uint64_t numbers[] = {0, 1, 0x7f, 0xff, 0x7fff, 0xffff, 0x7fffffff, 0x80000000u, 0xffffffffu, 0x7fffffffffffffffull, 0x8000000000000000ull, ~0ull};
        put(at, &numbers[draw(12)], std::size_t{1} << draw(4));
        break;
      }
      case 3: bytes_.erase(at, length); break;
      case 4: bytes_.insert(draw(bytes_.size()), bytes_.substr(at, length)); break;
      case 5: bytes_.replace(draw(bytes_.size()), length, bytes_.substr(at, length)); break;
      case 6: bytes_.resize(at); break;
      case 7: {  // a number in a text
        const char* const numbers[] = {"0", "-1", "1e999", "nan", "99999999999999999999", "2147483648", "1,5", "", "-0", "0x10", "1e-320"};
        const std::size_t digit = bytes_.find_first_of("0123456789", at);
        if (digit == std::string::npos) break;
        const std::size_t end = std::min(bytes_.find_first_not_of("0123456789.", digit), bytes_.size());
        bytes_.replace(digit, end - digit, numbers[draw(11)]);
        break;
      }
      default:
        for (std::size_t i = 0; i < std::min<std::size_t>(length, 16); ++i) bytes_[at + i] = static_cast<char>(draw(256));
    }
  }

  std::string bytes_;
  std::uint64_t seed_, round_;
  std::uint32_t draws_ = 0;
};

}  // namespace

std::string mutated(std::string bytes, std::uint64_t seed, std::uint64_t round, std::size_t max_bytes) { return Mutator(std::move(bytes), seed, round).run(max_bytes); }

}  // namespace chiaro::fuzz
