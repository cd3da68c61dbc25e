#include "blend/denoise.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <random>

#include "blend/denoise_leaf.h"
#include "stream/base/parallel.h"
#include "stream/base/rng.h"
#include "tests/blend/workplace.h"

namespace chiaro::blend {
namespace {

using namespace testing;

/// A square of n x n surfels a unit apart, in the plane z = 0.
NoisySurfels square(int n, float sd, const std::function<float(int x, int y)>& log_albedo, unsigned seed = 1) {
  NoisySurfels s;
  std::mt19937 random(seed);
  std::normal_distribution<float> noise;
  for (int y = 0; y < n; ++y)
    for (int x = 0; x < n; ++x) {
      s.position.push_back(Vec3f(static_cast<float>(x), static_cast<float>(y), 0) + 0.2f * Vec3f(noise(random), noise(random), 0));
      s.normal.push_back(Vec3f::UnitZ());
      s.oriented.push_back(1);
      s.log_albedo.push_back(Vec3f::Constant(log_albedo(x, y)) + sd * Vec3f(noise(random), noise(random), noise(random)));
      s.sd.push_back(sd);
    }
  return s;
}

struct Errors {
  double rms = 0, z = 0;   ///< of ln albedo; rms of error over stated deviation
};
Errors errors(const std::vector<Denoised>& found, int n, const std::function<float(int x, int y)>& truth) {
  Errors e;
  for (int y = 0; y < n; ++y)
    for (int x = 0; x < n; ++x) {
      const Denoised& d = found[static_cast<std::size_t>(y * n + x)];
      const double squared = static_cast<double>((d.log_albedo - Vec3f::Constant(truth(x, y))).squaredNorm()) / 3;
      e.rms += squared;
      e.z += squared / static_cast<double>(d.sd * d.sd);
    }
  return {std::sqrt(e.rms / (n * n)), std::sqrt(e.z / (n * n))};
}

TEST(Denoise, NoiseOnAnEvenSurfaceGoesAndSigmaKnows) {
  constexpr int kSide = 40;
  const auto even = [](int, int) { return -1.0f; };
  const NoisySurfels noisy = square(kSide, 0.1f, even);
  const Errors e = errors(denoise(noisy, noisy.size(), 6), kSide, even);
  EXPECT_LT(e.rms, 0.045);
  EXPECT_GT(e.z, 0.6);   // of independent noise a quarter is left, and so much is stated, beside what the noise by itself might hide
  EXPECT_LT(e.z, 1.1);
}

TEST(Denoise, WhatNeighboursMayHaveWrongAlikeStaysInSigma) {
  constexpr int kSide = 20;
  const auto even = [](int, int) { return -1.0f; };
  NoisySurfels smooth = square(kSide, 0, even);
  for (float& sd : smooth.sd) sd = 0.1f;   // they do not differ, so their errors are the same ones
  for (const Denoised& d : denoise(smooth, smooth.size(), 6)) EXPECT_GT(d.sd, 0.095f);
}

TEST(Denoise, WhatSigmaDoesNotExplainStays) {
  constexpr int kSide = 40;
  const auto checks = [](int x, int y) { return (x + y) % 2 ? -0.5f : -1.0f; };
  const NoisySurfels noisy = square(kSide, 0.02f, checks);
  const std::vector<Denoised> found = denoise(noisy, noisy.size(), 6);
  EXPECT_LT(errors(found, kSide, checks).rms, 0.025);
  const auto step = [](int x, int) { return x < kSide / 2 ? -0.5f : -2.0f; };
  const NoisySurfels edge = square(kSide, 0.1f, step);
  const std::vector<Denoised> sharp = denoise(edge, edge.size(), 6);
  double left = 0, right = 0;
  for (int y = 0; y < kSide; ++y) {
    left += static_cast<double>(sharp[static_cast<std::size_t>(y * kSide + kSide / 2 - 1)].log_albedo.mean()) / kSide;
    right += static_cast<double>(sharp[static_cast<std::size_t>(y * kSide + kSide / 2)].log_albedo.mean()) / kSide;
  }
  EXPECT_NEAR(left, -0.5, 0.03);
  EXPECT_NEAR(right, -2, 0.03);
}

TEST(Denoise, ACertainSurfelStandsAmongUncertainOnes) {
  constexpr int kSide = 20;
  NoisySurfels s = square(kSide, 0.2f, [](int, int) { return -1.0f; });
  const std::size_t middle = kSide * kSide / 2 + kSide / 2;
  s.log_albedo[middle] = Vec3f::Constant(-0.7f);
  for (const float sd : {0.0f, 0.002f}) {
    s.sd[middle] = sd;
    const Denoised d = denoise(s, s.size(), 6)[middle];
    EXPECT_NEAR(d.log_albedo[0], -0.7f, 0.01f);
    if (sd == 0) {
      EXPECT_EQ(d.log_albedo, s.log_albedo[middle]);
    }
    EXPECT_LE(d.sd, sd);
  }
}

TEST(Denoise, NothingComesFromAnotherFaceOrFromBeyondItsReach) {
  constexpr int kSide = 20;
  NoisySurfels s = square(kSide, 0.3f, [](int, int) { return -1.0f; });
  for (std::size_t i = 0; i < s.size(); ++i) s.log_albedo[i] = Vec3f::Constant(-1);
  NoisySurfels two = s;
  for (std::size_t i = 0; i < s.size(); ++i) {   // the other face of a thin wall
    two.position.push_back(s.position[i] + Vec3f(0, 0, 0.1f));
    two.normal.push_back(-Vec3f::UnitZ());
    two.oriented.push_back(1);
    two.log_albedo.push_back(Vec3f::Constant(-0.6f));
    two.sd.push_back(0.3f);
  }
  for (const Denoised& d : denoise(two, s.size(), 6)) ASSERT_NEAR(d.log_albedo[0], -1, 1e-5);
  s.log_albedo[0] = Vec3f::Constant(-0.6f);
  EXPECT_EQ(denoise(s, 1, 0.01f)[0].log_albedo, s.log_albedo[0]);
}

TEST(Denoise, NormalsOfUnknownSignAreTheSameTurned) {
  NoisySurfels known = square(20, 0.2f, [](int, int) { return -1.0f; });
  for (std::uint8_t& oriented : known.oriented) oriented = 0;
  NoisySurfels turned = known;
  for (std::size_t i = 0; i < turned.size(); i += 2) turned.normal[i] *= -1;
  const std::vector<Denoised> a = denoise(known, known.size(), 6), b = denoise(turned, turned.size(), 6);
  for (std::size_t i = 0; i < a.size(); ++i) ASSERT_EQ(a[i].log_albedo, b[i].log_albedo) << i;
}

TEST(Denoise, ANeighbourCountsByTheFourthPowerOfTheCosine) {
  NoisySurfels s;
  s.resize(2);
  const float cosine = 0.5f;
  s.position = {Vec3f::Zero(), Vec3f::UnitX()};
  s.normal = {Vec3f::UnitZ(), Vec3f(std::sqrt(1 - cosine * cosine), 0, cosine)};
  s.oriented = {1, 1};
  s.log_albedo = {Vec3f::Zero(), Vec3f::Constant(0.01f)};
  s.sd = {0.5f, 0.5f};   // says all about how they differ: nearly the mean comes out
  EXPECT_NEAR(denoise(s, 1, 6)[0].log_albedo[0], 0.01f * (1 / 16.0f) / (1 + 1 / 16.0f), 1e-6f);
  s.normal[1].z() = -cosine;   // faces away
  EXPECT_EQ(denoise(s, 1, 6)[0].log_albedo[0], 0);
  s.oriented[1] = 0;
  EXPECT_NEAR(denoise(s, 1, 6)[0].log_albedo[0], 0.01f * (1 / 16.0f) / (1 + 1 / 16.0f), 1e-6f);
}

TEST(Denoise, ARelativeSigmaExplainsLessInTheDark) {
  // Logarithms have an offset of 0.02: at albedos of 0.01 and 0.03 a sigma of 30 % is 10 and 18 % of them, and the two differ by 51 %.
  const Workplace w(plane_scene());
  constexpr float kBrightness = 2, kDark = 0.01f * kBrightness, kLess = 0.03f * kBrightness;
  const auto is_dark = [](std::size_t leaf, std::uint32_t slot) { return uniform01(5, Purpose::kTest, leaf * 65536 + slot, 0) < 0.5f; };
  const auto blended = [&](std::size_t leaf) {
    std::vector<BlendedSurfel> values(w.store->chunks()[w.store->leaves()[leaf]].count);
    for (std::uint32_t slot = 0; slot < values.size(); ++slot) values[slot] = {Vec3f::Constant(is_dark(leaf, slot) ? kDark : kLess), 0.3f, 0.3f, 2};
    return values;
  };
  std::vector<BlendedSurfel> values = blended(0);
  LeafDenoiser(*w.store, kBrightness, blended).denoise(0, values);
  double sums[2] = {0, 0}, counts[2] = {0, 0};
  for (std::uint32_t slot = 0; slot < values.size(); ++slot) {
    sums[is_dark(0, slot)] += static_cast<double>(values[slot].albedo[0]);
    ++counts[is_dark(0, slot)];
  }
  EXPECT_GT(sums[0] / counts[0] - sums[1] / counts[1], 0.5 * static_cast<double>(kLess - kDark));
}

/// The painted plane in photographs with noise of `sd`, other in each pixel.
BlendPhotograph noisy_photograph(const Workplace& w, const std::string& name, float sd) {
  ShotOptions options;
  options.sigma = sd;
  options.paint = [sd](int x, int y, const Vec3f& albedo) {
    std::mt19937 random(static_cast<unsigned>(y * 160 + x + 1));
    std::normal_distribution<float> noise;
    return Vec3f(albedo * std::exp(sd * noise(random)));
  };
  return w.photograph(name, Vec3d(0.5, 0.5, 1), Vec3d(0.5, 0.5, 0), options);
}

double relative_rms(const std::vector<Seen>& seen) {
  double sum = 0;
  int count = 0;
  for (const Seen& s : seen)
    if (s.photos > 0) {
      sum += static_cast<double>((s.albedo.array() / smooth_paint(s.position).array() - 1).square().mean());
      ++count;
    }
  return std::sqrt(sum / count);
}

TEST(Denoise, ABlendComesOutNearerToTheTruthAndSaysSo) {
  const Workplace w(plane_scene());
  const BlendPhotograph photo = noisy_photograph(w, "a", 0.1f);
  BlendOptions options;
  w.run({photo}, options);
  const std::vector<Seen> before = w.result();
  options.denoise = true;
  w.run({photo}, options);
  const std::vector<Seen> after = w.result();
  EXPECT_LT(relative_rms(after), 0.65 * relative_rms(before));
  for (std::size_t i = 0; i < before.size(); ++i) {
    ASSERT_EQ(after[i].photos, before[i].photos);
    if (before[i].photos > 0) {
      ASSERT_LE(after[i].sigma, before[i].sigma);
    } else {
      ASSERT_TRUE(std::isnan(after[i].sigma));
    }
  }
}

TEST(Denoise, WhatAllPhotographsShareStaysInSigma) {
  const Workplace w(plane_scene());
  BlendOptions options;
  options.denoise = true;
  const std::vector<BlendPhotograph> photos{noisy_photograph(w, "a", 0.1f)};
  w.run(photos, options);
  const std::vector<Seen> alone = w.result();
  options.shared_sigma = 0.3;
  w.run(photos, options);
  const std::vector<Seen> shared = w.result();
  for (std::size_t i = 0; i < alone.size(); ++i)
    if (alone[i].photos > 0) {
      ASSERT_NEAR(shared[i].sigma, std::hypot(alone[i].sigma, 0.3f), 1e-5f);
    }
}

TEST(Denoise, PhotographsThatAreExactKeepTheirBits) {
  const Workplace w(plane_scene());
  BlendOptions options;
  const std::vector<BlendPhotograph> photos{noisy_photograph(w, "a", 0)};
  w.run(photos, options);
  const auto expected = w.bytes();
  options.denoise = true;
  w.run(photos, options);
  EXPECT_EQ(w.bytes(), expected);
}

TEST(Denoise, BordersOfChunksThreadsAndBudgetLeaveNoTrace) {
  const Workplace small(plane_scene(), true, 300), large(plane_scene(), true, 60000);
  EXPECT_GT(small.store->leaves().size(), 10u);
  BlendOptions options;
  options.denoise = true;
  small.run({noisy_photograph(small, "a", 0.1f)}, options);
  large.run({noisy_photograph(large, "a", 0.1f)}, options);
  const auto by_place = [](const Workplace& w) {
    std::vector<Seen> all = w.result();
    std::sort(all.begin(), all.end(), [](const Seen& a, const Seen& b) {
      const auto cell = [](const Seen& s) { return std::pair(std::lround(s.position.x() * 1e4), std::lround(s.position.y() * 1e4)); };
      return cell(a) < cell(b);
    });
    return all;
  };
  const std::vector<Seen> a = by_place(small), b = by_place(large);
  ASSERT_EQ(a.size(), b.size());
  std::size_t compared = 0, apart = 0;   // positions are stored to a fraction of the chunk: a neighbour may change places with the next one
  for (std::size_t i = 0; i < a.size(); ++i)
    if (a[i].photos > 0 && (a[i].position - b[i].position).norm() < 1e-4) {
      ++compared;
      apart += (a[i].albedo - b[i].albedo).cwiseAbs().maxCoeff() > 2e-3f;
    }
  EXPECT_GT(compared, a.size() / 2);
  EXPECT_LT(apart, compared / 50);
  const auto expected = small.bytes();
  {
    const ThreadLimit one(1);
    small.run({noisy_photograph(small, "a", 0.1f)}, options);
    EXPECT_EQ(small.bytes(), expected);
  }
  small.run({noisy_photograph(small, "a", 0.1f)}, options, 2400 << 10);
  EXPECT_EQ(small.bytes(), expected);
}

}  // namespace
}  // namespace chiaro::blend
