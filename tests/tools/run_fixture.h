/// A run folder made by hand: small photographs with known values, as `chiaro run` leaves them.
#pragma once
#include <array>
#include <cmath>
#include <filesystem>
#include <functional>
#include <nlohmann/json.hpp>
#include <string>
#include <string_view>
#include <vector>

#include "stream/base/file.h"
#include "stream/photo/image_io.h"
#include "stream/photo/raster.h"
#include "tools/camera_record.h"
#include "tools/run_folder.h"

namespace chiaro::tools {

struct RunFixture {
  using Json = nlohmann::ordered_json;
  ScratchFolder scratch;
  RunFolder folder{scratch.path() / "made.out"};
  int width = 40, height = 30;
  std::string method = "joint";
  std::vector<std::string> keys{"photo_00", "photo_01"};
  /// Radiance of channel c at a pixel, and what the prediction leaves of it.
  std::function<float(int x, int y, int c)> photo = [](int, int, int) { return 0.5f; };
  std::function<float(int x, int y, int c)> residual = [](int, int, int) { return 0.05f; };
  /// The planes, cameras and record that pictures of the weights are drawn from. Pixels in the left half are twice as fine as those in the right.
  bool weighed = false;
  /// Pixels with an albedo.
  std::function<bool(int x, int y)> solved = [](int x, int) { return x >= 10; };

  void write() {
    for (const std::string& key : keys) write_photograph(key);
    Json project{{"file", "made.toml"}, {"project", {{"name", "made <by> \"hand\" & more"}}}, {"solve", {{"method", method}}}, {"export", {{{"file", "albedo.ply"}, {"fill", false}}}}};
    Json acquisition{{"name", "day1"}, {"role", "flash"}, {"photographs", Json::array()}};
    for (const std::string& key : keys) acquisition["photographs"].push_back({{"key", key}, {"file", "/somewhere/" + key + ".exr"}});
    acquisition["photographs"].push_back({{"key", "photo_99"}, {"file", "/somewhere/photo_99.exr"}});
    project["acquisition"] = Json::array({acquisition});
    make_folder(folder.work());
    write_text(folder.project(), project.dump());
    write_text(folder.lights(), lights().dump());
    Json whole = record();
    if (weighed) {
      whole["blending"]["weights"] = {{"footprint", 0.05}, {"low_radius", 0.4}, {"border_px", 12}};
      std::vector<PhotographCamera> cameras;
      for (const std::string& key : keys) cameras.push_back({"day1", camera(key), {}});
      write_camera_record(folder.cameras(), cameras);
    }
    write_text(folder.record(), whole.dump());
    for (const char* task : {"ingest", "gather/day1", "light/day1", "blend", "export/albedo.ply"}) mark(task, 2);
    for (const std::string& key : keys)
      for (const char* stage : {"develop/", "raycast/", "albedo/", "residual/"}) mark(stage + key, 0.5);
    write_text(folder.root / "albedo.ply", std::string(1000, 'p'));
  }

  stream::Camera camera(const std::string& key) const {
    stream::Camera c;
    c.photograph = key;
    c.lens.width_px = width;
    c.lens.height_px = height;
    c.lens.fx = c.lens.fy = width;
    c.lens.cx = width / 2.0;
    c.lens.cy = height / 2.0;
    return c;
  }

  void mark(std::string task, double seconds) const {
    const Json marker{{"task", task}, {"key", "0123"}, {"seconds", seconds}, {"info", Json::object()}};
    for (char& c : task)
      if (c == '/') c = '.';
    make_folder(folder.tasks());
    write_text(folder.tasks() / (task + ".json"), marker.dump());
  }

  Json light(double flash) const {
    return {{"flash_intensity", flash}, {"flash_intensity_sd", 0.75}, {"ambient", 0.125}, {"ambient_sd", 0.0625}, {"bounce", 1.0},
            {"allowed", {{"flash_intensity", {flash - 1.5, flash + 1.5}}}}, {"absolute_scale", "calibrated"}};
  }

  Json lights() const {
    Json a{{"acquisition", "day1"}, {"method", method}, {"how", "by hand"}};
    if (method == "joint") {
      a.update(light(31.25));
      a["calibrated_range"] = {25.0, 34.0};
      a["references"] = 0;
    } else if (method != "none") {
      for (std::size_t k = 0; k < keys.size(); ++k) {
        Json one{{"photograph", keys[k]}};
        one.update(light(30.0 + static_cast<double>(k)));
        a["photographs"].push_back(one);
      }
    }
    return {{"acquisitions", {a}}};
  }

