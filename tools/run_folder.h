/// Where a run keeps things. One place for all names, so that report, render and status find what run left.
#pragma once
#include <filesystem>
#include <string>

namespace chiaro::tools {

struct RunFolder {
  std::filesystem::path root;

  std::filesystem::path store() const { return root / "store.chiaro"; }
  /// Of the task that writes a layer; the default one has the plain name.
  static std::string blend_task(const std::string& layer) { return layer == "albedo" ? "blend" : "blend/" + layer; }
  static std::string refine_task(const std::string& layer) { return layer == "albedo" ? "refine" : "refine/" + layer; }
  std::filesystem::path lights() const { return root / "lights.json"; }
  std::filesystem::path record() const { return root / "run.json"; }
  std::filesystem::path report() const { return root / "report"; }
  std::filesystem::path pictures(const std::string& photograph_key) const { return root / "photographs" / photograph_key; }

  std::filesystem::path work() const { return root / "work"; }
  std::filesystem::path tasks() const { return work() / "tasks"; }
  /// See progress_log.h.
  std::filesystem::path progress() const { return work() / "progress"; }
  /// Effective project as JSON, written first: what report, render and status read.
  std::filesystem::path project() const { return work() / "project.json"; }
  /// Of the photographs that were used; see camera_record.h.
  std::filesystem::path cameras() const { return work() / "cameras.json"; }
  std::filesystem::path photograph(const std::string& key) const { return work() / "photographs" / key; }
  std::filesystem::path radiance(const std::string& key) const { return photograph(key) / "radiance.raster"; }
  std::filesystem::path gbuffer(const std::string& key) const { return photograph(key) / "gbuffer.raster"; }
  std::filesystem::path albedo(const std::string& key) const { return photograph(key) / "albedo.raster"; }
  std::filesystem::path acquisition(const std::string& name) const { return work() / "acquisitions" / name; }
  /// Sums of a layer that stay for a later run (blend.keep).
  std::filesystem::path kept(const std::string& layer) const { return work() / "kept" / layer; }
  std::filesystem::path scratch() const { return work() / "scratch"; }
};

}  // namespace chiaro::tools
