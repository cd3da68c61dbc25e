#include "optimize/gloss_light.h"

#include <algorithm>
#include <cmath>

#include "optimize/light_samples.h"
#include "stream/base/parallel.h"

namespace chiaro::optimize {

GlossAngles gloss_angles(const Vec3f& place, const Vec3f& normal, const Viewpoint& from) {
  const Vec3f to_camera = (from.camera - place).normalized();
  GlossAngles angles;
  angles.camera = normal.dot(to_camera);
  if (!from.flash) return angles;
  const Vec3f to_flash = (*from.flash - place).normalized();
  angles.flash = normal.dot(to_flash);
  angles.half = normal.dot((to_flash + to_camera).normalized());
  return angles;
}

std::vector<float> send_out(const Proxy& proxy, const Transport& transport, const Viewpoint& from, const std::vector<float>& gathered, const Lights& lights, Observation& o) {
  std::vector<float> measured = o.radiosity;
  parallel_blocks(proxy.size(), 4096, [&](std::size_t b, std::size_t e) {
    for (std::size_t i = b; i < e; ++i) {
      if (!o.seen[i]) continue;
      LightSample s = sample_of(transport, o, gathered, i);
      s.angles = gloss_angles(proxy.position[i], proxy.normal[i], from);
      const double to_all = kMeanTransmission / coat_transmission(static_cast<double>(s.angles.camera)), flash = lights.flash_intensity * static_cast<double>(s.flash);
      const double by_flash = lights.gloss.reflectance * coat_reflection(static_cast<double>(s.angles.flash)), by_other = lights.gloss.reflectance * kMeanReflection;
      for (int c = 0; c < 3; ++c)
        o.radiosity[3 * i + static_cast<std::size_t>(c)] = static_cast<float>(to_all * body_radiosity(lights, s, c) + by_flash * flash + by_other * other_irradiance(lights, s, c));
    }
  });
  return measured;
}

std::vector<float> coated_albedo(const Gloss& gloss, std::vector<float> albedo) {
  const auto body = static_cast<float>(kMeanTransmission * kMeanTransmission), coat = static_cast<float>(gloss.reflectance * kMeanReflection);
  for (float& a : albedo) a = body * a + coat;
  return albedo;
}

double gloss_criterion(std::span<const LightSample> samples, const LightSolveOptions& plain, const Lights& without, const Lights& coated) {
  constexpr int kParameters = 2;
  return 2 * (light_misfit(samples, plain, coated, without) - light_misfit(samples, plain, without, without)) + kParameters * std::log(std::max(2.0, independent_residuals(samples, plain)));
}

}  // namespace chiaro::optimize
