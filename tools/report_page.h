/// What a page of HTML is put together from: elements, tables, numbers in words.
#pragma once
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

namespace chiaro::tools {

/// Text for HTML: & < > " ' escaped, control characters and broken UTF-8 replaced.
std::string html_escape(std::string_view text);

/// Builds the page: every text goes through text(), everything else is written here.
class Page {
 public:
  Page& raw(std::string_view html) {
    out_ += html;
    return *this;
  }
  Page& text(std::string_view words) { return raw(html_escape(words)); }
  Page& element(std::string_view tag, std::string_view words, std::string_view attributes = "") {
    open(tag, attributes).text(words);
    return close(tag);
  }
  Page& open(std::string_view tag, std::string_view attributes = "") {
    raw("<").raw(tag);
    if (!attributes.empty()) raw(" ").raw(attributes);
    return raw(">");
  }
  Page& close(std::string_view tag) { return raw("</").raw(tag).raw(">\n"); }
  std::string take() { return std::move(out_); }

 private:
  std::string out_;
};

/// Cells that are words are named by `words`: 'w' word, 'l' long word, anything else a number.
void table(Page& page, const std::vector<std::string>& headers, std::string_view words, const std::vector<std::vector<std::string>>& rows);

/// The style sheet of a report, with its colour bars.
std::string page_style();

/// Numbers for people: a dash where there is none, spaces that do not break.
std::string percent(double share, int digits = 3);
std::string number(double v, int digits = 4);
std::string with_sd(double v, double sd);
std::string counted(std::uint64_t n);
std::string interval(double a, double b);

}  // namespace chiaro::tools
