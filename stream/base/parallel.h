/// Parallel loops over index blocks (TBB behind). Each task writes its own slots, so loops need no lock and results do not depend on threads.
#pragma once
#include <cstddef>
#include <functional>
#include <memory>
#include <vector>

namespace chiaro {

/// Calls body(begin, end) for consecutive blocks of `grain` indices that cover [0, count). An exception in a block surfaces here.
void parallel_blocks(std::size_t count, std::size_t grain, const std::function<void(std::size_t begin, std::size_t end)>& body);

/// Sum of block(begin, end) over blocks of fixed grain, added in block order: the same bits for any thread count.
template <class T>
T deterministic_sum(std::size_t count, std::size_t grain, T zero, const std::function<T(std::size_t, std::size_t)>& block) {
  const std::size_t num_blocks = (count + grain - 1) / grain;
  std::vector<T> partial(num_blocks, zero);
  parallel_blocks(num_blocks, 1, [&](std::size_t b0, std::size_t b1) {
    for (std::size_t b = b0; b < b1; ++b) partial[b] = block(b * grain, b * grain + grain < count ? b * grain + grain : count);
  });
  T sum = zero;
  for (const T& p : partial) sum += p;
  return sum;
}

/// Items pass through `slots` places, each in turn: produce(slot) one after the other until it says false, work(slot) side by side, consume(slot) one after the other in the
/// order in which they were produced. At most `slots` items are under way. An exception in a step surfaces here; items under way are given up then.
void ordered_pipeline(std::size_t slots, const std::function<bool(std::size_t slot)>& produce, const std::function<void(std::size_t slot)>& work,
                      const std::function<void(std::size_t slot)>& consume);

/// Limits TBB to `threads` (0 = all cores) while it lives. tools/ makes one; nothing else does.
class ThreadLimit {
 public:
  explicit ThreadLimit(int threads);
  ~ThreadLimit();
  static int current();

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace chiaro
