#include "tools/blend_record.h"

#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

namespace chiaro::tools {
namespace {

/// The notes on one photograph.
std::vector<std::string> notes_on(const blend::PhotographStats& photograph, int cell_px = 1) {
  blend::BlendStats stats;
  stats.photographs = {photograph};
  blend::BlendPhotograph named;
  named.name = "a.exr";
  return nlohmann::json::parse(blend_record_json(stats, std::span(&named, 1), std::span(&cell_px, 1))).at("notes").get<std::vector<std::string>>();
}

TEST(BlendRecord, WhatIsDoneToAPhotographIsSaid) {
  blend::PhotographStats p;
  EXPECT_TRUE(notes_on(p).empty());
  p.gain = {0.8, 0.8, 0.8};
  ASSERT_EQ(notes_on(p).size(), 1u);
  EXPECT_EQ(notes_on(p)[0], "a.exr: 1.25 times as bright as the others show the same surface; corrected in the blend");
  p.gain = {1, 1, 1};
  p.inspection.shift_px = Vec2f(0.2f, 0);
  EXPECT_TRUE(notes_on(p).empty()) << "too little to do anything about";
  p.inspection.shift_px = Vec2f(3, 0);
  p.alignment = blend::alignment_for(p.inspection);   // of no part alone: nothing speaks against the whole
  ASSERT_EQ(p.alignment.trust, 1);
  ASSERT_EQ(notes_on(p).size(), 1u);
  EXPECT_EQ(notes_on(p)[0], "a.exr: shows the surface 3 pixels beside where its camera puts it; corrected in the blend");
  p.inspection.shift_px = Vec2f(5, 0);
  p.alignment = blend::alignment_for(p.inspection);
  ASSERT_EQ(notes_on(p).size(), 1u);
  EXPECT_EQ(notes_on(p)[0], "a.exr: shows the surface 5 pixels beside where its camera puts it; its weight is reduced");
}

TEST(BlendRecord, PlacesAreThoseOfThePictureWhereCellsOfItWereRead) {
  blend::PhotographStats p;
  p.inspection.shift_px = Vec2f(3, 0);
  p.alignment = blend::alignment_for(p.inspection);
  p.inspection.disturbed = blend::Inspection::Region{10, 20, 30, 40};
  const std::vector<std::string> notes = notes_on(p, 4);
  ASSERT_EQ(notes.size(), 2u);
  EXPECT_EQ(notes[0], "a.exr: shows the surface 12 pixels beside where its camera puts it; corrected in the blend");
  EXPECT_EQ(notes[1], "a.exr: pixels 40 to 120 across and 80 to 160 down show something else than the other photographs; left out there");
}

}  // namespace
}  // namespace chiaro::tools
