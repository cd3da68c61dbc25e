#include "tests/support/files.h"

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <sstream>
#include <stdexcept>

namespace chiaro::test {
namespace fs = std::filesystem;

std::string file_bytes(const fs::path& path) {
  std::ifstream in(path, std::ios::binary);
  std::ostringstream text;
  text << in.rdbuf();
  return text.str();
}

void put_bytes(const fs::path& path, const std::string& bytes) {
  std::ofstream out(path, std::ios::binary | std::ios::trunc);
  out.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
}

const std::vector<double>& PlyVertices::column(const std::string& name) const {
  const auto found = std::find(names.begin(), names.end(), name);
  if (found == names.end()) throw std::out_of_range("no property " + name);
  return columns[static_cast<std::size_t>(found - names.begin())];
}

namespace {
std::size_t size_of(const std::string& type) {
  if (type == "uchar" || type == "char") return 1;
  if (type == "ushort" || type == "short") return 2;
  if (type == "uint" || type == "int" || type == "float") return 4;
  if (type == "double") return 8;
  throw std::runtime_error("unknown PLY type " + type);
}
template <class T>
double as(const char* at) {
  T v;
  std::memcpy(&v, at, sizeof v);
  return static_cast<double>(v);
}
double value_of(const std::string& type, const char* at) {
  if (type == "uchar") return as<unsigned char>(at);
  if (type == "char") return as<signed char>(at);
  if (type == "ushort") return as<unsigned short>(at);
  if (type == "short") return as<short>(at);
  if (type == "uint") return as<unsigned>(at);
  if (type == "int") return as<int>(at);
  if (type == "float") return as<float>(at);
  return as<double>(at);
}
}  // namespace

PlyVertices read_ply(const fs::path& path) {
  const std::string bytes = file_bytes(path);
  const std::string end = "end_header\n";
  const std::size_t body = bytes.find(end);
  if (body == std::string::npos) throw std::runtime_error(path.string() + ": no PLY header");
  std::istringstream header(bytes.substr(0, body));
  PlyVertices out;
  std::size_t count = 0, stride = 0;
  for (std::string line; std::getline(header, line);) {
    std::istringstream words(line);
    std::string first, second, third;
    words >> first >> second >> third;
    if (first == "format" && second != "binary_little_endian") throw std::runtime_error(path.string() + ": not binary little endian");
    if (first == "element" && second == "vertex") count = std::stoull(third);
    if (first != "property") continue;
    out.types.push_back(second);
    out.names.push_back(third);
    stride += size_of(second);
  }
  if (bytes.size() != body + end.size() + count * stride) throw std::runtime_error(path.string() + ": size does not fit the header");
  out.columns.assign(out.names.size(), std::vector<double>(count));
  const char* at = bytes.data() + body + end.size();
  for (std::size_t i = 0; i < count; ++i)
    for (std::size_t p = 0; p < out.names.size(); ++p) {
      out.columns[p][i] = value_of(out.types[p], at);
      at += size_of(out.types[p]);
    }
  return out;
}

std::map<std::string, std::string> files_below(const fs::path& folder, const std::vector<std::string>& wanted) {
  std::map<std::string, std::string> found;
  for (const auto& entry : fs::recursive_directory_iterator(folder)) {
    if (!entry.is_regular_file()) continue;
    const std::string name = entry.path().lexically_relative(folder).string();
    const bool take = wanted.empty() || std::any_of(wanted.begin(), wanted.end(), [&](const std::string& w) { return name == w || name.starts_with(w + "/"); });
    if (take) found[name] = file_bytes(entry.path());
  }
  return found;
}

std::vector<std::string> differences(const std::map<std::string, std::string>& a, const std::map<std::string, std::string>& b) {
  std::vector<std::string> names;
  for (const auto& [name, bytes] : a) {
    const auto other = b.find(name);
    if (other == b.end() || other->second != bytes) names.push_back(name);
  }
  for (const auto& [name, bytes] : b)
    if (!a.count(name)) names.push_back(name);
  std::sort(names.begin(), names.end());
  return names;
}

fs::path shared_folder() {
  if (const char* set = std::getenv("CHIARO_SHARED")) return set;
  const fs::path beside = fs::path(CHIARO_SOURCE_DIR) / ".." / "shared";
  return fs::exists(beside / "scenes") ? beside : fs::path();
}

}  // namespace chiaro::test
