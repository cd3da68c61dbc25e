#include "stream/store/block.h"

#include <gtest/gtest.h>

#include "memory_cloud.h"

namespace chiaro::stream {
namespace {

TEST(Block, NormalsSurviveWithinAHundredthOfADegree) {
  double worst = 0;
  for (std::uint64_t i = 0; i < 200000; ++i) {
    const Vec3d n = sphere_direction(i);
    const auto code = encode_normal(n.cast<float>());
    worst = std::max(worst, std::atan2(n.cross(decode_normal(code[0], code[1]).cast<double>()).norm(), n.dot(decode_normal(code[0], code[1]).cast<double>())));
  }
  EXPECT_LT(worst * 180 / 3.14159265358979, 0.01);
}

TEST(Block, NormalsAlongTheAxesAreExact) {
  for (int axis = 0; axis < 3; ++axis)
    for (const float sign : {-1.0f, 1.0f}) {
      Vec3f n = Vec3f::Zero();
      n[axis] = sign;
      const auto code = encode_normal(n);
      EXPECT_EQ(decode_normal(code[0], code[1]), n);
    }
}

TEST(Block, ANormalWithoutDirectionBecomesUp) {
  for (const Vec3f& n : {Vec3f(0, 0, 0), Vec3f(NAN, 0, 1), Vec3f(INFINITY, 0, 0)}) {
    const auto code = encode_normal(n);
    EXPECT_EQ(decode_normal(code[0], code[1]), Vec3f(0, 0, 1));
  }
}

TEST(Block, AnyNormalCodeDecodesToAUnitVector) {
  for (int u = -32768; u < 32768; u += 997)
    for (int v = -32768; v < 32768; v += 991) EXPECT_NEAR(decode_normal(static_cast<std::int16_t>(u), static_cast<std::int16_t>(v)).norm(), 1.0f, 1e-5f);
}

TEST(Block, RadiusCodesRoundUpByLessThanAStep) {
  const float largest = 0.37f;
  EXPECT_EQ(encode_radius(largest, largest), 255);
  EXPECT_EQ(decode_radius(255, largest), largest);
  for (std::uint64_t i = 0; i < 10000; ++i) {
    const float r = largest * static_cast<float>(std::exp2(-15.9 * uniform(i, 0)));
    const float decoded = decode_radius(encode_radius(r, largest), largest);
    EXPECT_GE(decoded, r);
    EXPECT_LE(decoded, r * 1.0444f);  // 2^(1/16)
  }
  EXPECT_EQ(encode_radius(1e-9f, largest), 0);
}

TEST(Block, PositionsAreTheMiddleOfTheirStep) {
  SurfelBlock block{};
  block.x[3] = 65535;
  block.log_radius[3] = 255;
  ChunkFrame frame{Vec3d(10, 20, 30), 0.5, 2.0f};
  const Surfel s = decode_surfel(block, 3, frame);
  EXPECT_EQ(s.position_in_world, Vec3d(10 + 65535.5 * 0.5, 20.25, 30.25));
  EXPECT_EQ(s.radius, 2.0f);
}

}  // namespace
}  // namespace chiaro::stream
