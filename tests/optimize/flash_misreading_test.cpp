#include "optimize/flash_misreading.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <array>
#include <cmath>

#include "stream/base/rng.h"

namespace chiaro::optimize {
namespace {

using testing::HasSubstr;

constexpr double kNoise = 0.01;

/// A rough floor under four cameras that look down at it, each turned another way, with a flash beside each; the project has the offset as `written`.
struct Floor {
  Floor(const Vec3d& flash_in_camera, const Vec3d& written) : written_(written) {
    for (std::uint32_t i = 0; i < 300; ++i) {
      const auto u = uniform01x4(5, Purpose::kTest, i, 0);
      position.push_back(Vec3f(static_cast<float>(u[0]) * 1.5f, static_cast<float>(u[1]) * 1.5f, 0));
      normal.push_back(Vec3f(static_cast<float>(u[2]) - 0.5f, static_cast<float>(u[3]) - 0.5f, 1).normalized());
      for (std::uint32_t k = 0; k < kEyes.size(); ++k) add_sample(i, k, flash(k, flash_in_camera));
    }
  }

  std::optional<Misreading> found() const {
    const FlashUnder flash_under = [&](std::size_t k, const Mat3d& offset_from_written) { return flash(k, offset_from_written * written_); };
    LightSolveOptions options;
    options.flash_ln_mean = std::log(10.0);
    options.flash_ln_sd = 0.05;
    return find_misreading(samples, position, normal, flash_under, {}, options, lights());
  }

  static Lights lights() {
    Lights x;
    x.flash_intensity = 10;
    x.sky[0] = 0.3;
    return x;
  }

  std::vector<Vec3f> position, normal;
  std::vector<LightSample> samples;

 private:
  static constexpr std::array<std::array<double, 3>, 4> kEyes{{{0.1, 0.1, 1.2}, {1.2, 0.2, 1.0}, {0.3, 1.1, 0.7}, {0.9, 0.9, 1.5}}};

  static Vec3d flash(std::size_t k, const Vec3d& in_camera) {
    const Mat3d look_down = Vec3d(1, -1, -1).asDiagonal();
    const Mat3d turned(Eigen::AngleAxisd(1.3 * static_cast<double>(k), Vec3d::UnitZ()));
    return Vec3d(kEyes[k][0], kEyes[k][1], kEyes[k][2]) + turned * look_down * in_camera;
  }

  static double irradiance_by(const Vec3d& flash, const Vec3d& place, const Vec3d& normal) {
    const Vec3d to = flash - place;
    return std::max(0.0, normal.dot(to)) / std::pow(to.norm(), 3);
  }

  void add_sample(std::uint32_t i, std::uint32_t k, const Vec3d& true_flash) {
    const Vec3d place = position[i].cast<double>(), n = normal[i].cast<double>();
    LightSample s;
    s.group = i;
    s.photograph = k;
    s.flash = static_cast<float>(irradiance_by(flash(k, written_), place, n));
    s.sky[0] = 3;
    s.variance = static_cast<float>(kNoise * kNoise);
    const double h = lights().flash_intensity * irradiance_by(true_flash, place, n) + lights().sky[0] * 3;
    s.radiosity.fill(static_cast<float>(0.4 * h * std::exp(kNoise * normal01(6, Purpose::kTest, 10 * i + k, 0))));
    samples.push_back(s);
  }

  Vec3d written_;
};

const Vec3d kFlash(0.15, -0.22, 0.06);

TEST(FlashMisreading, AnOffsetThatIsRightIsLeftAlone) { EXPECT_FALSE(Floor(kFlash, kFlash).found()); }

TEST(FlashMisreading, EachUsualReadingIsRecognised) {
  for (const OffsetReading& reading : usual_readings()) {
    const Vec3d written = reading.offset_from_written.inverse() * kFlash;
    if (written.norm() > 10) continue;   // beyond the floor, which then lies in the dark
    const auto found = Floor(kFlash, written).found();
    ASSERT_TRUE(found) << reading.mistake;
    EXPECT_EQ(found->reading.mistake, reading.mistake);
    EXPECT_NEAR(found->scatter, kNoise, 0.3 * kNoise);
    EXPECT_GT(found->scatter_as_written, 2 * kNoise);
  }
}

/// It is somewhere else: none of the readings says where.
TEST(FlashMisreading, AFlashThatWasMeasuredWronglyIsNoMisreading) { EXPECT_FALSE(Floor(kFlash, kFlash + Vec3d(0.04, 0.02, 0)).found()); }

TEST(FlashMisreading, ShadowsOfTheWrittenFlashAreNotAsked) {
  Floor floor(kFlash, Vec3d(0.15, 0.22, -0.06));
  for (LightSample& s : floor.samples)
    if (s.group % 4 == 0) s.flash = 0;   // and lit all the same
  const auto found = floor.found();
  ASSERT_TRUE(found);
  EXPECT_NEAR(found->scatter, kNoise, 0.3 * kNoise);
}

TEST(FlashMisreading, AFewPlacesSayNothing) {
  Floor floor(kFlash, Vec3d(0.15, 0.22, -0.06));
  floor.samples.resize(80 * 4);
  EXPECT_FALSE(floor.found());
}

TEST(FlashMisreading, IsToldWhereItLeavesFarLessOrAsLittleAsLightThatVaries) {
  const auto told = [](double scatter, bool light_varies) { return is_worth_telling({usual_readings().front(), scatter, 0.02, 0.01}, light_varies); };
  EXPECT_TRUE(told(0.008, false));
  EXPECT_FALSE(told(0.009, false));
  EXPECT_TRUE(told(0.011, true));
  EXPECT_FALSE(told(0.013, true));
  EXPECT_FALSE(is_worth_telling({usual_readings().front(), 0.3, 0.6, 0.6}, false)) << "it does not explain the photographs either";
}

TEST(FlashMisreading, TheNoteSaysWhatToWrite) {
  const std::string note = misreading_note({usual_readings().front(), 0.011, 0.032, 0.02}, {0.13, 0.16, 0});
  EXPECT_THAT(note, HasSubstr("offset_in_camera = [0.13, 0.16, 0] looks as if it were written with y up and z backwards"));
  EXPECT_THAT(note, HasSubstr("by 1.1 %"));
  EXPECT_THAT(note, HasSubstr("by 3.2 % (2 % with all that was taken out)"));
  EXPECT_THAT(note, HasSubstr("write offset_in_camera = [0.13, -0.16, 0]"));
  EXPECT_THAT(misreading_note({{1000 * Mat3d::Identity(), "in m"}, 0.01, 0.03, 0.03}, {0.00013, -0.00016, 0}), HasSubstr("offset_in_camera = [0.00013, -0.00016, 0] looks as if it were written in m: with [0.13, -0.16, 0]"));
}

}  // namespace
}  // namespace chiaro::optimize
