/// A reporter that cancels.
#pragma once
#include <atomic>

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

}  // namespace chiaro::blend
