/// The memory the user allows, handed out to everything large. Design decision 2: memory depends on the budget, never on the model.
#pragma once
#include <atomic>
#include <cstdint>
#include <string>
#include <string_view>

namespace chiaro {

/// Accounts for large allocations against one limit. Thread-safe. It counts; it does not allocate.
class MemoryBudget {
 public:
  /// limit_bytes: what may be handed out: the user's --memory minus what the process itself needs (see for_process()).
  explicit MemoryBudget(std::uint64_t limit_bytes) : limit_bytes_(limit_bytes) {}
  MemoryBudget(const MemoryBudget&) = delete;
  MemoryBudget& operator=(const MemoryBudget&) = delete;

  std::uint64_t limit_bytes() const { return limit_bytes_; }
  std::uint64_t used_bytes() const { return used_bytes_; }
  std::uint64_t peak_bytes() const { return peak_bytes_; }
  std::uint64_t free_bytes() const { return limit_bytes_ > used_bytes_ ? limit_bytes_ - used_bytes_ : 0; }

  /// True and accounted, or false and unchanged.
  bool try_take(std::uint64_t bytes);
  /// throws Error naming `what`, the bytes wanted and the bytes left.
  void take(std::uint64_t bytes, std::string_view what);
  void give(std::uint64_t bytes);

 private:
  const std::uint64_t limit_bytes_;
  std::atomic<std::uint64_t> used_bytes_{0};
  std::atomic<std::uint64_t> peak_bytes_{0};
};

/// Holds `bytes` of a budget for as long as it lives.
class BudgetLease {
 public:
  BudgetLease() = default;
  BudgetLease(MemoryBudget& budget, std::uint64_t bytes, std::string_view what) : budget_(&budget), bytes_(bytes) { budget.take(bytes, what); }
  BudgetLease(BudgetLease&& other) noexcept : budget_(other.budget_), bytes_(other.bytes_) { other.budget_ = nullptr; }
  BudgetLease& operator=(BudgetLease&& other) noexcept;
  ~BudgetLease() { release(); }
  void release();
  std::uint64_t bytes() const { return budget_ ? bytes_ : 0; }

 private:
  MemoryBudget* budget_ = nullptr;
  std::uint64_t bytes_ = 0;
};

/// "512MiB", "2 GiB", "1.5GB", "800000000" to bytes. throws UsageError.
std::uint64_t parse_bytes(std::string_view text);
/// 1610612736 to "1.50 GiB".
std::string format_bytes(std::uint64_t bytes);
/// Peak resident set of this process (VmHWM), bytes; 0 where the system does not tell.
std::uint64_t peak_resident_bytes();
std::uint64_t resident_bytes();

}  // namespace chiaro
