#include "stream/base/report.h"

#include "stream/base/error.h"

namespace chiaro {
namespace {
class Silent final : public Reporter {
 public:
  void begin(std::string_view, std::uint64_t, std::string_view) override {}
  void progress(std::uint64_t) override {}
  void end() override {}
  void note(std::string_view) override {}
  bool cancelled() const override { return false; }
};
}  // namespace

void Reporter::check() const {
  if (cancelled()) throw Cancelled();
}

Reporter& silent_reporter() {
  static Silent silent;
  return silent;
}
}  // namespace chiaro
