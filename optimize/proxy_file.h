/// The proxy on disk: which chunks, and which way each normal points.
#pragma once
#include <filesystem>

#include "optimize/proxy.h"

namespace chiaro::optimize {

void write_proxy(const Proxy& proxy, const std::string& store_key, const std::filesystem::path& path);
/// Loads the geometry from the store and the signs from the file. throws Error if the file is damaged or of another store.
Proxy read_proxy(const stream::Store& store, const std::filesystem::path& path);
/// Plain float arrays between stages, with a checksum at the end.
void write_floats(const std::vector<float>& values, const std::filesystem::path& path);
/// The same in place and unsynced, for what is written again before anybody may rely on it.
void write_floats_for_now(const std::vector<float>& values, const std::filesystem::path& path);
std::vector<float> read_floats(const std::filesystem::path& path, std::size_t count);

}  // namespace chiaro::optimize
