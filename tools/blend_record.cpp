#include "tools/blend_record.h"

#include <algorithm>
#include <cmath>
#include <nlohmann/json.hpp>

#include "stream/base/error.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {
using Json = nlohmann::ordered_json;

Json json_of(const blend::PhotographStats& p, const std::string& name) {
  Json j{{"photograph", name}, {"samples", p.samples}, {"rejected", p.rejected}, {"gain", p.gain}, {"shift_px", nullptr}, {"disturbed", nullptr}};
  const blend::Inspection& i = p.inspection;
  if (i.correlation > 0) {
    j["shift_correlation"] = i.correlation;
    j["shift_sd_px"] = i.shift_sd_px;
  }
  if (i.shift_px) {
    j["shift_px"] = {i.shift_px->x(), i.shift_px->y()};
    j["shift_spread_px"] = i.shift_spread_px;
    j["shift_corrected_px"] = {p.alignment.shift_px.x(), p.alignment.shift_px.y()};
    j["trust"] = p.alignment.trust;
  }
  if (const auto& d = i.disturbed) j["disturbed"] = {{"x0", d->x0}, {"y0", d->y0}, {"x1", d->x1}, {"y1", d->y1}, {"outvoted", d->outvoted}, {"judged", d->judged}, {"chance", d->chance}};
  return j;
}

// In pixels of the picture, where the working image has cells of them.
void add_notes(const blend::PhotographStats& p, const std::string& name, int cell_px, Json& notes) {
  const double gain = std::cbrt(p.gain[0] * p.gain[1] * p.gain[2]);
  if (p.gain != std::array<double, 3>{1, 1, 1}) notes.push_back(concat(name, ": ", format_number(1 / gain, 4), " times as bright as the others show the same surface; corrected in the blend"));
  if (const auto& shift = p.inspection.shift_px; shift && (p.alignment.trust < 1 || p.alignment.shift_px != Vec2f::Zero()))
    notes.push_back(concat(name, ": shows the surface ", format_number(cell_px * static_cast<double>(shift->norm()), 2), " pixels beside where its camera puts it; ",
                           p.alignment.shift_px == Vec2f::Zero() ? "its weight is reduced" : "corrected in the blend"));
  if (const auto& d = p.inspection.disturbed)
    notes.push_back(concat(name, ": pixels ", cell_px * d->x0, " to ", cell_px * d->x1, " across and ", cell_px * d->y0, " to ", cell_px * d->y1, " down show something else than the other photographs; left out there"));
}

}  // namespace

std::string blend_record_json(const blend::BlendStats& stats, std::span<const blend::BlendPhotograph> photographs, std::span<const int> cells_px) {
  Json each = Json::array(), notes = Json::array();
  for (std::size_t k = 0; k < photographs.size(); ++k) {
    each.push_back(json_of(stats.photographs[k], photographs[k].name));
    add_notes(stats.photographs[k], photographs[k].name, cells_px[k], notes);
  }
  Json denoising;   // null: not asked for
  if (const auto& d = stats.denoising) {
    const double n = static_cast<double>(std::max<std::uint64_t>(1, d->points));
    denoising = {{"points", d->points}, {"points_changed", d->points_changed}, {"mean_sigma_before", d->sigma_before / n}, {"mean_sigma_after", d->sigma_after / n}};
  }
  const Json record{{"points", stats.points}, {"points_seen", stats.points_seen}, {"points_disputed", stats.points_disputed}, {"samples", stats.samples},
                    {"scatter", stats.scatter}, {"tolerance", stats.tolerance.by_class}, {"leaves", stats.leaves}, {"leaves_kept", stats.leaves_kept}, {"photographs_read", stats.photographs_read}, {"scratch_bytes", stats.scratch_bytes},
                    {"weights", {{"footprint", stats.window.reference_footprint}, {"low_radius", stats.window.low_radius}, {"border_px", stats.window.border_px}}},
                    {"denoising", denoising}, {"photographs", each}, {"notes", notes}};
  return record.dump();
}

}  // namespace chiaro::tools
