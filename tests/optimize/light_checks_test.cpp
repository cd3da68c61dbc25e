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

TEST(LightNotes, SayThatPhotographsDisagree) {
  LightSolution s = solution(7, 0.05);
  const std::vector<LightSample> samples{sample(1, 3, 1)};
  s.scatter = 0.1;
  EXPECT_TRUE(light_notes({}, samples, s, "photo", false, true).empty());
  s.scatter = 0.4;
  const auto notes = light_notes({}, samples, s, "photo", false, true);
  ASSERT_EQ(notes.size(), 1u);
  EXPECT_NE(notes[0].find("differ by 40 %"), std::string::npos) << notes[0];
  EXPECT_EQ(light_notes({}, samples, s, "photo", true, true).size(), 1u) << "pairs of places within one photograph scatter anyway";
}

TEST(LightNotes, NameAFlashThatGivesNothing) {
  LightSolution s = solution(7, 0.05);
  s.lights.sky[0] = 1000;
  const auto notes = light_notes({}, std::vector<LightSample>{sample(1, 3, 1)}, s, "photo", false, true);
  ASSERT_EQ(notes.size(), 1u);
  EXPECT_NE(notes[0].find("did it fire?"), std::string::npos) << notes[0];
}

TEST(LightNotes, SayHowLittleOnePhotographTells) {
  LightSolution s = solution(8, 0.12);
  s.lights.sky[0] = 0.5;
  s.sky_terms = 1;
  s.covariance(1, 1) = 0.01;   // 0.1 of 0.5
  const auto notes = light_notes({}, std::vector<LightSample>{sample(1, 3, 1)}, s, "photo", true, true);
  ASSERT_EQ(notes.size(), 1u);
  EXPECT_NE(notes[0].find("flash known to 12 %, ambient light to 20 %"), std::string::npos) << notes[0];
  EXPECT_TRUE(light_notes({}, std::vector<LightSample>{sample(1, 3, 1)}, s, "photo", false, true).empty());
}

TEST(LightNotes, SayWhereTheScaleIsOpen) {
  LightSolution s = solution(8, 0.35);
  s.scale_known = false;
  const auto notes = light_notes({}, std::vector<LightSample>{sample(1, 3, 1)}, s, "photo", false, true);
  ASSERT_EQ(notes.size(), 1u);
  EXPECT_NE(notes[0].find("up to one factor (flash known to 35 %)"), std::string::npos) << notes[0];
  const auto unlit = light_notes({}, std::vector<LightSample>{sample(0, 3, 1)}, s, "photo", false, false);
  ASSERT_EQ(unlit.size(), 1u);
  EXPECT_NE(unlit[0].find("the brightest surfaces reflect 80 %"), std::string::npos) << unlit[0];
}

// The flash of an acquisition gives a tenth at most: little, but it fired. Photographs without one do not count.
TEST(LightNotes, AFaintFlashHasFired) {
  LightSolution s = solution(7, 0.05);
  s.lights.sky[0] = 21;   // of 3 each: 63
  EXPECT_TRUE(light_notes({}, std::vector<LightSample>{sample(1, 3, 1)}, s, "photo", false, true).empty());
  std::vector<LightSample> samples(99, sample(1, 0.1f, 1));
  for (LightSample& dark : samples) dark.flash_photograph = false;
  samples.push_back(sample(0.01f, 3, 1));
  EXPECT_EQ(light_notes({}, samples, s, "photo", false, true).size(), 1u);
}

// 2.5 deviations are one run in eighty with a right range.
TEST(LightNotes, ARangeIsDoubtedBeyondTwoAndAHalfDeviations) {
  AcquisitionInput input;
  input.intensity_range = kRange;
  const double halved = 0.1 / std::sqrt(2.0);   // sd of the difference: sqrt(0.01 - 0.005)
  const auto notes = [&](double deviations) { return light_notes(input, std::vector<LightSample>{sample(1, 3, 1)}, solution(std::exp(2 + deviations * halved), halved), "photo", false, true).size(); };
  EXPECT_EQ(notes(2.4), 0u);
  EXPECT_EQ(notes(2.6), 1u);
  EXPECT_EQ(notes(-2.6), 1u);
}

}  // namespace
}  // namespace chiaro::optimize
