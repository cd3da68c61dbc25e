/// Damaged files, through the executable: intermediate files of a run, project files, clouds. Never a crash, a hang or a silently wrong result.
#include <algorithm>
#include <functional>

#include "stream/base/rng.h"
#include "tests/support/run_fixture.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;
constexpr std::uint64_t kSeed = 31;
constexpr std::uint64_t kMostMemory = 512u << 20;

std::size_t pick(std::uint64_t element, std::uint32_t draw, std::size_t count) {
  return std::min(count - 1, static_cast<std::size_t>(static_cast<double>(uniform01(kSeed, Purpose::kTest, element, draw)) * static_cast<double>(count)));
}

/// Ended by itself, in time, with a message where it failed, without asking for the moon.
void expect_civil(const ProcessResult& ran, const std::string& what) {
  EXPECT_FALSE(ran.hung) << what;
  EXPECT_FALSE(ran.signalled) << what << ": signal " << ran.code - 128 << "\n" << ran.err;
  EXPECT_THAT(ran.code, testing::AnyOf(0, 1, 2, 3)) << what << "\n" << ran.err;
  if (ran.code == 1 || ran.code == 2) {
    EXPECT_THAT(ran.err, HasSubstr("error: ")) << what;
    EXPECT_THAT(ran.err, testing::Not(HasSubstr("std::"))) << what;
  }
  EXPECT_THAT(ran.err, testing::Not(testing::AnyOf(HasSubstr("Sanitizer"), HasSubstr("runtime error")))) << what;
  if (!other_executable()) {
    EXPECT_LT(ran.peak_bytes, kMostMemory) << what;
  }
}

ProcessOptions impatient() {
  ProcessOptions options;
  options.limit_s = 60;
  return options;
}

class Damage : public RunTest {};

/// Intermediate files are read again in three ways: a second run reuses results; another light model computes everything after the rasters anew; and where
/// a photograph's albedo and the export are to be made again, they read what the light solve and the blend left.
class DamageOfWork : public Damage {
 protected:
  void SetUp() override {
    TinySceneOptions small;
    small.points = 1500;
    small.photographs = 2;
    small.width_px = 64;
    small.height_px = 48;
    small.focal_px = 75;
    scene(small);
    ASSERT_EQ(run("first").code, 0);
    ways_.push_back({"a second run", {}, false, results("first")});
    ways_.push_back({"another light model", {"--set", "acquisition.ambient.model=none"}, false, {}});
    ways_.push_back({"albedo and export once more", {"--set", "export.fill=true"}, true, {}});
    for (Way& way : ways_) {
      restore();
      prepare(way);
      ASSERT_EQ(run("out", way.words).code, 0);
      way.expected = results("out");
    }
    EXPECT_THAT(differences(ways_[0].expected, ways_[1].expected), testing::Contains("lights.json"));
    for (const auto& [name, bytes] : files_below(at("first"), {"work", "store.chiaro"})) {
      // The second photograph's files are like the first one's.
      if (!bytes.empty() && name.find("photo_01") == std::string::npos && !name.ends_with("_1.bin")) files_.push_back(name);
    }
    ASSERT_GE(files_.size(), 20u);
  }

  struct Way {
    const char* name;
    std::vector<std::string> words;
    bool once_more;
    std::map<std::string, std::string> expected;
  };

  void restore() const {
    fs::remove_all(at("out"));
    fs::copy(at("first"), at("out"), fs::copy_options::recursive);
  }
  void prepare(const Way& way) const {
    if (!way.once_more) return;
    for (const char* task : {"albedo.photo_00.json", "residual.photo_00.json", "export.albedo.ply.json"}) fs::remove(at("out/work/tasks") / task);
  }

