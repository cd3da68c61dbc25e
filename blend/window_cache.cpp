#include "blend/window_cache.h"

#include "stream/base/error.h"

namespace chiaro::blend {
namespace {

constexpr std::size_t kMostKept = 32;

struct Held {
  BudgetLease lease;
  PhotoWindow window;
};

}  // namespace

std::shared_ptr<const PhotoWindow> WindowCache::whole(const BlendPhotograph& photograph, std::uint64_t held, std::uint64_t most) {
  if (const auto found = kept_.find(&photograph); found != kept_.end()) return found->second;
  const stream::Lens& lens = photograph.camera.lens;
  const std::uint64_t pixels = static_cast<std::uint64_t>(lens.width_px) * static_cast<std::uint64_t>(lens.height_px), bytes = pixels * held_bytes_per_pixel(options_.wider), preparing = pixels * window_bytes_per_pixel(options_.wider);
  const std::uint64_t room = room_lease_.bytes();
  if (held + bytes > most || preparing > (budget_.free_bytes() + room) / 3 * 2) return nullptr;
  const std::string what = concat("photograph ", photograph.name);
  room_lease_.release();   // part of what follows
  if (room > preparing) room_ = {};
  BudgetLease preparation(budget_, preparing, what);
  const PhotographRasters rasters(lens, photograph.gbuffer, photograph.albedo, photograph.radiance);
  auto window = load_window(rasters, photograph.camera, 0, rasters.height(), 0, kPyramidRows, options_, room_);   // beyond the image there is nothing that it might need
  preparation.release();
  const auto whole = std::make_shared<Held>(Held{BudgetLease(budget_, bytes, what), std::move(window)});
  room_lease_ = BudgetLease(budget_, preparing - bytes, what);
  const std::shared_ptr<const PhotoWindow> result(whole, &whole->window);
  if (kept_.size() < kMostKept && kept_bytes_ + bytes <= most_kept_) {
    kept_.emplace(&photograph, result);
    kept_bytes_ += bytes;
  }
  return result;
}

void WindowCache::give_room_back() {
  room_ = {};
  room_lease_.release();
}

}  // namespace chiaro::blend
