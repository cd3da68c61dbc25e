/// A reporter that keeps what is noted.
#pragma once
#include <string>
#include <string_view>

#include "stream/base/report.h"

namespace chiaro::blend {

class NotingReporter : public Reporter {
 public:
  void begin(std::string_view, std::uint64_t, std::string_view) override {}
  void progress(std::uint64_t) override {}
  void end() override {}
  void note(std::string_view text) override { notes += std::string(text) + "\n"; }
  bool cancelled() const override { return false; }
  std::string notes;   ///< a line each
};

}  // namespace chiaro::blend