  void expect_found_or_made_good(const std::string& file, const std::function<std::string(std::string)>& damage, const std::string& what) const {
    for (const Way& way : ways_) {
      restore();
      put_bytes(at("out") / file, damage(file_bytes(at("out") / file)));
      prepare(way);
      const std::string when = file + ", " + what + ", " + way.name;
      const ProcessResult ran = run("out", way.words, impatient());
      expect_civil(ran, when);
      EXPECT_NE(ran.code, 3) << when << ": a photograph was left out\n" << ran.err;
      if (ran.code == 0) {
        EXPECT_THAT(differences(way.expected, results("out")), testing::IsEmpty()) << when << ": not noticed";
      } else {
        EXPECT_THAT(ran.err, HasSubstr(at("out").string())) << when << ": the file is not named";
      }
    }
  }

  std::vector<Way> ways_;
  std::vector<std::string> files_;
};

TEST_F(DamageOfWork, FlippedBitsAreFoundOrMadeGood) {
  for (std::size_t i = 0; i < files_.size(); ++i) {
    const std::size_t size = file_bytes(at("first") / files_[i]).size(), byte = pick(i, 0, size), bit = pick(i, 1, 8);
    expect_found_or_made_good(
        files_[i],
        [&](std::string bytes) {
          bytes[byte] = static_cast<char>(bytes[byte] ^ (1 << bit));
          return bytes;
        },
        "bit " + std::to_string(bit) + " of byte " + std::to_string(byte) + " of " + std::to_string(size));
  }
}

TEST_F(DamageOfWork, CutFilesAreFoundOrMadeGood) {
  for (std::size_t i = 0; i < files_.size(); ++i) {
    const std::size_t size = file_bytes(at("first") / files_[i]).size(), left = pick(i, 2, size);
    expect_found_or_made_good(files_[i], [&](const std::string& bytes) { return bytes.substr(0, left); }, "cut to " + std::to_string(left) + " of " + std::to_string(size));
  }
}

TEST_F(Damage, OfTheProjectFileNeverCrashes) {
  TinySceneOptions small;
  small.points = 300;
  small.photographs = 1;
  small.width_px = 32;
  small.height_px = 24;
  small.focal_px = 37;
  small.reference = true;
  const TinyScene s = scene(small);
  const std::string text = file_bytes(s.project);
  const std::vector<std::string> cautious{"--memory", "256MiB"};
  int refused = 0, tried = 0;
  const auto attempt = [&](const std::string& damaged, const std::string& what) {
    put_bytes(s.project, damaged);
    const ProcessResult ran = run("out", cautious, impatient());
    expect_civil(ran, what);
    ++tried;
    refused += ran.code == 2;
    if (ran.code == 2) {
      EXPECT_THAT(ran.err, HasSubstr("project.toml")) << what;
    }
  };
  for (std::size_t length = 0; length < text.size(); length += 1 + text.size() / 40) attempt(text.substr(0, length), "first " + std::to_string(length) + " bytes");
  for (std::uint64_t i = 0; i < 80; ++i) {
    std::string damaged = text;
    const std::size_t byte = pick(i, 3, text.size());
    const char values[] = {0, '\xff', '"', '[', '-', '9', static_cast<char>(text[byte] ^ 1), static_cast<char>(text[byte] ^ 0x80)};
    damaged[byte] = values[pick(i, 4, sizeof values)];
    attempt(damaged, "byte " + std::to_string(byte) + " = " + std::to_string(damaged[byte]));
  }
  EXPECT_GT(refused, tried / 3);
}

class DamageOfClouds : public RunTest, public testing::WithParamInterface<const char*> {
 protected:
  /// A small valid cloud in the wanted format, made by the program itself from a PLY.
  std::string valid(const std::string& extension) {
    TinySceneOptions small;
    small.points = 400;
    small.photographs = 0;
    scene(small);
    const fs::path ply = at("scene/cloud.ply");
    if (extension == "ply") return file_bytes(ply);
    if (extension == "xyz") {
      const PlyVertices v = read_ply(ply);
      std::string text;
      for (std::size_t i = 0; i < v.size(); ++i) text += std::to_string(v.columns[0][i]) + " " + std::to_string(v.columns[1][i]) + " " + std::to_string(v.columns[2][i]) + " 10 20 30\n";
      return text;
    }
    const ProcessResult stored = chiaro({"ingest", ply.string(), "--out", at("valid.chiaro").string()});
    const ProcessResult written = chiaro({"export", at("valid.chiaro").string(), "--out", at("valid." + extension).string()});
    EXPECT_EQ(stored.code, 0) << stored.err;
    EXPECT_EQ(written.code, 0) << written.err;
    return file_bytes(at("valid." + extension));
  }
};

