#include "stream/base/budget.h"

#include <charconv>
#include <cstdio>
#include <cstring>
#include <fstream>

#include "stream/base/error.h"

namespace chiaro {

bool MemoryBudget::try_take(std::uint64_t bytes) {
  std::uint64_t used = used_bytes_.load();
  do {
    if (bytes > limit_bytes_ || used > limit_bytes_ - bytes) return false;
  } while (!used_bytes_.compare_exchange_weak(used, used + bytes));
  std::uint64_t peak = peak_bytes_.load();
  while (used + bytes > peak && !peak_bytes_.compare_exchange_weak(peak, used + bytes)) {
  }
  return true;
}

void MemoryBudget::take(std::uint64_t bytes, std::string_view what) {
  if (!try_take(bytes))
    throw Error(concat("memory budget: ", what, " needs ", format_bytes(bytes), ", ", format_bytes(free_bytes()), " of ",
                       format_bytes(limit_bytes_), " left; raise --memory"));
}

void MemoryBudget::give(std::uint64_t bytes) { used_bytes_ -= bytes; }

BudgetLease& BudgetLease::operator=(BudgetLease&& other) noexcept {
  if (this != &other) {
    release();
    budget_ = other.budget_;
    bytes_ = other.bytes_;
    other.budget_ = nullptr;
  }
  return *this;
}

void BudgetLease::release() {
  if (budget_) budget_->give(bytes_);
  budget_ = nullptr;
}

std::uint64_t parse_bytes(std::string_view text) {
  const auto fail = [&] { throw UsageError(concat("memory size \"", text, "\": expected a number with an optional unit, such as 512MiB or 2 GB")); };
  double value = 0;
  const auto [end, code] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (code != std::errc() || !(value > 0)) fail();
  std::string unit;
  for (const char* c = end; c != text.data() + text.size(); ++c)
    if (*c != ' ') unit += static_cast<char>(*c >= 'a' && *c <= 'z' ? *c - 32 : *c);
  double factor = 0;
  if (unit.empty() || unit == "B") factor = 1;
  const struct { const char* name; double factor; } units[] = {
      {"K", 1024.}, {"KIB", 1024.}, {"KB", 1e3}, {"M", 1048576.}, {"MIB", 1048576.}, {"MB", 1e6},
      {"G", 1073741824.}, {"GIB", 1073741824.}, {"GB", 1e9}, {"T", 1099511627776.}, {"TIB", 1099511627776.}, {"TB", 1e12}};
  for (const auto& u : units)
    if (unit == u.name) factor = u.factor;
  if (factor == 0 || value * factor > 1e18) fail();
  return static_cast<std::uint64_t>(value * factor);
}

std::string format_bytes(std::uint64_t bytes) {
  const char* names[] = {"B", "KiB", "MiB", "GiB", "TiB"};
  double value = static_cast<double>(bytes);
  int unit = 0;
  while (value >= 1024 && unit < 4) {
    value /= 1024;
    ++unit;
  }
  char text[40];
  std::snprintf(text, sizeof text, unit == 0 ? "%.0f %s" : "%.2f %s", value, names[unit]);
  return text;
}

namespace {
std::uint64_t status_kib(const char* key) {
  std::ifstream in("/proc/self/status");
  std::string line;
  while (std::getline(in, line))
    if (line.compare(0, std::strlen(key), key) == 0) return std::strtoull(line.c_str() + std::strlen(key), nullptr, 10) * 1024;
  return 0;
}
}  // namespace

std::uint64_t peak_resident_bytes() { return status_kib("VmHWM:"); }
std::uint64_t resident_bytes() { return status_kib("VmRSS:"); }

}  // namespace chiaro
