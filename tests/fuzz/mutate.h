/// Damage to bytes, the same for the same numbers: flipped bits, other bytes, large and small numbers, pieces cut, doubled and moved, other digits.
#pragma once
#include <cstdint>
#include <string>

namespace chiaro::fuzz {

/// `bytes` after one to six changes drawn from (seed, round); at most max_bytes long.
std::string mutated(std::string bytes, std::uint64_t seed, std::uint64_t round, std::size_t max_bytes = 1 << 20);

}  // namespace chiaro::fuzz
