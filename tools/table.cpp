#include "tools/table.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <stdexcept>

namespace chiaro::tools {
namespace {
std::size_t columns_of(const std::string& utf8) {
  return static_cast<std::size_t>(std::count_if(utf8.begin(), utf8.end(), [](char c) { return (static_cast<unsigned char>(c) & 0xc0) != 0x80; }));
}

void append_line(std::string& out, const std::vector<std::string>& cells, const std::vector<std::size_t>& widths, const std::vector<Table::Align>& aligns) {
  std::string line;
  for (std::size_t i = 0; i < cells.size(); ++i) {
    const std::string fill(widths[i] - columns_of(cells[i]), ' ');
    if (i) line += "  ";
    line += aligns[i] == Table::Align::kRight ? fill + cells[i] : cells[i] + fill;
  }
  while (!line.empty() && line.back() == ' ') line.pop_back();
  out += line + '\n';
}

std::string print(const char* format, double value) {
  char text[64];
  std::snprintf(text, sizeof text, format, value);
  return text;
}
}  // namespace

Table::Table(std::vector<std::string> headers, std::vector<Align> aligns) : headers_(std::move(headers)), aligns_(std::move(aligns)) {
  if (aligns_.size() > headers_.size()) throw std::invalid_argument("Table: more alignments than columns");
  while (aligns_.size() < headers_.size()) aligns_.push_back(aligns_.empty() ? Align::kLeft : Align::kRight);
}

void Table::row(std::vector<std::string> cells) {
  if (cells.size() > headers_.size()) throw std::invalid_argument("Table: more cells than columns");
  cells.resize(headers_.size());
  rows_.push_back(std::move(cells));
}

std::string Table::text() const {
  std::vector<std::size_t> widths(headers_.size());
  bool has_header = false;
  for (std::size_t i = 0; i < headers_.size(); ++i) {
    widths[i] = columns_of(headers_[i]);
    has_header = has_header || !headers_[i].empty();
    for (const auto& cells : rows_) widths[i] = std::max(widths[i], columns_of(cells[i]));
  }
  std::string out;
  if (has_header) append_line(out, headers_, widths, aligns_);
  for (const auto& cells : rows_) append_line(out, cells, widths, aligns_);
  return out;
}

std::string format_count(std::uint64_t count) {
  const std::string digits = std::to_string(count);
  std::string out;
  for (std::size_t i = 0; i < digits.size(); ++i) {
    if (i && (digits.size() - i) % 3 == 0) out += ' ';
    out += digits[i];
  }
  return out;
}

std::string format_number(double value, int digits) {
  if (std::isnan(value)) return "nan";
  char text[64];
  std::snprintf(text, sizeof text, "%.*g", digits, value);
  return text;
}

std::string format_seconds(double seconds) {
  if (!(seconds >= 0)) return "?";
  if (seconds < 9.95) return print(seconds < 0.995 ? "%.2f s" : "%.1f s", seconds);
  const double whole = std::floor(seconds + 0.5);
  if (whole < 60) return print("%.0f s", whole);
  char text[64];
  if (whole < 3600)
    std::snprintf(text, sizeof text, "%.0f min %02.0f s", std::floor(whole / 60), std::fmod(whole, 60));
  else
    std::snprintf(text, sizeof text, "%.0f h %02.0f min", std::floor(whole / 3600), std::floor(std::fmod(whole, 3600) / 60));
  return text;
}

std::string format_rate(double per_second) {
  const char* suffixes[] = {"", " k", " M", " G"};
  int step = 0;
  while (per_second >= 999.5 && step < 3) {
    per_second /= 1000;
    ++step;
  }
  return print(per_second < 99.95 ? "%.3g" : "%.0f", per_second) + suffixes[step];
}

double round_range(double value) {
  if (!(value > 0) || !std::isfinite(value)) return 1;
  const double exponent = std::floor(std::log10(value));
  // Divided by a power of ten for negative exponents: 2 / 100 is the number that "0.02" means, 2 * 0.01 need not be.
  const auto at = [&](double digit, double e) { return e < 0 ? digit / std::pow(10.0, -e) : digit * std::pow(10.0, e); };
  for (const double e : {exponent, exponent + 1})
    for (const double digit : {1.0, 2.0, 5.0})
      if (at(digit, e) >= value * (1 - 1e-12)) return at(digit, e);
  return value;
}

}  // namespace chiaro::tools
