#include "stream/store/pending_normal.h"

namespace chiaro::stream {
namespace {

// Of a code's 16 bits the upper 10; what is cut off is replaced by its middle.
unsigned upper(std::int16_t code) { return static_cast<std::uint16_t>(code) >> 6; }
std::int16_t restored(unsigned bits) { return static_cast<std::int16_t>(static_cast<std::uint16_t>(bits << 6 | 1u << 5)); }

void drop(SurfelBlock& b, std::size_t lane) {
  b.flags[lane] = static_cast<std::uint8_t>(b.flags[lane] & ~kPending);
  b.log_radius[lane] = 0;
  put_clip(b, lane, 0);
}

}  // namespace

void put_pending(SurfelBlock& b, std::size_t lane, const Vec3f& unit_normal) {
  const auto code = encode_normal(unit_normal);
  const unsigned bits = upper(code[0]) << 10 | upper(code[1]);
  b.log_radius[lane] = static_cast<std::uint8_t>(bits >> 12);
  put_clip(b, lane, static_cast<std::uint16_t>(bits & 0xfff));
}

void settle(std::span<SurfelBlock> blocks) {
  for (SurfelBlock& b : blocks)
    for (std::size_t lane = 0; lane < kBlockSurfels; ++lane) {
      if (!is_pending(b, lane)) continue;
      const unsigned bits = static_cast<unsigned>(b.log_radius[lane]) << 12 | clip_of(b, lane);
      b.normal_u[lane] = restored(bits >> 10);
      b.normal_v[lane] = restored(bits & 0x3ff);
      drop(b, lane);
    }
}

void forget_pending(std::span<SurfelBlock> blocks) {
  for (SurfelBlock& b : blocks)
    for (std::size_t lane = 0; lane < kBlockSurfels; ++lane)
      if (is_pending(b, lane)) drop(b, lane);
}

}  // namespace chiaro::stream
