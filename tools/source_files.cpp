#include "tools/source_files.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <set>
#include <type_traits>
#include <utility>

#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/cloud/scalars.h"

namespace chiaro::tools {

using stream::PointProperty;
using stream::ScalarType;

namespace {

/// Without blanks and other characters than ASCII's, which not every format, and not every program, takes. A character of several bytes becomes one '_'.
std::string plain_name(const std::string& name) {
  std::string plain;
  for (const char c : name) {
    const auto byte = static_cast<unsigned char>(c);
    if ((byte & 0xc0) == 0x80) continue;   // a further byte of UTF-8
    plain += byte > ' ' && byte < 127 ? c : '_';
  }
  return plain.empty() ? "unnamed" : plain;
}

/// As far as doubles of that size, and numbers that were written in decimal, say it.
bool is_whole(double steps) { return std::abs(steps - std::round(steps)) <= std::max(1e-6, 0x1p-50 * std::abs(steps)); }

bool is_unsigned(ScalarType type) { return stream::with_type(type, [](auto zero) { return std::is_unsigned_v<decltype(zero)>; }); }

/// Of the floating point types that hold all values of an integer, the shorter one.
ScalarType float_for(ScalarType type) {
  constexpr std::size_t kWholeInFloat = 2;   // bytes
  return type == ScalarType::kF64 || (!stream::is_float(type) && stream::scalar_bytes(type) > kWholeInFloat) ? ScalarType::kF64 : ScalarType::kF32;
}

/// The shortest type that holds what two files have under one name; double where none holds all of it.
ScalarType common_type(ScalarType a, ScalarType b) {
  if (a == b) return a;
  if (stream::is_float(a) || stream::is_float(b)) return float_for(a) == ScalarType::kF64 ? ScalarType::kF64 : float_for(b);
  const std::size_t bytes_a = stream::scalar_bytes(a), bytes_b = stream::scalar_bytes(b);
  if (is_unsigned(a) == is_unsigned(b)) return bytes_a > bytes_b ? a : b;
  const std::size_t wanted = std::max(is_unsigned(a) ? 2 * bytes_a : bytes_a, is_unsigned(b) ? 2 * bytes_b : bytes_b);   // with a sign
  for (const ScalarType type : {ScalarType::kI16, ScalarType::kI32, ScalarType::kI64})
    if (stream::scalar_bytes(type) == wanted) return type;
  return ScalarType::kF64;
}

}  // namespace

SourceFiles::SourceFiles(const stream::Manifest& manifest, std::vector<std::filesystem::path> files, const Carry& carry, std::uint64_t memory_bytes, Reporter& report)
    : manifest_(manifest), files_(std::move(files)), memory_bytes_(memory_bytes) {
  for (const std::filesystem::path& file : files_) {
    const auto reader = stream::open_points(file, memory_bytes);
    schemas_.push_back(reader->schema());
    position_is_double_ |= reader->schema().position_is_double;
  }
  choose_carried(carry, report);
}

std::optional<double> SourceFiles::position_step() const {
  double step = 0;
  for (const stream::PointSchema& schema : schemas_) {
    if (!schema.grid) return std::nullopt;
    const double finest = schema.grid->scale.cwiseAbs().minCoeff();
    step = step > 0 ? std::min(step, finest) : finest;
  }
  if (!(step > 0) || !std::isfinite(step)) return std::nullopt;
  return step;
}

std::optional<stream::PositionGrid> SourceFiles::position_grid() const {
  const std::optional<double> step = position_step();
  if (!step) return std::nullopt;
  const stream::PositionGrid& first = *schemas_.front().grid;
  bool are_multiples = true;
  for (int axis = 0; axis < 3; ++axis) {
    const double scale = std::abs(first.scale[axis]);
    for (const stream::PointSchema& schema : schemas_)
      if (std::abs(schema.grid->scale[axis]) != scale || !is_whole((schema.grid->add[axis] - first.add[axis]) / scale)) return std::nullopt;
    are_multiples = are_multiples && is_whole(scale / *step) && is_whole(first.add[axis] / *step);
  }
  return are_multiples ? std::nullopt : std::optional(first);
}

std::string SourceFiles::coordinate_system() const {
  const std::string& first = schemas_.front().coordinate_system;
  return std::all_of(schemas_.begin(), schemas_.end(), [&](const stream::PointSchema& s) { return s.coordinate_system == first; }) ? first : std::string();
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
    for (std::size_t k = 0; k < carried_.size(); ++k) {
      fields_.push_back(*find_field(schemas_[file_], carried_from_[k]));
      fields_.back().written = carried_[k].type;
    }
  }
  if (!reader_->read(block_, static_cast<std::size_t>(std::min<std::uint64_t>(max_points, left_in_file_))))
    throw Error(concat(files_[file_].string(), ": ends early, ", left_in_file_, " of ", manifest_.source_points[file_], " points are missing"));
  left_in_file_ -= block_.size();
  return block_;
}

