/// How long work tells its progress and learns that it should stop. Libraries stay silent: tools/ decides what is printed.
#pragma once
#include <cstdint>
#include <string_view>

namespace chiaro {

class Reporter {
 public:
  virtual ~Reporter() = default;
  /// A piece of work starts, e.g. "raycast photo_03"; `total` items of `unit` ("points", "rows") lie ahead, 0 = unknown.
  virtual void begin(std::string_view stage, std::uint64_t total, std::string_view unit) = 0;
  /// `done` items are finished. Called from any thread, not more often than a few thousand times a second.
  virtual void progress(std::uint64_t done) = 0;
  virtual void end() = 0;
  /// One sentence the user should read (something left out, a fallback taken).
  virtual void note(std::string_view text) = 0;
  virtual bool cancelled() const = 0;

  /// throws Cancelled if the user asked to stop.
  void check() const;
};

/// Says nothing and never cancels: for tests and for work inside work.
Reporter& silent_reporter();

}  // namespace chiaro
