/// The values of a layer's chunk as a layer has them: plane after plane.
#pragma once
#include <cstddef>
#include <span>
#include <vector>

namespace chiaro::tests {

template <class... T>
std::vector<std::byte> planes_of(const std::vector<T>&... planes) {
  std::vector<std::byte> bytes;
  const auto add = [&](std::span<const std::byte> plane) { bytes.insert(bytes.end(), plane.begin(), plane.end()); };
  (add(std::as_bytes(std::span(planes))), ...);
  return bytes;
}

}  // namespace chiaro::tests
