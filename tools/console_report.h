/// Progress for people and for programs: a live line on a terminal, plain lines elsewhere, JSON events on demand; and the stop signals.
#pragma once
#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <iosfwd>
#include <mutex>
#include <string>
#include <string_view>
#include <vector>

#include "stream/base/report.h"

namespace chiaro::tools {

/// The first SIGINT, SIGTERM or SIGHUP (a terminal that is closed; where that is ignored, as under nohup, it stays so) only raises a flag, so that work stops cleanly between two items; the second one ends the process at once.
void install_stop_signals();
/// True once a stop signal came.
bool stop_requested();

struct ConsoleReportOptions {
  bool is_terminal = false;   ///< the stream is a terminal: one live line instead of plain ones
  bool json = false;          ///< one JSON event per line on `events`, nothing live
  bool quiet = false;         ///< notes only
  int columns = 80;           ///< of the terminal
  double live_interval_s = 0.1, plain_interval_s = 10, json_interval_s = 1;
  std::function<double()> now_s;  ///< seconds from any origin; default: the steady clock. Tests pass their own
};

/// Prints what libraries report. Thread-safe. Stages may nest ("run" around "raycast photo_03"): the innermost one is shown.
///
/// Terminal: `raycast photo_03  43 %  132 k of 307 k pixels  61 k pixels/s  ETA 3 s`, rewritten in place, then a line that stays.
/// Plain: a line at the start, at most one per 10 s, and one at the end with seconds and rate.
/// JSON: {"event":"begin","stage":…,"total":…,"unit":…}, {"event":"progress","stage":…,"done":…,"total":…,"rate":…,"eta_s":…},
/// {"event":"end","stage":…,"seconds":…,"done":…}, {"event":"note","text":…}; "total" and "eta_s" are null while unknown.
class ConsoleReport final : public Reporter {
 public:
  /// talk: usually stderr; events: usually stdout, used with options.json only.
  ConsoleReport(std::ostream& talk, std::ostream& events, ConsoleReportOptions options);
  ~ConsoleReport() override;

  void begin(std::string_view stage, std::uint64_t total, std::string_view unit) override;
  void progress(std::uint64_t done) override;
  void end() override;
  void note(std::string_view text) override;
  bool cancelled() const override { return stop_requested(); }

  /// Removes the live line, so that something else can be printed.
  void clear();

 private:
  struct Stage {
    std::string name, unit;
    std::uint64_t total = 0, done = 0;
    double start_s = 0;
  };
  void event(const std::string& json_line);
  void talk_line(const std::string& text);
  void show(const Stage& stage, double now);
  std::string status(const Stage& stage, double now) const;
  double interval_s() const;

  std::ostream& talk_;
  std::ostream& events_;
  ConsoleReportOptions options_;
  std::mutex mutex_;
  std::vector<Stage> stages_;
  std::atomic<double> next_show_s_{0};  ///< progress() returns before this moment without taking the lock
  std::atomic<std::uint64_t> latest_done_{0};
  bool line_shown_ = false;
};

/// JSON string literal of any bytes (invalid UTF-8 becomes U+FFFD).
std::string json_quote(std::string_view text);
/// A number, or null where it is not finite.
std::string json_number(double value);

}  // namespace chiaro::tools
