#include <dlfcn.h>
#include <unistd.h>

#include <climits>

#include "stream/base/error.h"
#include "stream/cloud/pcl_module.h"

namespace chiaro::stream {
namespace {

namespace fs = std::filesystem;

constexpr const char* kFileName = "libchiaro_pcl.so";

std::vector<fs::path> places() {
  std::vector<fs::path> folders;
  std::error_code code;
  const fs::path executable = fs::read_symlink("/proc/self/exe", code);
  if (!code) folders = {executable.parent_path(), executable.parent_path() / ".." / "lib" / "chiaro"};
  folders.emplace_back(CHIARO_PCL_BUILD_FOLDER);
  return folders;
}

const ChiaroPclFunctions& load() {
  std::string searched;
  for (const fs::path& folder : places()) {
    const fs::path path = folder / kFileName;
    std::error_code code;
    searched += (searched.empty() ? "" : ", ") + folder.string();
    if (!fs::exists(path, code)) continue;
    // Never closed: VTK and FLANN leave thread-local and static state behind that must outlive every caller.
    void* module = ::dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL);
    if (!module) throw Error(concat(path.string(), ": cannot be loaded: ", ::dlerror()));
    const auto entry = reinterpret_cast<decltype(&chiaro_pcl_functions)>(::dlsym(module, "chiaro_pcl_functions"));
    const ChiaroPclFunctions* functions = entry ? entry() : nullptr;
    if (!functions || functions->abi != CHIARO_PCL_ABI) throw Error(concat(path.string(), ": is not the module of this version of chiaro"));
    return *functions;
  }
  throw Error(concat(kFileName, " is needed here (compressed PCD, outlier removal or ICP through PCL) and was not found in ", searched));
}

}  // namespace

const ChiaroPclFunctions& pcl_functions() {
  static const ChiaroPclFunctions& functions = load();
  return functions;
}

void check_pcl(int code, const char* message, const std::string& what) {
  if (code != 0) throw Error(concat(what, ": ", message));
}

PclCloud pcl_read_pcd(const fs::path& path) {
  const ChiaroPclFunctions& functions = pcl_functions();
  char message[CHIARO_PCL_MESSAGE_BYTES] = {};
  void* handle = nullptr;
  check_pcl(functions.read_pcd(path.c_str(), &handle, message), message, path.string());
  PclCloud cloud;
  cloud.owner = std::shared_ptr<void>(handle, functions.free_cloud);
  for (std::size_t i = 0; i < functions.num_fields(handle); ++i) {
    ChiaroPclField field;
    functions.field(handle, i, &field);
    cloud.fields.push_back({field.name, field.offset, field.bytes, field.count, field.type});
  }
  const void* data = nullptr;
  std::size_t bytes = 0;
  functions.rows(handle, &data, &bytes, &cloud.row_bytes, &cloud.num_points);
  if (cloud.row_bytes == 0 || bytes / cloud.row_bytes < cloud.num_points)
    throw Error(concat(path.string(), ": PCL gave ", bytes, " bytes for ", cloud.num_points, " points"));
  cloud.rows = {static_cast<const std::byte*>(data), bytes};
  return cloud;
}

}  // namespace chiaro::stream