TEST_P(DamageOfClouds, NeverCrashesHangsOrTakesMuchMemory) {
  const std::string extension = GetParam(), bytes = valid(extension), name = "hostile." + extension;
  ASSERT_GT(bytes.size(), 1000u);
  const auto attempt = [&](const std::string& damaged, const std::string& what) {
    put_bytes(at(name), damaged);
    fs::remove_all(at("hostile.chiaro"));
    const ProcessResult ran = chiaro({"ingest", at(name).string(), "--out", at("hostile.chiaro").string(), "--memory", "256MiB"}, impatient());
    expect_civil(ran, what);
    if (ran.code == 1) {
      EXPECT_THAT(ran.err, HasSubstr(name)) << what;
      EXPECT_FALSE(fs::exists(at("hostile.chiaro"))) << what;
    }
  };
  for (int i = 0; i < 15; ++i) attempt(bytes.substr(0, pick(static_cast<std::uint64_t>(i), 5, bytes.size())), "prefix " + std::to_string(i));
  for (std::uint64_t i = 0; i < 60; ++i) {
    // Two of three in the first 400 bytes: headers are where sizes stand.
    const std::size_t byte = pick(i, 6, i % 3 == 0 ? bytes.size() : 400);
    std::string damaged = bytes;
    const char values[] = {0, '\xff', '9', '-', static_cast<char>(bytes[byte] ^ 1), static_cast<char>(bytes[byte] ^ 0x80), '\x7f', ' '};
    damaged[byte] = values[pick(i, 7, sizeof values)];
    attempt(damaged, "byte " + std::to_string(byte) + " = " + std::to_string(damaged[byte]));
  }
}
INSTANTIATE_TEST_SUITE_P(Formats, DamageOfClouds, testing::Values("ply", "las", "pcd", "xyz"), [](const auto& i) { return std::string(i.param); });

class DamageOfInputs : public RunTest {};

TEST_F(DamageOfInputs, PhotographsMasksAndCamerasNeverCrashes) {
  TinySceneOptions small;
  small.points = 300;
  small.photographs = 2;
  small.width_px = 32;
  small.height_px = 24;
  small.focal_px = 37;
  const TinyScene s = scene(small);
  for (const char* file : {"photos/photo_01.exr", "masks/photo_01.png", "sparse/cameras.txt", "sparse/images.txt"}) {
    const std::string bytes = file_bytes(s.folder / file);
    for (std::uint64_t i = 0; i < 16; ++i) {
      const std::size_t byte = pick(i, 8, i % 2 == 0 ? bytes.size() : std::min<std::size_t>(300, bytes.size()));
      std::string damaged = i % 4 == 3 ? bytes.substr(0, byte) : bytes;
      const char values[] = {0, '\xff', '9', '-', static_cast<char>(bytes[byte] ^ 1), static_cast<char>(bytes[byte] ^ 0x80)};
      if (i % 4 != 3) damaged[byte] = values[pick(i, 9, sizeof values)];
      put_bytes(s.folder / file, damaged);
      const std::string what = std::string(file) + ", byte " + std::to_string(byte) + (i % 4 == 3 ? ": cut there" : " = " + std::to_string(damaged[byte]));
      expect_civil(run("out", {"--memory", "256MiB"}, impatient()), what);
    }
    put_bytes(s.folder / file, bytes);
  }
}

}  // namespace
}  // namespace chiaro::test
