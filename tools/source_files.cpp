#include "tools/source_files.h"

#include <algorithm>
#include <cstring>
#include <utility>

#include "stream/base/error.h"
#include "stream/base/hash.h"

namespace chiaro::tools {

using stream::PointProperty;

SourceFiles::SourceFiles(const stream::Manifest& manifest, std::vector<std::filesystem::path> files, const std::vector<std::string>& replaced, std::uint64_t memory_bytes, Reporter& report)
    : manifest_(manifest), files_(std::move(files)), memory_bytes_(memory_bytes) {
  for (const std::filesystem::path& file : files_) {
    const auto reader = stream::open_points(file, memory_bytes);
    schemas_.push_back(reader->schema());
    position_is_double_ |= reader->schema().position_is_double;
  }
  choose_carried(replaced, report);
}

bool SourceFiles::unchanged(const stream::Manifest& manifest, const std::vector<std::filesystem::path>& files, std::string& why) {
  if (files.empty() || files.size() != manifest.source_fingerprints.size() || files.size() != manifest.source_points.size()) {
    why = "the store does not name its source files";
    return false;
  }
  for (std::size_t i = 0; i < files.size(); ++i) {
    std::error_code code;
    if (!std::filesystem::is_regular_file(files[i], code)) {
      why = concat(files[i].string(), " is not there any more");
      return false;
    }
    if (file_fingerprint(files[i]) != manifest.source_fingerprints[i]) {
      why = concat(files[i].string(), " has changed since it was ingested");
      return false;
    }
  }
  return true;
}

const stream::PointBlock& SourceFiles::read(std::size_t max_points) {
  while (!reader_ || left_in_file_ == 0) {
    file_ = reader_ ? file_ + 1 : 0;
    if (file_ >= schemas_.size()) throw Error("source files: fewer points than the store counts");
    reader_ = stream::open_points(files_[file_], memory_bytes_);
    left_in_file_ = manifest_.source_points[file_];
    fields_.clear();
    for (const PointProperty& p : carried_) fields_.push_back(*find_field(schemas_[file_], p));
  }
  if (!reader_->read(block_, static_cast<std::size_t>(std::min<std::uint64_t>(max_points, left_in_file_))))
    throw Error(concat(files_[file_].string(), ": ends early, ", left_in_file_, " of ", manifest_.source_points[file_], " points are missing"));
  left_in_file_ -= block_.size();
  return block_;
}

std::byte* SourceFiles::copy_carried(std::size_t i, std::byte* to) const {
  const std::byte* from = block_.extras.data() + i * schemas_[file_].extra_bytes();
  for (const CarriedField& f : fields_) {
    std::memcpy(to, from + f.offset, f.bytes);
    to += f.bytes;
  }
  return to;
}

std::optional<SourceFiles::CarriedField> SourceFiles::find_field(const stream::PointSchema& schema, const PointProperty& wanted) {
  std::size_t offset = 0;
  for (const PointProperty& p : schema.extras) {
    if (p.name == wanted.name && p.type == wanted.type) return CarriedField{offset, stream::scalar_bytes(p.type)};
    offset += stream::scalar_bytes(p.type);
  }
  return std::nullopt;
}

void SourceFiles::choose_carried(const std::vector<std::string>& replaced, Reporter& report) {
  for (const PointProperty& p : schemas_.front().extras) {
    if (std::find(replaced.begin(), replaced.end(), p.name) != replaced.end()) {
      report.note(concat("export: the input's property \"", p.name, "\" is replaced by the result's"));
    } else if (std::all_of(schemas_.begin(), schemas_.end(), [&](const stream::PointSchema& s) { return find_field(s, p).has_value(); })) {
      carried_.push_back(p);
    } else {
      report.note(concat("export: the input's property \"", p.name, "\" is left out: not every source file has it"));
    }
  }
}

}  // namespace chiaro::tools
