#include "stream/photo/cells.h"

#include "stream/photo/develop.h"

namespace chiaro::stream {

Cells::Cells(int picture_width_px, int cell_px)
    : cell_px_(cell_px), sums_(static_cast<std::size_t>(picture_width_px / cell_px)), flags_(sums_.size()) {
  for (std::vector<float>& plane : rgb_) plane.resize(sums_.size());
}

bool Cells::push(const std::array<std::span<const float>, 3>& rgb, std::span<const std::uint8_t> flags) {
  std::size_t i = 0;
  for (Sums& s : sums_)
    for (int x = 0; x < cell_px_; ++x, ++i) {
      const std::uint8_t f = flags[i];
      s.any |= f;
      s.num_allowed += (f & kUsableByMask) != 0;
      if (f & kNotFinite) continue;
      ++s.num_finite;
      for (std::size_t c = 0; c < 3; ++c) s.finite[c] += static_cast<double>(rgb[c][i]);
      if (f != kUsableByMask) continue;
      ++s.num_usable;
      for (std::size_t c = 0; c < 3; ++c) s.usable[c] += static_cast<double>(rgb[c][i]);
    }
  if (++rows_ < cell_px_) return false;
  finish();
  return true;
}

void Cells::finish() {
  const int all = cell_px_ * cell_px_;
  for (std::size_t i = 0; i < sums_.size(); ++i) {
    const Sums& s = sums_[i];
    const bool usable = 2 * s.num_usable >= all;
    const int num = usable ? s.num_usable : s.num_finite;
    for (std::size_t c = 0; c < 3; ++c) rgb_[c][i] = num > 0 ? static_cast<float>((usable ? s.usable[c] : s.finite[c]) / num) : 0.0f;
    const int mask = 2 * s.num_allowed >= all ? kUsableByMask : 0;
    flags_[i] = static_cast<std::uint8_t>(usable ? kUsableByMask : mask | (s.any & (kSaturated | kNotFinite)));
  }
  sums_.assign(sums_.size(), {});
  rows_ = 0;
}

}  // namespace chiaro::stream
