/// Points that a run has inserted beside a layer (blend.refine): a store of their own inside the cloud's, STORE/inserted/LAYER.chiaro, with one layer.
#pragma once
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "stream/store/layer.h"
#include "stream/store/store.h"

namespace chiaro::tools {

std::filesystem::path inserted_path(const std::filesystem::path& store, const std::string& layer);

struct InsertedPoints {
  std::unique_ptr<stream::Store> store;
  std::unique_ptr<stream::Layer> layer;
  std::uint64_t seen() const;   ///< points with albedo; those without are of no use
};
/// nullopt where there are none, or the layer is not the one that they were inserted for.
std::optional<InsertedPoints> open_inserted(const stream::Store& store, const std::string& layer);

/// All such stores in a store, whatever their layers, by name.
std::vector<std::filesystem::path> inserted_stores(const std::filesystem::path& store);

}  // namespace chiaro::tools
