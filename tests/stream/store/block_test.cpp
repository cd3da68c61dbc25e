#include "stream/store/block.h"

#include <gtest/gtest.h>

#include "memory_cloud.h"

namespace chiaro::stream {
namespace {

TEST(Block, NormalsSurviveWithinATenthOfADegree) {
  double worst = 0;
  for (std::uint64_t i = 0; i < 200000; ++i) {
    const Vec3d n = sphere_direction(i);
    const auto code = encode_normal(n.cast<float>());
    worst = std::max(worst, std::atan2(n.cross(decode_normal(code[0], code[1]).cast<double>()).norm(), n.dot(decode_normal(code[0], code[1]).cast<double>())));
  }
  EXPECT_LT(worst * 180 / 3.14159265358979, 0.06);
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

// The line is read back by its definition, written down here a second time: {e : u e_a + v e_b = distance}, |u| + |v| = 1.
TEST(Block, ClipLinesSurvive) {
  for (std::uint64_t i = 0; i < 20000; ++i) {
    const auto normal = encode_normal(sphere_direction(i).cast<float>());
    const Vec3f n = decode_normal(normal[0], normal[1]);
    const Vec3f across = n.cross(sphere_direction(i + 77).cast<float>()).normalized(), along = n.cross(across);
    const float radius = 0.3f, distance = radius * static_cast<float>(uniform(i, 1));
    const std::uint16_t code = encode_clip(normal[0], normal[1], across, distance, radius);
    ASSERT_NE(code, 0);
    const int largest = std::abs(n.z()) >= std::max(std::abs(n.x()), std::abs(n.y())) ? 2 : std::abs(n.y()) >= std::abs(n.x()) ? 1 : 0;
    const float quarter = static_cast<float>(code >> 5) / 32, away = static_cast<float>((code & 31) - 1) / 30 * radius;
    const float u = quarter < 2 ? 1 - quarter : quarter - 3, v = quarter < 1 ? quarter : quarter < 3 ? 2 - quarter : quarter - 4;
    const Vec3f in_axes(u, v, 0);
    const auto side = [&](const Vec3f& e) { return in_axes[0] * e[(largest + 1) % 3] + in_axes[1] * e[(largest + 2) % 3] - away; };
    for (const float x : {-0.4f, 0.0f, 0.4f}) {
      EXPECT_LT(side(radius * x * along + (distance - 0.05f * radius) * across), 0);
      EXPECT_GT(side(radius * x * along + (distance + 0.15f * radius) * across), 0);
    }
  }
}

TEST(Block, AClipLeavesNormalAndFlagsAlone) {
  SurfelBlock block{};
  const auto normal = encode_normal(Vec3f(-0.3f, 0.5f, -0.8f).normalized());
  block.normal_u[7] = normal[0];
  block.normal_v[7] = normal[1];
  block.flags[7] = SurfelBlock::kOriented | SurfelBlock::kIsolated;
  for (const auto code : {std::uint16_t{0xfff}, std::uint16_t{0x5a5}, std::uint16_t{0x001}}) {
    put_clip(block, 7, code);
    EXPECT_EQ(clip_of(block, 7), code);
    EXPECT_EQ(decode_normal(block.normal_u[7], block.normal_v[7]), decode_normal(normal[0], normal[1]));
    EXPECT_EQ(decode_surfel(block, 7, {}).flags, SurfelBlock::kOriented | SurfelBlock::kIsolated);
  }
}

TEST(Block, ALineBesideTheDiscDoesNotClip) { EXPECT_EQ(encode_clip(0, 0, {1, 0, 0}, 0.31f, 0.3f), 0); }

TEST(Block, AnyNormalCodeDecodesToAUnitVector) {
  for (int u = -32768; u < 32768; u += 997)
    for (int v = -32768; v < 32768; v += 991) EXPECT_NEAR(decode_normal(static_cast<std::int16_t>(u), static_cast<std::int16_t>(v)).norm(), 1.0f, 1e-5f);
}

TEST(Block, CoordinatesOnTheOctahedronAreRoundedOnce) {
  for (int k = -2047; k <= 2047; ++k) ASSERT_EQ(decode_octahedron(static_cast<std::int16_t>(16 * k), 0).x(), static_cast<float>(k) / 2047.0f) << k;
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

TEST(Block, TheRadiusTableAnswersAsTheFunctionsDo) {
  const float largest = 0.37f;
  const RadiusTable table(largest);
  for (int code = 0; code < 256; ++code) {
    const float r = decode_radius(static_cast<std::uint8_t>(code), largest);
    EXPECT_EQ(table.decode(static_cast<std::uint8_t>(code)), r);
    for (const float near : {std::nextafter(r, 0.0f), r, std::nextafter(r, 1.0f)}) EXPECT_EQ(table.encode(near), encode_radius(near, largest));
  }
  for (const float r : {-1.0f, 0.0f, 1e-9f, 2.0f}) EXPECT_EQ(table.encode(r), encode_radius(r, largest));
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
