#include "tools/report_page.h"

#include <cmath>

#include "stream/base/error.h"
#include "tools/report_json.h"
#include "tools/report_palette.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {

// Neutral greys throughout: a coloured page would shift how the pictures look. One grey in the middle, as walls of viewing booths are.
const char* const kStyle = R"(
:root{--page:#4a4a4a;--panel:#3c3c3c;--line:#666;--text:#f2f2f2;--soft:#c4c4c4;--strong:#fff}
@media (prefers-color-scheme:light){:root{--page:#cfcfcf;--panel:#dedede;--line:#a0a0a0;--text:#1c1c1c;--soft:#474747;--strong:#000}}
@media print{:root{--page:#fff;--panel:#fff;--line:#999;--text:#000;--soft:#333;--strong:#000}section.photograph{break-inside:avoid}}
*{box-sizing:border-box}
body{margin:0;background:var(--page);color:var(--text);font:15px/1.5 system-ui,"Segoe UI","DejaVu Sans",Arial,sans-serif}
main{max-width:1500px;margin:0 auto;padding:24px}
h1{font-size:1.7em;margin:0;color:var(--strong)}
h2{font-size:1.25em;margin:2em 0 .5em;color:var(--strong)}
h3{font-size:1.05em;margin:0 0 .3em;color:var(--strong)}
p{max-width:95ch;margin:.4em 0}
.soft{color:var(--soft)}
.tiles{display:grid;grid-template-columns:repeat(auto-fill,minmax(185px,1fr));gap:10px;margin:18px 0}
.tile{background:var(--panel);border-radius:6px;padding:10px 14px}
.tile b{display:block;font-size:1.18em;font-weight:600;color:var(--strong);font-variant-numeric:tabular-nums}
.tile span{color:var(--soft);font-size:.9em}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;margin:.5em 0}
th,td{padding:3px 14px 3px 0;text-align:right;border-bottom:1px solid var(--line);vertical-align:top}
th{color:var(--soft);font-weight:600}
th.word,td.word{text-align:left}
td.long{min-width:20em;max-width:48em}
section.photograph{background:var(--panel);border-radius:6px;padding:14px 16px;margin:14px 0}
.pictures{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,400px),1fr));gap:14px;margin-top:10px}
.pictures.small{grid-template-columns:repeat(auto-fill,minmax(min(100%,240px),1fr))}
figure{margin:0}
figure img{display:block;width:100%;height:auto;background:#464646;image-rendering:auto}
figure.small-source img{image-rendering:pixelated}
figcaption{font-size:.88em;color:var(--soft);margin-top:4px}
figcaption b{color:var(--text);font-weight:600}
.bar{display:flex;align-items:center;gap:6px;margin-top:3px}
.bar i{flex:1;height:9px;border:1px solid #777}
dl{max-width:115ch;display:grid;grid-template-columns:max-content 1fr;gap:4px 18px;margin:.5em 0}
dt{font-weight:600}
dd{margin:0;color:var(--soft)}
details{background:var(--panel);border-radius:6px;padding:8px 14px;margin:10px 0}
summary{cursor:pointer}
pre{overflow:auto;max-height:70vh;font-size:12px;line-height:1.35}
)";

/// Background of a colour bar.
std::string gradient(bool grey) {
  if (grey) return "linear-gradient(90deg,#000,#fff)";
  std::string css = "linear-gradient(90deg";
  for (int i = 0; i <= 32; ++i) {
    const Rgb8 c = cubehelix(i / 32.0);
    css += concat(",rgb(", int{c[0]}, ',', int{c[1]}, ',', int{c[2]}, ')');
  }
  return css + ")";
}

}  // namespace

std::string html_escape(std::string_view text) {
  // The JSON writer knows how to replace broken UTF-8; what it returns is a quoted literal, read back as text.
  const std::string whole = Json::parse(Json(std::string(text)).dump(-1, ' ', false, Json::error_handler_t::replace)).get<std::string>();
  std::string out;
  for (const char c : whole) {
    switch (c) {
      case '&': out += "&amp;"; break;
      case '<': out += "&lt;"; break;
      case '>': out += "&gt;"; break;
      case '"': out += "&quot;"; break;
      case '\'': out += "&#39;"; break;
      default: out += (static_cast<unsigned char>(c) < 32 && c != '\n' && c != '\t') || c == 127 ? ' ' : c;
    }
  }
  return out;
}

void table(Page& page, const std::vector<std::string>& headers, std::string_view words, const std::vector<std::vector<std::string>>& rows) {
  const auto style = [&](std::size_t i) -> std::string_view {
    const char kind = i < words.size() ? words[i] : 'n';
    return kind == 'w' ? "class=\"word\"" : kind == 'l' ? "class=\"word long\"" : "";
  };
  page.open("div", "class=\"scroll\"").open("table").open("thead").open("tr");
  for (std::size_t i = 0; i < headers.size(); ++i) page.element("th", headers[i], style(i));
  page.close("tr").close("thead").open("tbody");
  for (const auto& row : rows) {
    page.open("tr");
    for (std::size_t i = 0; i < row.size(); ++i) page.element("td", row[i], style(i));
    page.close("tr");
  }
  page.close("tbody").close("table").close("div");
}

std::string page_style() { return concat(kStyle, ".helix{background:", gradient(false), "}\n.grey{background:", gradient(true), "}\n"); }

std::string percent(double share, int digits) { return std::isfinite(share) ? format_number(100 * share, digits) + "\u00a0%" : "–"; }
std::string number(double v, int digits) { return std::isnan(v) ? "–" : std::isinf(v) ? "identical" : format_number(v, digits); }
std::string with_sd(double v, double sd) { return std::isfinite(v) ? number(v) + (sd > 0 ? "\u00a0±\u00a0" + format_number(sd, 2) : "") : "–"; }
std::string counted(std::uint64_t n) {
  std::string out;
  for (const char c : format_count(n)) c == ' ' ? out += "\u00a0" : out += c;
  return out;
}
std::string interval(double a, double b) { return std::isfinite(a) && std::isfinite(b) ? number(a) + " … " + number(b) : "–"; }

}  // namespace chiaro::tools
