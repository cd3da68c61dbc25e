#include "blend/ballot.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <optional>
#include <vector>

namespace chiaro::blend {
namespace {

constexpr float kTolerance = 0.05f;

Sample reading(float value, float weight = 1, float high = 0) { return {weight, 0.01f, 0, Vec3f::Constant(value), Vec3f::Constant(high)}; }

Ballot ballot_of(std::initializer_list<Sample> samples) {
  Ballot ballot;
  std::uint16_t k = 0;
  for (const Sample& s : samples) cast_vote(ballot, k++, s, 0.5f);
  return ballot;
}
const std::vector<Vec3f> kNoGains(16, Vec3f::Zero());

TEST(Ballot, AVoteKeepsItsReadingWithinTheStepsOfItsCode) {
  for (const float value : {0.004f, 0.1f, 0.5f, 3.0f})
    for (const float weight : {1e-12f, 0.3f, 1e4f}) {
      const Ballot ballot = ballot_of({reading(value, weight, 0.25f * value)});
      EXPECT_NEAR(log_low_of(ballot.votes[0])[1], std::log(value / 0.5f + kDarkOffset), 1e-4f);
      EXPECT_NEAR(weight_of(ballot.votes[0]) / weight, 1, 1e-3f);
      EXPECT_NEAR(detail_of(ballot.votes[0]), 0.25f, 1e-4f);
    }
}

TEST(Ballot, KeepsTheEightLargestWeights) {
  Ballot ballot;
  for (std::uint16_t k = 0; k < 100; ++k) cast_vote(ballot, k, reading(0.5f, static_cast<float>(1 + (k * 37) % 100)), 0.5f);
  float least = 1e9f;
  for (const Vote& v : ballot.votes) least = std::min(least, weight_of(v));
  EXPECT_NEAR(least, 93, 0.1f);
}

TEST(Ballot, WhatWeighsLessThanTheLeastIsNoVote) {
  Ballot ballot;
  EXPECT_EQ(least_weight(ballot), 0);
  for (std::uint16_t k = 0; k < 8; ++k) cast_vote(ballot, k, reading(0.5f, 3.0f + k), 0.5f);
  const float least = least_weight(ballot);
  EXPECT_GT(least, 2.98f);
  EXPECT_LE(least, 3);
  const auto bytes_of = [](const Ballot& b) { return std::vector<std::byte>(reinterpret_cast<const std::byte*>(&b), reinterpret_cast<const std::byte*>(&b + 1)); };
  const auto before = bytes_of(ballot);
  for (const float share : {0.9999f, 0.9f, 1e-6f}) {
    cast_vote(ballot, 0, reading(0.9f, share * least), 0.5f);   // of equal weights that of the first photograph would stay
    EXPECT_EQ(bytes_of(ballot), before) << share;
  }
  cast_vote(ballot, 9, reading(0.9f, 3.01f), 0.5f);
  EXPECT_NE(bytes_of(ballot), before);
}

TEST(Ballot, ReadingsAreJudgedByTheirWeightBesideTheVotes) {
  EXPECT_EQ(Tolerance::class_of(0.001f, 0), 0u);   // there was room for a vote
  EXPECT_EQ(Tolerance::class_of(2, 2), 0u);
  EXPECT_EQ(Tolerance::class_of(1.9f, 2), 1u);
  EXPECT_EQ(Tolerance::class_of(2 / 15.0f, 2), 1u);
  EXPECT_EQ(Tolerance::class_of(2 / 17.0f, 2), 2u);
  EXPECT_EQ(Tolerance::class_of(1e-20f, 2), Tolerance::kClasses - 1);
}

TEST(Ballot, HasTheSameBitsInWhateverOrderVotesAreCast) {
  std::vector<std::uint16_t> order{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11};
  std::optional<std::vector<std::byte>> expected;
  for (int turn = 0; turn < 12; ++turn) {
    Ballot ballot;
    for (const std::uint16_t k : order) cast_vote(ballot, k, reading(0.1f + 0.05f * static_cast<float>(k), static_cast<float>(1 + k % 2)), 0.5f);   // six of each weight
    const auto* bytes = reinterpret_cast<const std::byte*>(&ballot);
    const std::vector<std::byte> found(bytes, bytes + sizeof ballot);
    if (expected) {
      EXPECT_EQ(found, *expected) << turn;
    }
    expected = found;
    std::rotate(order.begin(), order.begin() + 5, order.end());
    std::swap(order[1], order[7]);
  }
}

TEST(Ballot, AWithdrawnVoteLeavesTheOthersAndSaysWhatIsMissing) {
  Ballot three = ballot_of({reading(0.2f, 1), reading(0.3f, 2), reading(0.4f, 3)});
  const Ballot two = [] {
    Ballot b;
    cast_vote(b, 0, reading(0.2f, 1), 0.5f);
    cast_vote(b, 2, reading(0.4f, 3), 0.5f);
    return b;
  }();
  const Withdrawal gone = withdraw_vote(three, 1), again = withdraw_vote(three, 1);
  EXPECT_TRUE(gone.had_voted && gone.is_whole);
  EXPECT_FALSE(again.had_voted);
  EXPECT_EQ(std::memcmp(&three, &two, sizeof two), 0);
  Ballot full;
  for (std::uint16_t k = 0; k < 9; ++k) cast_vote(full, k, reading(0.5f, static_cast<float>(1 + k)), 0.5f);
  EXPECT_TRUE(withdraw_vote(full, 0).is_whole);   // was displaced already
  EXPECT_FALSE(withdraw_vote(full, 5).is_whole);  // and may have displaced the first
}

TEST(Ballot, TheMajorityIsTheMeanOfThoseThatAgree) {
  const auto majority = majority_of(ballot_of({reading(0.4f), reading(0.404f), reading(0.9f)}), kNoGains, kTolerance);
  ASSERT_TRUE(majority);
  EXPECT_EQ(majority->members, 0b011);
  EXPECT_NEAR(majority->log_low[0], std::log(0.402f / 0.5f + kDarkOffset), 1e-4f);
  EXPECT_EQ(agreement_weight(*majority, log_value(Vec3f::Constant(0.41f), 0.5f), kTolerance), 1);
  EXPECT_EQ(agreement_weight(*majority, log_value(Vec3f::Constant(0.9f), 0.5f), kTolerance), 0);
  const float between = agreement_weight(*majority, log_value(Vec3f::Constant(0.43f), 0.5f), kTolerance);
  EXPECT_TRUE(between > 0 && between < 1);
}

TEST(Ballot, NobodyWinsATie) {
  EXPECT_FALSE(majority_of(Ballot{}, kNoGains, kTolerance));
  EXPECT_FALSE(majority_of(ballot_of({reading(0.4f)}), kNoGains, kTolerance));
  EXPECT_FALSE(majority_of(ballot_of({reading(0.4f), reading(0.8f)}), kNoGains, kTolerance));
  EXPECT_FALSE(majority_of(ballot_of({reading(0.2f), reading(0.4f), reading(0.8f)}), kNoGains, kTolerance));
  EXPECT_FALSE(majority_of(ballot_of({reading(0.4f), reading(0.4f), reading(0.8f), reading(0.8f)}), kNoGains, kTolerance));
}

TEST(Ballot, AReadingOfLittleWeightHasLessThanAVote) {
  // two poor photographs do not outvote two good ones, nor one
  const auto good = majority_of(ballot_of({reading(0.4f), reading(0.4f), reading(0.8f, 0.001f), reading(0.8f, 0.001f)}), kNoGains, kTolerance);
  ASSERT_TRUE(good);
  EXPECT_EQ(good->members, 0b0011);
  EXPECT_FALSE(majority_of(ballot_of({reading(0.4f), reading(0.8f, 0.001f), reading(0.8f, 0.001f)}), kNoGains, kTolerance));
  // from a twentieth of the largest weight on a vote is a whole one
  const auto many = majority_of(ballot_of({reading(0.4f), reading(0.8f, 0.1f), reading(0.8f, 0.06f)}), kNoGains, kTolerance);
  ASSERT_TRUE(many);
  EXPECT_EQ(many->members, 0b0110);
}

TEST(Ballot, GainsMakeBrighterPhotographsAgree) {
  const Ballot ballot = ballot_of({reading(0.4f), reading(0.52f), reading(0.4f)});
  std::vector<Vec3f> gains = kNoGains;
  gains[1].setConstant(std::log(0.4f / 0.52f));
  const auto majority = majority_of(ballot, gains, kTolerance);
  ASSERT_TRUE(majority);
  EXPECT_EQ(majority->members, 0b111);
  EXPECT_NEAR(with_gain(log_value(Vec3f::Constant(0.52f), 0.5f), gains[1])[2], std::log(0.8f + kDarkOffset), 1e-5f);
}

TEST(Ballot, OneChannelIsEnoughToDisagree) {
  Sample red = reading(0.4f);
  red.low[0] = 0.6f;
  const auto majority = majority_of(ballot_of({reading(0.4f), reading(0.4f), red}), kNoGains, kTolerance);
  ASSERT_TRUE(majority);
  EXPECT_EQ(majority->members, 0b011);
}

}  // namespace
}  // namespace chiaro::blend
