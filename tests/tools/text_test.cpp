#include <gtest/gtest.h>

#include <algorithm>
#include <fstream>
#include <nlohmann/json.hpp>

#include "stream/base/file.h"
#include "tools/glob.h"
#include "tools/run_record.h"
#include "tools/suggest.h"
#include "tools/table.h"

namespace chiaro::tools {
namespace {

TEST(EditDistance, CountsSwapsAsOneStep) {
  EXPECT_EQ(edit_distance("", "abc"), 3u);
  EXPECT_EQ(edit_distance("joint", "joint"), 0u);
  EXPECT_EQ(edit_distance("jiont", "joint"), 1u);
  EXPECT_EQ(edit_distance("kitten", "sitting"), 3u);
  EXPECT_EQ(edit_distance("ca", "abc"), 3u) << "no part is edited twice";
  EXPECT_EQ(edit_distance(std::string(5000, 'a'), "b"), 5000u);
}

TEST(Suggestion, NamesTheNearestWordOrAllOfThem) {
  const std::vector<std::string> words{"joint", "single", "adam"};
  EXPECT_EQ(suggestion("jonit", words), "; did you mean \"joint\"?");
  EXPECT_EQ(suggestion("ADAM", words), "; did you mean \"adam\"?");
  EXPECT_EQ(suggestion("sin", words), "; did you mean \"single\"?");
  EXPECT_EQ(suggestion("xyz", words), "; known: joint, single, adam");
  EXPECT_EQ(suggestion("xyz", {}), "");
}

TEST(Table, AlignsColumnsAndCountsCharactersNotBytes) {
  Table table({"name", "value"});
  table.row({"étage", "1"});
  table.row({"b", "22.5"});
  EXPECT_EQ(table.text(), "name   value\nétage      1\nb       22.5\n");
  EXPECT_THROW(table.row({"1", "2", "3"}), std::invalid_argument);
}

TEST(Format, WritesNumbersAsPeopleReadThem) {
  EXPECT_EQ(format_count(9000000), "9 000 000");
  EXPECT_EQ(format_count(12), "12");
  EXPECT_EQ(format_count(1204), "1 204");
  EXPECT_EQ(format_seconds(0.312), "0.31 s");
  EXPECT_EQ(format_seconds(59.7), "1 min 00 s");
  EXPECT_EQ(format_seconds(185), "3 min 05 s");
  EXPECT_EQ(format_seconds(7860), "2 h 11 min");
  EXPECT_EQ(format_seconds(-1), "?");
  EXPECT_EQ(format_rate(950), "950");
  EXPECT_EQ(format_rate(1234567), "1.23 M");
  EXPECT_EQ(format_number(0.03125), "0.03125");
  EXPECT_EQ(format_number(std::nan("")), "nan");
}

TEST(NaturalOrder, ComparesNumbersAsNumbers) {
  std::vector<std::string> names{"photo_10", "photo_2", "photo_02", "Photo_1", "photo_2a", "photo_", "photo_999999999999999999999", "photo_1000000000000000000000"};
  std::sort(names.begin(), names.end(), natural_less);
  EXPECT_EQ(names, (std::vector<std::string>{"Photo_1", "photo_", "photo_2", "photo_2a", "photo_02", "photo_10", "photo_999999999999999999999",
                                             "photo_1000000000000000000000"}));
}

TEST(NaturalOrder, IsAStrictOrder) {
  const std::vector<std::string> names{"", "0", "00", "a0", "a00b", "a0b", "a1", "a01", "1a", "01a", "a", "b2", "\xff", "9", "10"};
  for (const auto& a : names)
    for (const auto& b : names) {
      EXPECT_EQ(natural_less(a, b) + natural_less(b, a), a == b ? 0 : 1) << a << " | " << b;
      for (const auto& c : names)
        EXPECT_FALSE(natural_less(a, b) && natural_less(b, c) && !natural_less(a, c)) << a << " | " << b << " | " << c;
    }
}

TEST(Wildcard, MatchesStarsMarksAndSets) {
  EXPECT_TRUE(matches_wildcard("photo_??.exr", "photo_07.exr"));
  EXPECT_FALSE(matches_wildcard("photo_??.exr", "photo_7.exr"));
  EXPECT_TRUE(matches_wildcard("*a*b*c", "xxaxxbxxbc"));
  EXPECT_FALSE(matches_wildcard("*a*b*c", "xxaxxbxxb"));
  EXPECT_TRUE(matches_wildcard("[a-c]x[!0-9]", "bxz"));
  EXPECT_FALSE(matches_wildcard("[a-c]x[!0-9]", "bx5"));
  EXPECT_TRUE(matches_wildcard("[]]", "]"));
  EXPECT_TRUE(matches_wildcard("[abc", "[abc")) << "an open bracket stands for itself";
  EXPECT_TRUE(matches_wildcard("", ""));
  EXPECT_TRUE(matches_wildcard("**", ""));
  EXPECT_FALSE(matches_wildcard(std::string(2000, '*') + "b", std::string(5000, 'a'))) << "and that takes no time";
}

TEST(ExpandPattern, FindsFilesInNaturalOrderAndTakesExistingNamesLiterally) {
  const ScratchFolder scratch;
  const auto folder = scratch.path() / "scan [1]";
  for (const char* name : {"a_10.ply", "a_9.ply", ".a_1.ply", "b[0-9].ply", "b3.ply"}) {
    make_folder(folder / "x1");
    std::ofstream(folder / "x1" / name) << "x";
  }
  const auto names = [&](const std::string& pattern) {
    std::vector<std::string> out;
    for (const auto& path : expand_pattern(folder, pattern)) out.push_back(path.filename().string());
    return out;
  };
  EXPECT_EQ(names("x?/a_*.ply"), (std::vector<std::string>{"a_9.ply", "a_10.ply"}));
  EXPECT_EQ(names("x1/b[0-9].ply"), (std::vector<std::string>{"b[0-9].ply"}));
  EXPECT_EQ(names((folder / "x1" / "a_9.ply").string()), (std::vector<std::string>{"a_9.ply"}));
  EXPECT_EQ(names("./x1/../x*/a_9.ply"), (std::vector<std::string>{"a_9.ply"}));
  EXPECT_TRUE(names("y*/a").empty());
  EXPECT_TRUE(names(std::string(5000, 'n')).empty());
}

TEST(RunRecord, HoldsWhatHappened) {
  const ScratchFolder scratch;
  const std::vector<std::string> args{"run", "p.toml"};
  std::ofstream(scratch.path() / "cloud.ply") << "12345";
  RunRecord record("run", args);
  record.option("fill", true);
  record.option("method", "joint");
  record.seed(7);
  record.threads(2);
  record.memory_limit(1u << 30);
  record.project(R"({"name":"t"})");
  record.input(scratch.path() / "cloud.ply", "abc");
  StageTimer timer(record, "ingest");
  timer.done();
  { const StageTimer failed(record, "light"); }
  record.count("points_in", 5);
  record.count("points_in", 6);
  EXPECT_FALSE(record.was_partial());
  record.left_out("photograph", "photo_\xff", "no camera");
  EXPECT_TRUE(record.was_partial());
  record.set("lights", "[1,2]");
  EXPECT_THROW(record.set("lights", "[1,"), std::invalid_argument);
  record.write(scratch.path() / "run.json", 3);
  const auto json = nlohmann::json::parse(read_text(scratch.path() / "run.json"));
  EXPECT_EQ(json["exit"], 3);
  EXPECT_EQ(json["options"]["fill"], true);
  EXPECT_EQ(json["options"]["method"], "joint");
  EXPECT_EQ(json["seed"], 7);
  EXPECT_EQ(json["inputs"][0]["bytes"], 5);
  EXPECT_EQ(json["inputs"][0]["hash"], "abc");
  EXPECT_EQ(json["stages"].size(), 1u);
  EXPECT_EQ(json["stages"][0]["name"], "ingest");
  EXPECT_EQ(json["counts"]["points_in"], 11);
  EXPECT_EQ(json["left_out"][0]["reason"], "no camera");
  EXPECT_EQ(json["project"]["name"], "t");
  EXPECT_EQ(json["lights"][1], 2);
  EXPECT_GT(json["memory"]["peak_bytes"].get<std::uint64_t>(), 1000u);
  EXPECT_EQ(nlohmann::json::parse(record.json())["finished"], nullptr);
}

}  // namespace
}  // namespace chiaro::tools