std::byte* SourceFiles::copy_carried(std::size_t i, std::byte* to) const {
  const std::byte* from = block_.extras.data() + i * schemas_[file_].extra_bytes();
  for (const CarriedField& f : fields_) {
    const std::size_t bytes = stream::scalar_bytes(f.written);
    if (f.type == f.written)
      std::memcpy(to, from + f.offset, bytes);
    else
      stream::store_scalar(f.written, stream::load_scalar(f.type, from + f.offset), to);   // which holds it: see common_type()
    to += bytes;
  }
  return to;
}

std::optional<SourceFiles::CarriedField> SourceFiles::find_field(const stream::PointSchema& schema, const std::string& name) {
  std::size_t offset = 0;
  for (const PointProperty& p : schema.extras) {
    if (p.name == name) return CarriedField{offset, p.type, p.type};
    offset += stream::scalar_bytes(p.type);
  }
  return std::nullopt;
}

void SourceFiles::choose_carried(const Carry& carry, Reporter& report) {
  std::set<std::string> chosen;
  for (const stream::PointSchema& schema : schemas_)
    for (const PointProperty& p : schema.extras)
      if (chosen.insert(p.name).second) choose(p, carry, report);
}

void SourceFiles::choose(PointProperty property, const Carry& carry, Reporter& report) {
  if (std::find(carry.replaced.begin(), carry.replaced.end(), property.name) != carry.replaced.end()) {
    report.note(concat("export: the input's property \"", property.name, "\" is replaced by the result's"));
    return;
  }
  const ScalarType first = property.type;
  bool differs = false;
  for (const stream::PointSchema& schema : schemas_) {
    const auto field = find_field(schema, property.name);
    if (!field) {
      report.note(concat("export: the input's property \"", property.name, "\" is left out: not every source file has it"));
      return;
    }
    differs = differs || field->type != first;
    property.type = common_type(property.type, field->type);
  }
  if (differs) report.note(concat("export: the input's property \"", property.name, "\" has several types in the source files and is written as ", stream::scalar_name(property.type)));
  add_carried(property, carry, report);
}

void SourceFiles::add_carried(const PointProperty& property, const Carry& carry, Reporter& report) {
  PointProperty written = property;
  const auto is_taken = [&](const std::string& name) {
    return std::find(carry.replaced.begin(), carry.replaced.end(), name) != carry.replaced.end() ||
           std::any_of(carried_.begin(), carried_.end(), [&](const PointProperty& other) { return other.name == name; });
  };
  const std::string plain = written.name = plain_name(property.name);
  for (int k = 2; is_taken(written.name); ++k) written.name = concat(plain, "_", k);
  if (written.name != property.name) report.note(concat("export: the input's property \"", property.name, "\" is written as \"", written.name, "\""));
  if (!carry.long_integers && (property.type == ScalarType::kI64 || property.type == ScalarType::kU64)) {
    written.type = ScalarType::kF64;
    report.note(concat("export: the input's property \"", property.name, "\" is written as double, exact up to 2^53: the format has no whole numbers of 64 bits"));
  }
  carried_.push_back(written);
  carried_from_.push_back(property.name);
}

}  // namespace chiaro::tools
