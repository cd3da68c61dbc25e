#include "tools/store_results.h"

#include <algorithm>
#include <vector>

#include "stream/base/error.h"
#include "stream/store/layer.h"

namespace chiaro::tools {

void require_no_results(const std::filesystem::path& store_path, const std::string& mine) {
  std::vector<std::string> results;
  std::error_code code;
  for (std::filesystem::directory_iterator it(store_path / "layers", code), end; !code && it != end; it.increment(code)) {
    const std::string name = it->path().filename().string();
    if (stream::is_layer_name(name) && name != "input" && name != mine) results.push_back(name);
  }
  if (results.empty()) return;
  std::sort(results.begin(), results.end());
  std::string names;
  for (const std::string& name : results) names += concat(names.empty() ? "" : ", ", name);
  throw Error(concat(store_path.string(), ": the cloud, or how it is read, is not what this store was made from, and its layers would be lost: ", names,
                     ". Choose another --out, or remove them from its folder layers"));
}

}  // namespace chiaro::tools
