#include "stream/base/parallel.h"

#include <tbb/blocked_range.h>
#include <tbb/global_control.h>
#include <tbb/info.h>
#include <tbb/parallel_for.h>
#include <tbb/parallel_pipeline.h>

#include <algorithm>

namespace chiaro {

void parallel_blocks(std::size_t count, std::size_t grain, const std::function<void(std::size_t, std::size_t)>& body) {
  if (count == 0) return;
  const std::size_t num_blocks = (count + grain - 1) / grain;
  if (num_blocks == 1) return body(0, count);
  tbb::parallel_for(tbb::blocked_range<std::size_t>(0, num_blocks, 1),
                    [&](const tbb::blocked_range<std::size_t>& r) {
                      for (std::size_t b = r.begin(); b != r.end(); ++b) body(b * grain, std::min(count, (b + 1) * grain));
                    },
                    tbb::simple_partitioner());
}

// Items end in the order in which they began and at most `slots` are under way, so that the slot of the one that ended `slots` items ago is free.
void ordered_pipeline(std::size_t slots, const std::function<bool(std::size_t)>& produce, const std::function<void(std::size_t)>& work,
                      const std::function<void(std::size_t)>& consume) {
  std::size_t next = 0;
  const auto first = [&](tbb::flow_control& control) {
    const std::size_t slot = next;
    next = (next + 1) % slots;
    if (!produce(slot)) control.stop();
    return slot;
  };
  const auto second = [&](std::size_t slot) {
    work(slot);
    return slot;
  };
  using Mode = tbb::filter_mode;
  tbb::parallel_pipeline(slots, tbb::make_filter<void, std::size_t>(Mode::serial_in_order, first) & tbb::make_filter<std::size_t, std::size_t>(Mode::parallel, second) &
                                    tbb::make_filter<std::size_t, void>(Mode::serial_in_order, consume));
}

struct ThreadLimit::Impl {
  explicit Impl(int n) : control(tbb::global_control::max_allowed_parallelism, static_cast<std::size_t>(n)) {}
  tbb::global_control control;
};

ThreadLimit::ThreadLimit(int threads) : impl_(std::make_unique<Impl>(threads > 0 ? threads : tbb::info::default_concurrency())) {}
ThreadLimit::~ThreadLimit() = default;
int ThreadLimit::current() { return static_cast<int>(tbb::global_control::active_value(tbb::global_control::max_allowed_parallelism)); }

}  // namespace chiaro
