/// Reaches the loadable module with everything that uses PCL. PCL's I/O library brings VTK along, so it is loaded when first needed and not
/// before. Internal to stream/cloud; pcl_tools.h is the public face.
#pragma once
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "stream/cloud/pcl_module_abi.h"

namespace chiaro::stream {

/// The functions of the module, loaded on the first call. Thread-safe. throws Error naming the places that were searched.
const ChiaroPclFunctions& pcl_functions();

/// Calls a function of the module that reports failure as a message. throws Error with that message.
void check_pcl(int code, const char* message, const std::string& what);

/// A cloud that PCL read, as rows in PCL's memory.
struct PclCloud {
  struct Field {
    std::string name;
    std::size_t offset = 0, bytes = 0, count = 0;
    char type = 'F';
  };
  std::vector<Field> fields;
  std::size_t row_bytes = 0, num_points = 0;
  std::span<const std::byte> rows;
  std::shared_ptr<void> owner;
};

/// Reads a PCD of any encoding whole. The caller has compared the header's numbers with the file's size and the memory allowed.
PclCloud pcl_read_pcd(const std::filesystem::path& path);

}  // namespace chiaro::stream
