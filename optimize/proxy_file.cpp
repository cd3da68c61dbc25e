#include "optimize/proxy_file.h"

#include <cstring>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/hash.h"

namespace chiaro::optimize {
namespace {
constexpr char kMagic[8] = {'C', 'H', 'P', 'R', 'O', 'X', 'Y', '1'};
struct Header {
  char magic[8];
  char store_key[32];
  std::uint64_t surfels;
  std::uint32_t chunks, crc;
};
std::uint32_t checksum(const std::vector<std::uint32_t>& chunks, const std::vector<float>& signs) {
  return crc32c(signs.data(), signs.size() * 4, crc32c(chunks.data(), chunks.size() * 4));
}
}  // namespace

void write_proxy(const Proxy& proxy, const std::string& store_key, const std::filesystem::path& path) {
  // The normals as oriented, in full: reading needs no second pass over the cameras.
  std::vector<float> normals(3 * proxy.size());
  for (std::size_t i = 0; i < proxy.size(); ++i)
    for (std::size_t c = 0; c < 3; ++c) normals[3 * i + c] = proxy.normal[i][static_cast<Eigen::Index>(c)];
  Header header{};
  std::memcpy(header.magic, kMagic, 8);
  std::memcpy(header.store_key, store_key.data(), std::min<std::size_t>(32, store_key.size()));
  header.surfels = proxy.size();
  header.chunks = static_cast<std::uint32_t>(proxy.chunks.size());
  header.crc = checksum(proxy.chunks, normals);
  AtomicFile file(path);
  file.append(&header, sizeof header);
  file.append(proxy.chunks.data(), proxy.chunks.size() * 4);
  file.append(normals.data(), normals.size() * 4);
  file.commit();
}

Proxy read_proxy(const stream::Store& store, const std::filesystem::path& path) {
  const File file(path, File::Mode::kRead);
  Header header{};
  file.read_at(0, &header, sizeof header);
  if (std::memcmp(header.magic, kMagic, 8) != 0) throw Error(concat(path.string(), ": not a proxy file"));
  if (std::strncmp(header.store_key, store.manifest().key.c_str(), std::min<std::size_t>(32, store.manifest().key.size())) != 0)
    throw Error(concat(path.string(), ": belongs to another store"));
  if (header.chunks > store.chunks().size() || file.size() != sizeof header + header.chunks * std::uint64_t{4} + header.surfels * 12)
    throw Error(concat(path.string(), ": ", header.chunks, " chunks and ", header.surfels, " surfels do not fit its ", file.size(), " bytes"));
  surfels::WorkingSet cut;
  cut.chunks.resize(header.chunks);
  file.read_at(sizeof header, cut.chunks.data(), cut.chunks.size() * 4);
  for (const std::uint32_t c : cut.chunks)
    if (c >= store.chunks().size()) throw Error(concat(path.string(), ": chunk ", c, " of ", store.chunks().size()));
  std::vector<float> normals(header.surfels * 3);
  file.read_at(sizeof header + cut.chunks.size() * 4, normals.data(), normals.size() * 4);
  if (checksum(cut.chunks, normals) != header.crc) throw Error(concat(path.string(), ": checksum is wrong"));
  Proxy proxy = load_proxy(store, cut);
  if (proxy.size() != header.surfels) throw Error(concat(path.string(), ": ", header.surfels, " surfels, the store's cut has ", proxy.size()));
  for (std::size_t i = 0; i < proxy.size(); ++i) proxy.normal[i] = {normals[3 * i], normals[3 * i + 1], normals[3 * i + 2]};
  return proxy;
}

void write_floats(const std::vector<float>& values, const std::filesystem::path& path) {
  const std::uint32_t crc = crc32c(values.data(), values.size() * 4);
  AtomicFile file(path);
  file.append(values.data(), values.size() * 4);
  file.append(&crc, 4);
  file.commit();
}

void write_floats_for_now(const std::vector<float>& values, const std::filesystem::path& path) {
  const std::uint32_t crc = crc32c(values.data(), values.size() * 4);
  std::error_code code;
  // Not cut to nothing first: file systems take that for a replacement, and write it to disk at once.
  File file(path, std::filesystem::file_size(path, code) == values.size() * 4 + 4 && !code ? File::Mode::kReadWrite : File::Mode::kCreate);
  file.write_at(0, values.data(), values.size() * 4);
  file.write_at(values.size() * 4, &crc, 4);
  file.close();
}

std::vector<float> read_floats(const std::filesystem::path& path, std::size_t count) {
  const File file(path, File::Mode::kRead);
  if (file.size() != count * 4 + 4) throw Error(concat(path.string(), ": ", file.size(), " bytes, expected ", count * 4 + 4));
  std::vector<float> values(count);
  std::uint32_t crc = 0;
  file.read_at(0, values.data(), count * 4);
  file.read_at(count * 4, &crc, 4);
  if (crc != crc32c(values.data(), values.size() * 4)) throw Error(concat(path.string(), ": checksum is wrong"));
  return values;
}

}  // namespace chiaro::optimize