  Json record() const {
    return {{"version", "9.8.7"}, {"started", "2001-02-03T04:05:06Z"}, {"seconds", 12.5}, {"exit", 3}, {"memory", {{"limit_bytes", 1u << 30}, {"peak_bytes", 300u << 20}}},
            {"stages", {{{"name", "ingest"}, {"seconds", 0}, {"reused", true}}}},
            {"counts", {{"points_in", 123456}, {"points_out", 123450}, {"points_seen", 100000}, {"points_unseen", 23450}}},
            {"left_out", {{{"kind", "photograph"}, {"name", "photo_99"}, {"reason", "no camera in <sparse>"}, {"amount", 1}}}}, {"notes", {"a note & its end"}}};
  }

  void write_photograph(const std::string& key) const {
    const std::size_t n = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
    make_folder(folder.photograph(key));
    make_folder(folder.pictures(key));
    std::array<std::vector<float>, 3> plane, own;
    std::vector<float> left(3 * n), albedo(3 * n), light(3 * n), sigma(n), coverage(n, 1), edge(n, 64);
    std::vector<std::uint8_t> mask(n, 1);
    for (auto* p : {&plane, &own})
      for (auto& v : *p) v.assign(n, NAN);
    for (std::size_t i = 0; i < n; ++i) {
      const int x = static_cast<int>(i) % width, y = static_cast<int>(i) / width;
      const bool use = solved(x, y);
      if (x == 0) mask[i] = 0;
      for (std::size_t c = 0; c < 3; ++c) {
        plane[c][i] = photo(x, y, static_cast<int>(c));
        if (!use) continue;
        own[c][i] = albedo[3 * i + c] = 0.4f;
        left[3 * i + c] = residual(x, y, static_cast<int>(c));
        light[3 * i + c] = std::array{0.7f, 0.2f, 0.1f}[c];
      }
      if (use) sigma[i] = 0.02f;
    }
    using stream::PlaneType;
    stream::RasterWriter radiance(folder.radiance(key), width, height, {{"r", PlaneType::kF32}, {"g", PlaneType::kF32}, {"b", PlaneType::kF32}, {"mask", PlaneType::kU8}});
    std::vector<stream::PlaneInfo> geometry{{"coverage", PlaneType::kF32}, {"edge", PlaneType::kF32}}, values{{"r", PlaneType::kF32}, {"g", PlaneType::kF32}, {"b", PlaneType::kF32}};
    const std::vector<std::pair<const char*, float>> seen_from_the_front{{"depth", 2.0f}, {"nx", 0.0f}, {"ny", 0.0f}, {"nz", -1.0f}, {"radius", 0.05f}, {"cosv", 1.0f}, {"footprint", 0.05f}};
    if (weighed) {
      for (const auto& [name, value] : seen_from_the_front) geometry.push_back({name, PlaneType::kF32});
      values.push_back({"sigma", PlaneType::kF32});
    }
    stream::RasterWriter gbuffer(folder.gbuffer(key), width, height, geometry);
    stream::RasterWriter own_albedo(folder.albedo(key), width, height, values);
    if (weighed) {
      for (const auto& [name, value] : seen_from_the_front) {
        std::vector<float> plane_of(n, value);
        if (std::string_view(name) == "footprint")
          for (std::size_t i = 0; i < n; ++i) plane_of[i] = static_cast<int>(i) % width < width / 2 ? 0.025f : 0.05f;
        gbuffer.write_rows<float>(name, 0, plane_of);
      }
      own_albedo.write_rows<float>("sigma", 0, sigma);
    }
    const char* names[] = {"r", "g", "b"};
    for (std::size_t c = 0; c < 3; ++c) {
      radiance.write_rows<float>(names[c], 0, plane[c]);
      own_albedo.write_rows<float>(names[c], 0, own[c]);
    }
    radiance.write_rows<std::uint8_t>("mask", 0, mask);
    gbuffer.write_rows<float>("coverage", 0, coverage);
    gbuffer.write_rows<float>("edge", 0, edge);
    radiance.commit();
    gbuffer.commit();
    own_albedo.commit();
    const auto pictures = folder.pictures(key);
    stream::write_exr(pictures / "albedo.exr", width, height, {"R", "G", "B"}, albedo, true);
    stream::write_exr(pictures / "residual.exr", width, height, {"R", "G", "B"}, left, false);
    stream::write_exr(pictures / "sigma.exr", width, height, {"Y"}, sigma, true);
    if (method != "none") stream::write_exr(pictures / "light.exr", width, height, {"direct", "indirect", "ambient"}, light, true);
  }
};

}  // namespace chiaro::tools
