#include "stream/photo/camera_files.h"

#include <algorithm>
#include <map>
#include <set>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/text.h"
#include "stream/photo/camera_files_detail.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

bool is_file(const fs::path& path) {
  std::error_code ignored;
  return fs::is_regular_file(path, ignored);
}
bool is_folder(const fs::path& path) {
  std::error_code ignored;
  return fs::is_directory(path, ignored);
}

bool has_colmap(const fs::path& folder, const char* extension) {
  return is_file(folder / concat("cameras", extension)) && is_file(folder / concat("images", extension));
}

/// COLMAP numbers the models of photographs that it could not connect.
void note_further_models(const fs::path& model, std::vector<std::string>& notes) {
  if (model.filename() != "0") return;
  std::string others;
  for (int k = 1; has_colmap(model.parent_path() / std::to_string(k), ".bin") || has_colmap(model.parent_path() / std::to_string(k), ".txt"); ++k) others += concat(k > 1 ? ", " : "", k);
  if (!others.empty()) notes.push_back(concat(model.string(), ": is read; there are further models beside it (", others, "), whose photographs are not connected with its own: they are not read"));
}

std::vector<Camera> read_folder(const fs::path& folder, std::vector<std::string>& notes) {
  for (const char* inside : {"", "0", "sparse", "sparse/0"}) {
    const fs::path at = *inside ? folder / inside : folder;
    const bool binary = has_colmap(at, ".bin"), text = has_colmap(at, ".txt");
    if (!binary && !text) continue;
    note_further_models(at, notes);
    if (binary && text) notes.push_back(concat(at.string(), ": holds a binary and a text model; the binary one is used"));
    return detail::read_colmap(at, binary, notes);
  }
  throw Error(concat(folder.string(), ": no cameras found, expected a COLMAP model: cameras.bin and images.bin, or cameras.txt and images.txt"));
}

/// Path parts, whichever slash the writer used: camera files travel between systems.
std::vector<std::string> parts_of(const std::string& path) {
  std::vector<std::string> parts(1);
  for (const char c : path) {
    if (c == '/' || c == '\\')
      parts.emplace_back();
    else
      parts.back().push_back(c);
  }
  std::erase_if(parts, [](const std::string& part) { return part.empty() || part == "."; });
  return parts;
}

std::string stem_of(const std::string& file_name) {
  const std::size_t dot = file_name.rfind('.');
  return dot == std::string::npos || dot == 0 ? file_name : file_name.substr(0, dot);
}

/// How many folders above the file name agree, and whether one disagrees before either path ends.
struct Agreement {
  std::size_t folders = 0;
  bool conflict = false;
};

Agreement compare_folders(const std::vector<std::string>& a, const std::vector<std::string>& b) {
  Agreement out;
  for (std::size_t i = 2; i <= std::min(a.size(), b.size()); ++i) {
    if (a[a.size() - i] != b[b.size() - i]) {
      out.conflict = true;
      break;
    }
    ++out.folders;
  }
  return out;
}

struct Candidates {
  std::vector<const Camera*> cameras;
  const std::vector<std::string>* photograph = nullptr;

  const Camera* best() const {
    const Camera* best = nullptr;
    std::size_t most = 0, ties = 0;
    for (const Camera* camera : cameras) {
      const std::size_t folders = compare_folders(parts_of(camera->photograph), *photograph).folders;
      if (best && folders < most) continue;
      ties = best && folders == most ? ties + 1 : 1;
      if (!best || folders > most) best = camera;
      most = folders;
    }
    if (ties <= 1) return best;
    std::string names;
    for (std::size_t i = 0; i < cameras.size() && i < 5; ++i) names += concat(i ? ", \"" : "\"", cameras[i]->photograph, "\"");
    throw Error(concat("photograph \"", photograph->back(), "\" fits ", cameras.size(), " cameras equally well (", names, "): rename files or keep their folders"));
  }
};

}  // namespace

std::vector<Camera> read_cameras(const fs::path& folder_or_file, std::vector<std::string>& notes) {
  if (is_folder(folder_or_file)) return read_folder(folder_or_file, notes);
  if (!is_file(folder_or_file)) throw Error(concat(folder_or_file.string(), ": cameras not found: no such file or folder"));
  const std::string extension = lower_extension(folder_or_file), stem = folder_or_file.stem().string();
  if (extension == ".xml") return detail::read_metashape(folder_or_file, notes);
  if ((extension == ".bin" || extension == ".txt") && (stem == "cameras" || stem == "images")) {
    const fs::path folder = folder_or_file.has_parent_path() ? folder_or_file.parent_path() : fs::path(".");
    if (!has_colmap(folder, extension.c_str()))
      throw Error(concat(folder_or_file.string(), ": a COLMAP model needs cameras", extension, " and images", extension, " side by side"));
    return detail::read_colmap(folder, extension == ".bin", notes);
  }
  throw Error(concat(folder_or_file.string(), ": not a known camera file, expected a COLMAP folder or a Metashape cameras file (.xml)"));
}

const Camera* find_camera(std::span<const Camera> cameras, const std::string& photograph_path) {
  const std::vector<std::string> photograph = parts_of(photograph_path);
  if (photograph.empty()) return nullptr;
  const std::string& name = photograph.back();
  Candidates same_name{{}, &photograph}, label{{}, &photograph}, same_stem{{}, &photograph};
  for (const Camera& camera : cameras) {
    const std::vector<std::string> parts = parts_of(camera.photograph);
    if (parts.empty()) continue;
    if (parts.back() == name)
      same_name.cameras.push_back(&camera);
    else if (parts.back() == stem_of(name))
      label.cameras.push_back(&camera);
    else if (stem_of(parts.back()) == stem_of(name))
      same_stem.cameras.push_back(&camera);
  }
  for (const Candidates& candidates : {same_name, label, same_stem}) {
    if (candidates.cameras.empty()) continue;
    const Camera* best = candidates.best();
    // Where file names repeat across folders ("left/0001.jpg", "right/0001.jpg"), a lone match from another folder is another photograph.
    if (!compare_folders(parts_of(best->photograph), photograph).conflict) return best;
    std::set<std::string> names;
    bool repeated = false;
    for (const Camera& camera : cameras) {
      const std::vector<std::string> parts = parts_of(camera.photograph);
      repeated = repeated || (!parts.empty() && !names.insert(parts.back()).second);
    }
    if (!repeated || compare_folders(parts_of(best->photograph), photograph).folders > 0) return best;
    return nullptr;
  }
  return nullptr;
}

}  // namespace chiaro::stream
