#include "optimize/light_checks.h"

#include <gtest/gtest.h>

#include <cmath>

namespace chiaro::optimize {
namespace {

LightSolution solution(double flash, double ln_sd) {
  LightSolution s;
  s.lights.flash_intensity = flash;
  s.covariance = Eigen::MatrixXd::Zero(2, 2);
  s.covariance(0, 0) = ln_sd * ln_sd;
  s.scale_known = true;
  return s;
}

const std::array<double, 2> kRange{std::exp(2 - 0.2), std::exp(2 + 0.2)};   // ln: 2 +- 0.1

// Two readings of equal precision, 2 +- 0.1 and 1.5 +- 0.1, make 1.75 +- 0.0707; they differ by 0.5 where sqrt(2) * 0.1 is expected.
TEST(RangeEvidence, IsWhatThePosteriorAddsToTheRange) {
  const RangeEvidence e = range_evidence(kRange, solution(std::exp(1.75), 0.1 / std::sqrt(2.0)));
  EXPECT_NEAR(e.ln_flash, 1.5, 1e-9);
  EXPECT_NEAR(e.sd, 0.1, 1e-9);
  EXPECT_NEAR(e.deviations, -0.5 / (0.1 * std::sqrt(2.0)), 1e-9);
}

TEST(RangeEvidence, PhotographsThatSayNothingContradictNothing) {
  const RangeEvidence e = range_evidence(kRange, solution(std::exp(2.0), 0.1));
  EXPECT_NEAR(e.deviations, 0, 1e-9);
  EXPECT_EQ(e.sd, 0);
}

/// In the ratio of flash to ambient light given.
LightSample sample(float flash, float sky, float radiosity) {
  LightSample s;
  s.flash = flash;
  s.sky[0] = sky;
  s.radiosity = {radiosity, radiosity, radiosity};
  return s;
}

TEST(GuessAmbient, MakesTheBrightestReflectFourFifths) {
  std::vector<LightSample> samples;
  for (int i = 0; i < 100; ++i) samples.push_back(sample(0, 3, 0.01f * static_cast<float>(i)));
  EXPECT_NEAR(guess_ambient(samples), 0.94 / 3 / 0.8, 0.01);
  EXPECT_EQ(guess_ambient({}), 0);
}

TEST(FlashReaches, CountsPhotographsTakenWithIt) {
  EXPECT_FALSE(flash_reaches(std::vector<LightSample>{sample(0, 3, 1)}));
  EXPECT_TRUE(flash_reaches(std::vector<LightSample>{sample(0, 3, 1), sample(0.1f, 3, 1)}));
  LightSample dark = sample(0.1f, 3, 1);
  dark.flash_photograph = false;
  EXPECT_FALSE(flash_reaches(std::vector<LightSample>{dark}));
}

TEST(LightNotes, AreSilentWhereAllIsWell) {
  AcquisitionInput input;
  input.intensity_range = kRange;
  EXPECT_TRUE(light_notes(input, std::vector<LightSample>{sample(1, 3, 1)}, solution(std::exp(2.05), 0.05), "photo", false, true).empty());
}

TEST(LightNotes, NameARangeThatIsContradicted) {
  AcquisitionInput input;
  input.intensity_range = kRange;
  const auto notes = light_notes(input, std::vector<LightSample>{sample(1, 3, 1)}, solution(std::exp(2.4), 0.02), "photo", false, true);
  ASSERT_EQ(notes.size(), 1u);
  EXPECT_NE(notes[0].find("calibrated range of 6.05 to 9.03 W/sr"), std::string::npos) << notes[0];
}

TEST(LightNotes, NameAFlashThatGivesNothing) {
  LightSolution s = solution(7, 0.05);
  s.lights.sky[0] = 1000;
  const auto notes = light_notes({}, std::vector<LightSample>{sample(1, 3, 1)}, s, "photo", false, true);
  ASSERT_EQ(notes.size(), 1u);
  EXPECT_NE(notes[0].find("did it fire?"), std::string::npos) << notes[0];
}

}  // namespace
}  // namespace chiaro::optimize
