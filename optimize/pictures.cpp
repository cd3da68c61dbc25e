#include "optimize/pictures.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>

#include "optimize/albedo.h"
#include "optimize/photo_band.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/photo/image_io.h"

namespace chiaro::optimize {
namespace {

constexpr int kBandRows = 128;
constexpr std::size_t kCachedChunks = 64;   ///< 64 chunks of 65 536 surfels: 64 MiB at most

float or_zero(float v) { return std::isfinite(v) ? v : 0.0f; }

/// Albedo of surfels by chunk, the last few chunks kept.
class AlbedoCache {
 public:
  AlbedoCache(const stream::Store& store, const stream::Layer& layer) : store_(store), layer_(layer) {}
  const Vec3f& at(const SurfelId& id) {
    auto it = chunks_.find(id.chunk);
    if (it == chunks_.end()) {
      if (chunks_.size() >= kCachedChunks) chunks_.erase(oldest());
      it = chunks_.emplace(id.chunk, Entry{stream::read_albedo(layer_, store_, id.chunk).albedo, 0}).first;
    }
    it->second.used = ++clock_;
    return it->second.albedo.at(id.slot);
  }

 private:
  struct Entry {
    std::vector<Vec3f> albedo;
    std::uint64_t used;
  };
  std::map<std::uint32_t, Entry>::iterator oldest() {
    return std::min_element(chunks_.begin(), chunks_.end(), [](const auto& a, const auto& b) { return a.second.used < b.second.used; });
  }
  const stream::Store& store_;
  const stream::Layer& layer_;
  std::map<std::uint32_t, Entry> chunks_;
  std::uint64_t clock_ = 0;
};

}  // namespace

void write_albedo_pictures(const std::filesystem::path& raster, const std::filesystem::path& folder) {
  make_folder(folder);
  const stream::RasterReader in(raster);
  const int width = in.width(), height = in.height();
  stream::ExrWriter albedo(folder / "albedo.exr", width, height, {"R", "G", "B"}, true), sigma(folder / "sigma.exr", width, height, {"Y"}, true),
      light(folder / "light.exr", width, height, {"direct", "indirect", "ambient"}, true);
  for (int y0 = 0; y0 < height; y0 += kBandRows) {
    const int rows = std::min(kBandRows, height - y0);
    const auto write3 = [&](stream::ExrWriter& out, const char* a, const char* b, const char* c) {
      const auto va = in.rows<float>(a, y0, rows), vb = in.rows<float>(b, y0, rows), vc = in.rows<float>(c, y0, rows);
      std::vector<float> v(3 * va.size());
      for (std::size_t i = 0; i < va.size(); ++i) {
        v[3 * i] = or_zero(va[i]);
        v[3 * i + 1] = or_zero(vb[i]);
        v[3 * i + 2] = or_zero(vc[i]);
      }
      out.write_rows(rows, v);
    };
    write3(albedo, "r", "g", "b");
    write3(light, "direct", "indirect", "ambient");
    const auto independent = in.rows<float>("sigma", y0, rows), shared = in.rows<float>("shared", y0, rows);
    std::vector<float> s(independent.size());
    for (std::size_t i = 0; i < s.size(); ++i) s[i] = or_zero(std::hypot(independent[i], shared[i]));
    sigma.write_rows(rows, s);
  }
  albedo.commit();
  sigma.commit();
  light.commit();
}

void colour_as_albedo(const ObserveInput& photograph, const std::filesystem::path& raster, Reporter& report) {
  const stream::RasterReader radiance(photograph.radiance), gbuffer(photograph.gbuffer);
  const int width = gbuffer.width(), height = gbuffer.height();
  stream::RasterWriter out(raster, width, height, albedo_planes());
  for (int y0 = 0; y0 < height; y0 += kBandRows) {
    report.check();
    const int rows = std::min(kBandRows, height - y0);
    const PhotoBand band = read_band(radiance, gbuffer, y0, rows);
    const std::size_t n = band.depth.size();
    std::vector<float> r(n, std::numeric_limits<float>::quiet_NaN()), g = r, b = r, sigma = r, shared = r, zero(n, 0.0f);
    for (std::size_t i = 0; i < n; ++i) {
      if (band.mask[i] != 1 || !(band.depth[i] > 0)) continue;
      r[i] = band.r[i];
      g[i] = band.g[i];
      b[i] = band.b[i];
      const double z = std::max(1e-6, static_cast<double>(band.g[i]));
      const double variance = photograph.noise.variance(z);
      sigma[i] = static_cast<float>(std::sqrt(variance / (z * z) + 1e-4));   // one per cent that nothing removes
      shared[i] = 0;
    }
    out.write_rows<float>("r", y0, r);
    out.write_rows<float>("g", y0, g);
    out.write_rows<float>("b", y0, b);
    out.write_rows<float>("sigma", y0, sigma);
    out.write_rows<float>("shared", y0, shared);
    for (const char* name : {"direct", "indirect", "ambient"}) out.write_rows<float>(name, y0, zero);
  }
  out.commit();
}

double write_residual(const stream::Store& store, const stream::Layer& layer, const ObserveInput& photograph, const std::filesystem::path& albedo_raster,
                      const std::filesystem::path& picture, Reporter& report) {
  const stream::RasterReader radiance(photograph.radiance), gbuffer(photograph.gbuffer), albedo(albedo_raster);
  const int width = gbuffer.width(), height = gbuffer.height();
  AlbedoCache cache(store, layer);
  stream::ExrWriter out(picture, width, height, {"R", "G", "B"}, true);
  double squares = 0;
  std::uint64_t count = 0;
  const char* names[] = {"r", "g", "b"};
  for (int y0 = 0; y0 < height; y0 += kBandRows) {
    report.check();
    const int rows = std::min(kBandRows, height - y0);
    const auto chunk = gbuffer.rows<std::uint32_t>("chunk", y0, rows);
    const auto slot = gbuffer.rows<std::uint16_t>("slot", y0, rows);
    std::vector<float> values(3 * chunk.size(), 0.0f);
    std::array<std::vector<float>, 3> own, photo;
    for (std::size_t c = 0; c < 3; ++c) {
      own[c] = albedo.rows<float>(names[c], y0, rows);
      photo[c] = radiance.rows<float>(names[c], y0, rows);
    }
    for (std::size_t i = 0; i < chunk.size(); ++i) {
      if (chunk[i] == SurfelId::kNone) continue;
      const Vec3f& blended = cache.at({chunk[i], slot[i]});
      for (std::size_t c = 0; c < 3; ++c) {
        // The irradiance is photograph / own albedo, so the prediction is photograph * blended / own: the light model cancels.
        if (!(own[c][i] > 0) || !std::isfinite(blended[static_cast<Eigen::Index>(c)])) continue;
        const float relative = 1 - blended[static_cast<Eigen::Index>(c)] / own[c][i];
        values[3 * i + c] = std::clamp(photo[c][i] * relative, -60000.0f, 60000.0f);
        if (c == 1) {
          squares += static_cast<double>(std::min(relative * relative, 1.0f));
          ++count;
        }
      }
    }
    out.write_rows(rows, values);
  }
  out.commit();
  return count > 0 ? std::sqrt(squares / static_cast<double>(count)) : 0;
}

}  // namespace chiaro::optimize
