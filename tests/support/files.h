/// Files as tests see them: their bytes, the vertices of a PLY, and what lies in a folder.
#pragma once
#include <filesystem>
#include <map>
#include <string>
#include <vector>

namespace chiaro::test {

std::string file_bytes(const std::filesystem::path& path);
void put_bytes(const std::filesystem::path& path, const std::string& bytes);

/// Vertices of a binary little-endian PLY without lists, read without the program's own reader.
struct PlyVertices {
  std::vector<std::string> names;      ///< "x", "nx", …
  std::vector<std::string> types;      ///< "float", "uchar", …
  std::vector<std::vector<double>> columns;   ///< one a property
  std::size_t size() const { return columns.empty() ? 0 : columns[0].size(); }
  /// throws std::out_of_range where there is no such property
  const std::vector<double>& column(const std::string& name) const;
};
PlyVertices read_ply(const std::filesystem::path& path);

/// Relative path -> bytes of every regular file below `folder` that `wanted` (a folder or file relative to it) names; all where it is empty.
std::map<std::string, std::string> files_below(const std::filesystem::path& folder, const std::vector<std::string>& wanted = {});

/// Relative paths that differ between two such maps, in order; empty = the same.
std::vector<std::string> differences(const std::map<std::string, std::string>& a, const std::map<std::string, std::string>& b);

/// Folder of data beside the source tree (or where CHIARO_SHARED says); empty where it is absent.
std::filesystem::path shared_folder();

}  // namespace chiaro::test
