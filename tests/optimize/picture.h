/// A photograph and its G-buffer as files, each plane a function of the pixel: what tests of single pixels read.
#pragma once
#include <filesystem>
#include <functional>
#include <map>
#include <string>
#include <vector>

#include "stream/photo/raster.h"

namespace chiaro::optimize::tests {

using Plane = std::function<float(int x, int y)>;

inline Plane even(double value) {
  return [v = static_cast<float>(value)](int, int) { return v; };
}

inline void write_planes(const std::filesystem::path& path, int width, int height, const std::vector<std::string>& floats, const std::map<std::string, Plane>& planes, const Plane* mask = nullptr) {
  std::vector<stream::PlaneInfo> infos;
  for (const std::string& name : floats) infos.push_back({name, stream::PlaneType::kF32});
  if (mask) infos.push_back({"mask", stream::PlaneType::kU8});
  stream::RasterWriter out(path, width, height, infos);
  for (const std::string& name : floats) {
    std::vector<float> values;
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x) values.push_back(planes.at(name)(x, y));
    out.write_rows<float>(name, 0, values);
  }
  if (mask) {
    std::vector<std::uint8_t> values;
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x) values.push_back(static_cast<std::uint8_t>((*mask)(x, y)));
    out.write_rows<std::uint8_t>("mask", 0, values);
  }
  out.commit();
}

/// `planes` holds r, g, b, mask, and the float planes of surfels/gbuffer.h that are read.
inline void write_picture(const std::filesystem::path& radiance, const std::filesystem::path& gbuffer, int width, int height, const std::map<std::string, Plane>& planes) {
  write_planes(radiance, width, height, {"r", "g", "b"}, planes, &planes.at("mask"));
  write_planes(gbuffer, width, height, {"depth", "nx", "ny", "nz", "radius", "footprint", "cosv", "coverage", "edge", "flash", "spread", "lit", "shadow"}, planes);
}

}  // namespace chiaro::optimize::tests
