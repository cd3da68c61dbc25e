/// What tests that run the executable on the tiny scene share. Include after defining CHIARO_EXECUTABLE (the build does).
#pragma once
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdlib>
#include <nlohmann/json.hpp>

#include "stream/base/file.h"
#include "tests/support/files.h"
#include "tests/support/process.h"
#include "tests/support/tiny_scene.h"

namespace chiaro::test {

/// What a user keeps of a run: no times, no paths, so equal work must give equal bytes.
inline const std::vector<std::string> kResults{"albedo.ply", "lights.json", "photographs"};

/// Another build of the program to test, such as one with sanitizers (their memory is then not judged); null = the one of this build.
inline const char* other_executable() { return std::getenv("CHIARO_TEST_EXECUTABLE"); }

/// Each run syncs dozens of files: in memory, where the system has such a folder, that costs nothing.
inline std::filesystem::path quick_disk() { return std::filesystem::exists("/dev/shm") ? std::filesystem::path("/dev/shm") : std::filesystem::path(); }

class RunTest : public testing::Test {
 protected:
  explicit RunTest(const std::filesystem::path& parent = quick_disk()) : scratch_(parent) {}

  std::filesystem::path at(const std::string& name) const { return scratch_.path() / name; }

  TinyScene scene(const TinySceneOptions& options = {}, const std::string& folder = "scene") const { return write_tiny_scene(at(folder), options); }

  ProcessResult chiaro(std::vector<std::string> words, const ProcessOptions& options = {}) const {
    words.insert(words.begin(), other_executable() ? other_executable() : CHIARO_EXECUTABLE);
    return run_process(words, options);
  }

  /// `chiaro run scene/project.toml --out OUT MORE…`
  ProcessResult run(const std::string& out, std::vector<std::string> more = {}, const ProcessOptions& options = {}, const std::string& folder = "scene") const {
    std::vector<std::string> words{"run", at(folder + "/project.toml").string(), "--out", at(out).string()};
    words.insert(words.end(), more.begin(), more.end());
    return chiaro(words, options);
  }

  nlohmann::json json(const std::string& file) const { return nlohmann::json::parse(file_bytes(at(file)), nullptr, false); }

  std::map<std::string, std::string> results(const std::string& out) const { return files_below(at(out), kResults); }

  /// Names of files below OUT that look half-written.
  std::vector<std::string> parts(const std::string& out) const {
    std::vector<std::string> names;
    for (const auto& entry : std::filesystem::recursive_directory_iterator(at(out))) {
      const std::string name = entry.path().filename().string();
      if (name.find(".part") != std::string::npos) names.push_back(entry.path().lexically_relative(at(out)).string());
    }
    return names;
  }

  /// Replaces the only occurrence of `from` in a text file.
  void edit(const std::string& file, const std::string& from, const std::string& to) const {
    std::string text = file_bytes(at(file));
    const std::size_t found = text.find(from);
    ASSERT_NE(found, std::string::npos) << from;
    text.replace(found, from.size(), to);
    put_bytes(at(file), text);
  }

  ScratchFolder scratch_;
};

/// Relative albedo error of an exported PLY against the truth, over points that some photograph saw.
struct AlbedoError {
  double absolute = 0;   ///< mean |a - t| / t
  double scaled = 0;     ///< the same after one factor (median of t / a)
  double factor = 1;
  std::size_t seen = 0, points = 0;
};
AlbedoError albedo_error(const PlyVertices& ply, const std::vector<std::array<double, 3>>& truth);

}  // namespace chiaro::test
