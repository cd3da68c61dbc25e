#include "optimize/flash_place.h"

#include <gtest/gtest.h>

#include <cmath>

#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

/// A rough floor under four flashes; camera axes are the world's. Samples hold the flash at its said place, photographs were taken with it `shift` beside.
std::vector<LightSample> samples_with(const Vec3d& shift, const Lights& lights, double noise = 0.01) {
  const std::vector<Vec3d> flashes{{0, 0, 1.2}, {1.2, 0.2, 1.0}, {0.3, 1.1, 0.7}, {0.9, 0.9, 1.5}};
  std::vector<LightSample> samples;
  for (std::uint32_t i = 0; i < 1500; ++i) {
    const auto u = uniform01x4(3, Purpose::kTest, i, 0);
    const Vec3d place(static_cast<double>(u[0]) * 1.5, static_cast<double>(u[1]) * 1.5, 0);
    const Vec3d normal = Vec3d(static_cast<double>(u[2]) - 0.5, static_cast<double>(u[3]) - 0.5, 1).normalized();
    for (std::uint32_t k = 0; k < flashes.size(); ++k) {
      const Vec3d to = flashes[k] - place;
      const double cosine = normal.dot(to.normalized());
      if (cosine < 0.1) continue;
      LightSample s;
      s.group = i;
      s.photograph = k;
      s.flash = static_cast<float>(cosine / to.squaredNorm());
      s.flash_by_shift = ((normal / cosine - 3 * to.normalized()) / to.norm()).cast<float>();
      s.sky[0] = 3;
      const double h = lights.flash_intensity * static_cast<double>(s.flash) * flash_factor(place, normal, flashes[k], flashes[k] + shift) + lights.sky[0] * 3;
      const double error = std::exp(noise * normal01(4, Purpose::kTest, 10 * i + k, 0));
      s.radiosity.fill(static_cast<float>(0.4 * h * error));
      samples.push_back(s);
    }
  }
  return samples;
}

Lights lights() {
  Lights x;
  x.flash_intensity = 10;
  x.sky[0] = 0.2;
  return x;
}

TEST(FlashPlace, IsFoundWhereTheFlashIsNotWhereItIsSaidToBe) {
  const Vec3d shift(0.02, -0.01, 0.015);
  const FlashPlace found = find_flash_place(samples_with(shift, lights()), lights(), Vec3d::Zero(), 2000);
  EXPECT_LE((found.shift_in_camera - shift).norm(), 0.003) << found.shift_in_camera.transpose();
  EXPECT_GT(found.chi2, 20);
  EXPECT_LT(found.after, found.before);
}

TEST(FlashPlace, IsLeftAloneWhereItIsRight) {
  const FlashPlace found = find_flash_place(samples_with(Vec3d::Zero(), lights()), lights(), Vec3d::Zero(), 2000);
  EXPECT_LE(found.shift_in_camera.norm(), 0.001);
  EXPECT_LT(found.chi2, 3);
}

TEST(FlashPlace, LightsThatAreALittleOffDoNotPassForAShift) {
  Lights off = lights();
  off.flash_intensity *= 1.05;
  off.sky[0] *= 0.9;
  EXPECT_LE(find_flash_place(samples_with(Vec3d::Zero(), lights()), off, Vec3d::Zero(), 2000).shift_in_camera.norm(), 0.002);
}

TEST(FlashPlace, ThePriorPullsAtTheWholeShift) {
  const std::vector<LightSample> samples = samples_with(Vec3d::Zero(), lights());
  FlashPlaceOptions tight;
  tight.prior_sd = 1e-5;
  EXPECT_LE(find_flash_place(samples, lights(), Vec3d(0.01, 0, 0), 2000, tight).shift_in_camera.norm(), 0.001) << "back to where it is said to be";
  EXPECT_NEAR(find_flash_place({}, lights(), Vec3d(0.01, 0, 0), 2000).shift_in_camera.x(), 0.01, 1e-12);
}

TEST(FlashFactor, IsFalloffAndCosine) {
  EXPECT_NEAR(flash_factor(Vec3d::Zero(), Vec3d(0, 0, 1), Vec3d(0, 0, 1), Vec3d(0, 0, 1.1)), 1 / 1.21, 1e-12);
  EXPECT_NEAR(flash_factor(Vec3d::Zero(), Vec3d(0, 0, 1), Vec3d(0, 0, 1), Vec3d(1, 0, 1)), std::max(0.5, 1 / std::pow(2, 1.5)), 1e-12);
  EXPECT_EQ(flash_factor(Vec3d::Zero(), Vec3d(0, 0, 1), Vec3d(0, 0, -1), Vec3d(0, 0, 1)), 1);
}

}  // namespace
}  // namespace chiaro::optimize
