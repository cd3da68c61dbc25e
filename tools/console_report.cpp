#include "tools/console_report.h"

#include <algorithm>
#include <cmath>
#include <csignal>
#include <nlohmann/json.hpp>
#include <ostream>

#include "stream/base/error.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {
volatile std::sig_atomic_t stop_flag = 0, hangup_stops = 0;

extern "C" void on_stop_signal(int) {
  stop_flag = 1;
  // The next one, of any kind, ends the process the usual way.
  std::signal(SIGINT, SIG_DFL);
  std::signal(SIGTERM, SIG_DFL);
  if (hangup_stops) std::signal(SIGHUP, SIG_DFL);
}

double steady_seconds() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

std::string amount(double value, const std::string& unit) { return unit.empty() ? format_rate(value) : format_rate(value) + " " + unit; }

/// Cuts to `columns` characters of UTF-8.
std::string cut(const std::string& text, int columns) {
  int used = 0;
  for (std::size_t i = 0; i < text.size(); ++i) {
    if ((static_cast<unsigned char>(text[i]) & 0xc0) == 0x80) continue;
    if (++used > columns) return text.substr(0, i);
  }
  return text;
}
}  // namespace

void install_stop_signals() {
  struct sigaction action = {};
  action.sa_handler = on_stop_signal;
  action.sa_flags = SA_RESTART;
  sigemptyset(&action.sa_mask);
  sigaction(SIGINT, &action, nullptr);
  sigaction(SIGTERM, &action, nullptr);
  struct sigaction before = {};
  hangup_stops = sigaction(SIGHUP, nullptr, &before) == 0 && before.sa_handler == SIG_DFL;   // under nohup it is ignored, and stays so
  if (hangup_stops) sigaction(SIGHUP, &action, nullptr);
}

bool stop_requested() { return stop_flag != 0; }

std::string json_quote(std::string_view text) {
  return nlohmann::json(std::string(text)).dump(-1, ' ', false, nlohmann::json::error_handler_t::replace);
}

std::string json_number(double value) { return std::isfinite(value) ? nlohmann::json(value).dump() : "null"; }

ConsoleReport::ConsoleReport(std::ostream& talk, std::ostream& events, ConsoleReportOptions options)
    : talk_(talk), events_(events), options_(std::move(options)) {
  if (!options_.now_s) options_.now_s = steady_seconds;
}

ConsoleReport::~ConsoleReport() { clear(); }

double ConsoleReport::interval_s() const {
  return options_.json ? options_.json_interval_s : options_.is_terminal ? options_.live_interval_s : options_.plain_interval_s;
}

void ConsoleReport::event(const std::string& json_line) { events_ << json_line << '\n' << std::flush; }

void ConsoleReport::talk_line(const std::string& text) {
  if (line_shown_) talk_ << "\r\033[K";
  line_shown_ = false;
  talk_ << text << '\n' << std::flush;
}

void ConsoleReport::clear() {
  const std::lock_guard lock(mutex_);
  if (line_shown_) talk_ << "\r\033[K" << std::flush;
  line_shown_ = false;
}

void ConsoleReport::begin(std::string_view stage, std::uint64_t total, std::string_view unit) {
  const std::lock_guard lock(mutex_);
  const double now = options_.now_s();
  stages_.push_back({std::string(stage), std::string(unit), total, 0, now});
  latest_done_ = 0;
  next_show_s_ = now + interval_s();
  if (options_.quiet) return;
  if (options_.json)
    event(concat("{\"event\":\"begin\",\"stage\":", json_quote(stage), ",\"total\":", total ? std::to_string(total) : "null", ",\"unit\":", json_quote(unit), "}"));
  else if (options_.is_terminal)
    show(stages_.back(), now);
  else
    talk_line(total ? concat(stage, ": ", format_count(total), unit.empty() ? "" : " ", unit) : std::string(stage));
}

void ConsoleReport::progress(std::uint64_t done) {
  // Calls of several threads may overtake each other: the largest counts.
  std::uint64_t known = latest_done_.load(std::memory_order_relaxed);
  while (done > known && !latest_done_.compare_exchange_weak(known, done)) {
  }
  const double now = options_.now_s();
  if (now < next_show_s_.load(std::memory_order_relaxed)) return;
  const std::lock_guard lock(mutex_);
  if (stages_.empty() || now < next_show_s_.load()) return;
  next_show_s_ = now + interval_s();
  Stage& stage = stages_.back();
  stage.done = std::max(stage.done, latest_done_.load());
  if (!options_.quiet) show(stage, now);
}

std::string ConsoleReport::status(const Stage& stage, double now) const {
  std::string text = stage.name;
  const double elapsed = now - stage.start_s;
  const double done = static_cast<double>(stage.done), total = static_cast<double>(stage.total);
  if (stage.total) text += concat("  ", static_cast<int>(100 * std::min(1.0, done / total)), " %  ", format_rate(done), " of ", amount(total, stage.unit));
  else if (stage.done) text += "  " + amount(done, stage.unit);
  if (stage.done && elapsed > 0) text += "  " + amount(done / elapsed, stage.unit) + "/s";
  if (stage.total && stage.done && stage.done < stage.total) text += "  ETA " + format_seconds(elapsed * (total - done) / done);
  return text;
}

void ConsoleReport::show(const Stage& stage, double now) {
  const double elapsed = now - stage.start_s;
  const double done = static_cast<double>(stage.done), total = static_cast<double>(stage.total);
  if (options_.json) {
    const double rate = elapsed > 0 ? done / elapsed : NAN;
    const double eta_s = stage.total && stage.done ? std::max(0.0, elapsed * (total - done) / done) : NAN;
    event(concat("{\"event\":\"progress\",\"stage\":", json_quote(stage.name), ",\"done\":", stage.done, ",\"total\":",
                 stage.total ? std::to_string(stage.total) : "null", ",\"unit\":", json_quote(stage.unit), ",\"rate\":", json_number(rate),
                 ",\"eta_s\":", json_number(eta_s), "}"));
  } else if (options_.is_terminal) {
    talk_ << "\r\033[K" << cut(status(stage, now), std::max(20, options_.columns - 1)) << std::flush;
    line_shown_ = true;
  } else {
    talk_line(status(stage, now));
  }
}

void ConsoleReport::end() {
  const std::lock_guard lock(mutex_);
  if (stages_.empty()) return;
  Stage stage = std::move(stages_.back());
  stages_.pop_back();
  stage.done = std::max(stage.done, latest_done_.load());
  latest_done_ = stages_.empty() ? 0 : stages_.back().done;
  const double now = options_.now_s(), elapsed = now - stage.start_s;
  next_show_s_ = now + interval_s();
  if (options_.quiet) return;
  if (options_.json) {
    event(concat("{\"event\":\"end\",\"stage\":", json_quote(stage.name), ",\"seconds\":", json_number(elapsed), ",\"done\":", stage.done, "}"));
    return;
  }
  std::string text = stage.name + ": " + format_seconds(elapsed);
  if (stage.done && elapsed > 0) text += concat(" (", amount(static_cast<double>(stage.done) / elapsed, stage.unit), "/s)");
  talk_line(text);
  if (options_.is_terminal && !stages_.empty()) show(stages_.back(), now);
}

void ConsoleReport::note(std::string_view text) {
  const std::lock_guard lock(mutex_);
  if (options_.json) return event(concat("{\"event\":\"note\",\"text\":", json_quote(text), "}"));
  talk_line(concat("note: ", text));
  if (options_.is_terminal && !options_.quiet && !stages_.empty()) show(stages_.back(), options_.now_s());
}

}  // namespace chiaro::tools
