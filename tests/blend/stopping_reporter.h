/// A reporter that cancels.
#pragma once
#include <gtest/gtest.h>

#include <atomic>
#include <functional>

#include "stream/base/report.h"

namespace chiaro::blend {

/// Stops the work after some time that is counted in calls.
class StoppingReporter : public Reporter {
 public:
  explicit StoppingReporter(int calls) : left_(calls) {}
  void begin(std::string_view, std::uint64_t, std::string_view) override {}
  void progress(std::uint64_t) override {}
  void end() override {}
  void note(std::string_view) override {}
  bool cancelled() const override { return left_-- <= 0; }

 private:
  mutable std::atomic<int> left_;
};

/// Calls attempt(report, stops so far) until one is not stopped: the first after `first` calls, each later one after `later` more. Returns how many were.
template <class Attempt>
int stops_until_done(int first, int later, const Attempt& attempt, const std::function<void()>& after_stop = {}) {
  constexpr int kMost = 200;
  for (int stops = 0; stops < kMost; ++stops) {
    StoppingReporter report(first + stops * later);
    try {
      attempt(report, stops);
      return stops;
    } catch (const Cancelled&) {
      if (after_stop) after_stop();
    }
  }
  ADD_FAILURE() << "stopped " << kMost << " times";
  return kMost;
}

}  // namespace chiaro::blend
