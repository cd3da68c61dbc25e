#include "tools/light_record_json.h"

namespace chiaro::tools {

using Json = nlohmann::ordered_json;

Json evidence_json(const std::vector<optimize::SkyEvidence>& evidence) {
  Json all = Json::array();
  for (const optimize::SkyEvidence& e : evidence) all.push_back({{"model", e.model}, {"parameters", e.parameters}, {"criterion", e.criterion}});
  return all;
}

Json error_json(const optimize::ErrorModel& e) {
  return {{"normal_rad", e.normal_rad}, {"registration_px", e.registration_px}, {"other_light", e.other_light}, {"spread", e.spread}, {"rest", e.rest}, {"estimated", e.estimated}};
}

namespace {

template <class Values>
Json list_of(const Values& values) {
  return std::vector<double>(values.data(), values.data() + values.size());
}

template <class Values>
void read_list(const Json& list, Values& values) {
  for (Eigen::Index i = 0; i < values.size(); ++i) values.data()[i] = list.at(static_cast<std::size_t>(i)).get<double>();
}

}  // namespace

Json falloff_json(const optimize::Falloff& f) {
  if (f.none()) return Json();
  Json j{{"of", f.of_lens() ? "lens" : "flash"}, {"kept_in_corners", optimize::kept_in_corners(f)}};
  j["coefficients"] = f.of_lens() ? list_of(f.lens) : list_of(f.flash);
  if (f.of_flash()) j["corner_sine"] = f.flash_corner_sine;
  j["covariance"] = list_of(f.covariance);
  return j;
}

optimize::Falloff falloff_from_json(const Json& j) {
  optimize::Falloff f;
  if (j.is_null()) return f;
  if (j.at("of") == "lens") {
    read_list(j.at("coefficients"), f.lens);
  } else {
    read_list(j.at("coefficients"), f.flash);
    f.flash_corner_sine = j.at("corner_sine");
  }
  read_list(j.at("covariance"), f.covariance);
  return f;
}

Json gloss_json(const optimize::Gloss& g) { return g.on ? Json{{"reflectance", g.reflectance}, {"roughness", g.roughness}} : Json(); }

Json covariance_json(const optimize::LightSolution& s) {
  Json covariance = Json::array();
  for (Eigen::Index i = 0; i < s.covariance.rows(); ++i) {
    Json row = Json::array();
    for (Eigen::Index j = 0; j < s.covariance.cols(); ++j) row.push_back(s.covariance(i, j));
    covariance.push_back(row);
  }
  return covariance;
}

Json light_json(const optimize::AcquisitionResult& r) {
  Json lights = Json::array();
  for (const optimize::LightSolution& s : r.lights) {
    lights.push_back({{"flash_intensity", s.lights.flash_intensity}, {"sky", s.lights.sky}, {"sky_colour", s.lights.sky_colour}, {"bounce", s.lights.bounce},
                      {"gloss", gloss_json(s.lights.gloss)}, {"sky_terms", s.sky_terms}, {"sky_coloured", s.sky_colour}, {"floor", s.lights.floor}, {"floor_albedo", s.lights.floor_albedo}, {"covariance", covariance_json(s)}, {"ambient_open", s.ambient_open}, {"scatter", s.scatter},
                      {"groups", s.groups}, {"samples", s.samples}, {"iterations", s.iterations}, {"converged", s.converged}, {"scale_known", s.scale_known}});
  }
  Json errors = Json::array();
  for (const optimize::ErrorModel& e : r.errors) errors.push_back(error_json(e));
  Json own = Json::array();
  for (const optimize::OwnLight& o : r.own_lights) own.push_back({o.ambient, o.exposure, o.ambient_ln_sd, o.exposure_ln_sd, o.unlike, o.unlike_ambient});
  return {{"gloss_evidence", r.gloss_evidence ? Json(*r.gloss_evidence) : Json()}, {"sky_evidence", evidence_json(r.sky_evidence)}, {"lights", lights}, {"errors", errors}, {"light_of_photograph", r.light_of_photograph}, {"own_lights", own}, {"exposure_spread", r.spread[optimize::kExposure]}, {"ambient_spread", r.spread[optimize::kAmbient]}, {"strangers", r.strangers}, {"flash_shift", list_of(r.pattern.flash_shift)}, {"falloff", falloff_json(r.pattern.falloff)}, {"proxy_surfels", r.proxy_surfels}, {"proxy_seen", r.proxy_seen}, {"back_share", r.back_share},
          {"outer_iterations", r.outer_iterations}, {"last_change", r.last_change}, {"sky_model", r.sky_model}, {"notes", r.notes}};
}

optimize::AcquisitionResult lights_from_json(const Json& j) {
  optimize::AcquisitionResult r;
  for (const Json& l : j["lights"]) {
    optimize::LightSolution s;
    s.lights.flash_intensity = l["flash_intensity"];
    s.lights.sky = l["sky"];
    s.lights.sky_colour = l["sky_colour"];
    if (const Json& g = l["gloss"]; !g.is_null()) s.lights.gloss = {true, g["reflectance"], g["roughness"]};
    s.sky_terms = l["sky_terms"];
    s.sky_colour = l["sky_coloured"];
    s.lights.floor = l["floor"];
    s.lights.floor_albedo = l["floor_albedo"];
    s.lights.bounce = l["bounce"];
    const auto n = static_cast<Eigen::Index>(l["covariance"].size());
    s.covariance.resize(n, n);
    for (Eigen::Index i = 0; i < n; ++i)
      for (Eigen::Index k = 0; k < n; ++k) s.covariance(i, k) = l["covariance"][static_cast<std::size_t>(i)][static_cast<std::size_t>(k)];
    s.scatter = l["scatter"];
    s.groups = l["groups"];
    s.samples = l["samples"];
    s.iterations = l["iterations"];
    s.converged = l["converged"];
    s.scale_known = l["scale_known"];
    s.ambient_open = l["ambient_open"];
    r.lights.push_back(s);
  }
  if (const Json& e = j["gloss_evidence"]; !e.is_null()) r.gloss_evidence = e.get<double>();
  for (const Json& e : j["sky_evidence"]) r.sky_evidence.push_back({e["model"].get<std::string>(), e["parameters"].get<int>(), e["criterion"].get<double>()});
  for (const Json& e : j["errors"]) r.errors.push_back({e["normal_rad"], e["registration_px"], e["other_light"], e["spread"], e["rest"], e["estimated"]});
  r.light_of_photograph = j["light_of_photograph"].get<std::vector<std::size_t>>();
  for (const Json& o : j["own_lights"]) r.own_lights.push_back({o[0], o[1], o[2], o[3], o[4], o[5]});
  r.spread = {j["ambient_spread"], j["exposure_spread"]};
  r.strangers = j["strangers"].get<std::vector<bool>>();
  read_list(j["flash_shift"], r.pattern.flash_shift);
  r.pattern.falloff = falloff_from_json(j["falloff"]);
  r.proxy_surfels = j["proxy_surfels"];
  r.proxy_seen = j["proxy_seen"];
  r.back_share = j["back_share"];
  r.outer_iterations = j["outer_iterations"];
  r.last_change = j["last_change"];
  r.sky_model = j["sky_model"];
  r.notes = j["notes"].get<std::vector<std::string>>();
  return r;
}

}  // namespace chiaro::tools
