// OpenEXR. The header is walked here first: the library would allocate whatever sizes it claims.
#include <ImfChannelList.h>
#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfIO.h>
#include <ImfInputFile.h>
#include <ImfOutputFile.h>
#include <ImfStandardAttributes.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <map>

#include "stream/base/file.h"
#include "stream/base/text.h"
#include "stream/photo/image_io_detail.h"

namespace chiaro::stream {
namespace fs = std::filesystem;
namespace {

struct Window {
  std::int64_t x0 = 0, y0 = 0, x1 = -1, y1 = -1;  // inclusive, as in the file
  std::int64_t width() const { return x1 - x0 + 1; }
  std::int64_t height() const { return y1 - y0 + 1; }
};

/// What the first part of a file says about itself, with every size checked against the file.
class HeaderScan {
 public:
  HeaderScan(const fs::path& path, const ImageLimits& limits) : file_(path, File::Mode::kRead), path_(path), size_(file_.size()) {
    const std::uint32_t version = word(4);
    if ((version & 0xff) != 2) fail("EXR version ", version & 0xff, ", expected 2");
    if (version & 0x800) fail("deep pixels are not supported");
    at_ = 8;
    do {
      while (read_attribute()) {
      }
      first_ = false;
      ++num_parts_;
    } while ((version & 0x1000) && peek() != 0);
    check(limits);
  }
  int num_parts() const { return num_parts_; }

 private:
  template <class... Parts>
  [[noreturn]] void fail(const Parts&... parts) const {
    throw Error(concat(path_.string(), ": ", parts...));
  }
  std::uint32_t word(std::uint64_t at) const {
    std::uint32_t value = 0;
    file_.read_at(at, &value, sizeof value);
    return value;
  }
  unsigned char peek() const {
    unsigned char c = 0;
    file_.read_at(at_, &c, 1);
    return c;
  }
  std::string text() {
    char buffer[256];
    const std::size_t n = file_.read_some_at(at_, buffer, sizeof buffer);
    const char* end = static_cast<const char*>(std::memchr(buffer, 0, n));
    if (!end) fail("header text at offset ", at_, " does not end");
    at_ += static_cast<std::uint64_t>(end - buffer) + 1;
    std::string out(static_cast<const char*>(buffer), end);
    std::replace_if(out.begin(), out.end(), [](char c) { return c < 32 || c > 126; }, '?');  // it may end up in a message
    return out;
  }

  bool read_attribute() {
    const std::string name = text();
    if (name.empty()) return false;
    if (++num_attributes_ > 10000) fail("header has more than 10000 attributes");
    const std::string type = text();
    const std::uint32_t bytes = word(at_);
    at_ += 4;
    if (bytes > size_ - at_) fail("header attribute \"", name, "\" claims ", bytes, " bytes at offset ", at_, ", ", size_ - at_, " left");
    if (type == "preview" && (bytes < 8 || std::uint64_t{word(at_)} * word(at_ + 4) != (bytes - 8) / 4)) fail("preview picture of a wrong size");
    check_fixed_size(name, type, bytes);
    if (type == "stringvector") check_strings(name, bytes);
    if (type == "chlist") check_channels(bytes, first_ && name == "channels");
    if (first_) {
      if (name == "dataWindow" && bytes == 16) data_ = window();
      if (name == "displayWindow" && bytes == 16) display_ = window();
      if (name == "compression" && bytes == 1) compression_ = peek();
      if (name == "tiles" && bytes == 9) tile_ = {word(at_), word(at_ + 4)};
    }
    at_ += bytes;
    return true;
  }

  // The library reads values of these types without looking at the size in the file: with another size it would take what follows for something else.
  void check_fixed_size(const std::string& name, const std::string& type, std::uint32_t bytes) const {
    static const std::map<std::string, std::uint32_t> sizes{{"box2i", 16}, {"box2f", 16}, {"chromaticities", 32}, {"compression", 1}, {"deepImageState", 1}, {"double", 8}, {"envmap", 1}, {"float", 4},
                                                            {"int", 4}, {"keycode", 28}, {"lineOrder", 1}, {"m33f", 36}, {"m33d", 72}, {"m44f", 64}, {"m44d", 128}, {"rational", 8},
                                                            {"tiledesc", 9}, {"timecode", 8}, {"v2i", 8}, {"v2f", 8}, {"v2d", 16}, {"v3i", 12}, {"v3f", 12}, {"v3d", 24}};
    const auto known = sizes.find(type);
    if (known != sizes.end() && known->second != bytes) fail("header attribute \"", name, "\" of type ", type, " has ", bytes, " bytes, expected ", known->second);
  }

  void check_strings(const std::string& name, std::uint32_t bytes) const {
    for (std::uint64_t used = 0; used < bytes;) {
      if (bytes - used < 4) fail("header attribute \"", name, "\" is broken at offset ", at_ + used);
      const std::uint64_t length = word(at_ + used);
      if (length > bytes - used - 4) fail("header attribute \"", name, "\" claims a text of ", length, " bytes at offset ", at_ + used);
      used += 4 + length;
    }
  }

  void check_channels(std::uint32_t bytes, bool count) {
    if (bytes > 1u << 16) fail("channel list of ", bytes, " bytes, expected at most ", 1u << 16);
    std::vector<char> list(bytes);
    file_.read_at(at_, list.data(), list.size());
    std::size_t i = 0;
    while (i < list.size() && list[i] != 0) {
      while (i < list.size() && list[i] != 0) ++i;
      i += 1 + 16;
      num_channels_ += count;
    }
    if (i + 1 != list.size()) fail("channel list at offset ", at_, " does not end where it should");
  }

  Window window() const {
    Window w;
    std::array<std::int32_t, 4> v{};
    file_.read_at(at_, v.data(), sizeof v);
    w.x0 = v[0];
    w.y0 = v[1];
    w.x1 = v[2];
    w.y1 = v[3];
    return w;
  }

  void check(const ImageLimits& limits) const {
    constexpr std::int64_t kMaxCoordinate = 1 << 24;  // origins beyond it would overflow int arithmetic on pixels
    for (const Window& w : {data_, display_}) {
      if (w.x1 < w.x0 || w.y1 < w.y0) fail("data or display window missing or empty");
      if (std::max({std::abs(w.x0), std::abs(w.y0), std::abs(w.x1), std::abs(w.y1)}) > kMaxCoordinate) fail("data or display window reaches beyond ", kMaxCoordinate);
      detail::check_size(path_, static_cast<std::uint64_t>(w.width()), static_cast<std::uint64_t>(w.height()), limits);
    }
    constexpr std::array<std::uint64_t, 10> kLines = {1, 1, 1, 16, 32, 16, 32, 32, 32, 256};
    if (compression_ >= kLines.size()) fail("compression ", int{compression_}, " is not known");
    const std::uint64_t width = static_cast<std::uint64_t>(data_.width()), height = static_cast<std::uint64_t>(data_.height());
    std::uint64_t lines = kLines[compression_], chunks = (height + lines - 1) / lines, columns = width;
    if (tile_[0] > 0 && tile_[1] > 0) {
      lines = tile_[1];
      columns = (width + tile_[0] - 1) / tile_[0] * tile_[0];
      chunks = (width + tile_[0] - 1) / tile_[0] * ((height + lines - 1) / lines);
    }
    if (lines > limits.max_buffer_bytes) fail("tiles of ", tile_[0], " x ", tile_[1], " pixels");
    detail::check_buffer(path_, columns * lines * std::max<std::uint64_t>(num_channels_, 1) * 4, limits, "one block of lines or row of tiles");
    if (chunks * 8 > size_) fail(chunks, " blocks of pixels claimed, the file has ", size_, " bytes");
  }

  File file_;
  fs::path path_;
  std::uint64_t size_ = 0, at_ = 0, num_channels_ = 0;
  int num_attributes_ = 0, num_parts_ = 0;
  bool first_ = true;
  Window data_, display_;
  unsigned char compression_ = 0;
  std::array<std::uint64_t, 2> tile_{};
};

/// Runs calls into OpenEXR, whose exceptions do not name our file.
template <class Call>
auto named(const fs::path& path, Call&& call) {
  try {
    return call();
  } catch (const Error&) {
    throw;
  } catch (const std::exception& error) {
    throw Error(concat(path.string(), ": EXR: ", error.what()));
  }
}

class FileIn : public Imf::IStream {
 public:
  explicit FileIn(const fs::path& path) : Imf::IStream(path.c_str()), file_(path, File::Mode::kRead), size_(file_.size()) {}
  bool read(char out[], int n) override {
    if (n < 0 || static_cast<std::uint64_t>(n) > size_ - std::min(at_, size_))
      throw Error(concat(fileName(), ": file ends early: ", n, " bytes wanted at offset ", at_, " of ", size_));
    file_.read_at(at_, out, static_cast<std::size_t>(n));
    at_ += static_cast<std::uint64_t>(n);
    return at_ < size_;
  }
  std::uint64_t tellg() override { return at_; }
  void seekg(std::uint64_t at) override { at_ = at; }

 private:
  File file_;
  std::uint64_t size_ = 0, at_ = 0;
};

std::vector<std::string> all_names(const Imf::ChannelList& list) {
  std::vector<std::string> names;
  for (auto it = list.begin(); it != list.end(); ++it) names.emplace_back(it.name());
  return names;
}

std::string joined(const std::vector<std::string>& names) {
  std::string text;
  for (std::size_t i = 0; i < names.size() && i < 30; ++i) text += concat(i ? ", " : "", names[i]);
  return text + (names.size() > 30 ? ", ..." : "");
}

/// A picture of one channel is grey; one of distances is no photograph.
std::string only_channel(const fs::path& path, const std::string& name, ImageInfo& info) {
  const std::string last = lower(name.substr(name.rfind('.') + 1));
  if (last == "z" || last == "depth") throw Error(concat(path.string(), ": holds the channel \"", name, "\" alone, which is a depth, expected R, G, B or Y", info.notes.empty() ? "" : ", in the first part of the file"));
  info.notes.push_back(concat("its only channel, \"", name, "\", is taken as grey"));
  return name;
}

/// R, G, B (A) of the file itself or of its only layer; else Y; else its only channel.
std::vector<std::string> colour_names(const fs::path& path, const Imf::ChannelList& list, ImageInfo& info) {
  const std::vector<std::string> names = all_names(list);
  const auto has = [&](const std::string& name) { return list.findChannel(name.c_str()) != nullptr; };
  std::vector<std::string> prefixes;
  for (const std::string& name : names)
    if (name.ends_with(".R") && has(name.substr(0, name.size() - 1) + "G") && has(name.substr(0, name.size() - 1) + "B")) prefixes.push_back(name.substr(0, name.size() - 1));
  std::string prefix;
  if (!(has("R") && has("G") && has("B"))) {
    if (has("RY") || has("BY")) throw Error(concat(path.string(), ": luminance-chroma EXR (", joined(names), ") is not supported, expected R, G, B"));
    if (has("X") && has("Y") && has("Z")) throw Error(concat(path.string(), ": channels X, Y, Z are not supported, expected R, G, B"));
    if (has("Y")) return {"Y"};
    if (names.size() == 1) return {only_channel(path, names.front(), info)};
    if (prefixes.size() != 1) throw Error(concat(path.string(), ": no channels R, G, B, found ", joined(names)));
    prefix = prefixes.front();
    info.notes.push_back(concat("colour is taken from the layer \"", prefix.substr(0, prefix.size() - 1), "\""));
  }
  std::vector<std::string> out = {prefix + "R", prefix + "G", prefix + "B"};
  if (has(prefix + "A")) {
    out.push_back(prefix + "A");
    info.has_alpha = true;
  }
  return out;
}

class ExrReader : public detail::RowReader {
 public:
  ExrReader(const fs::path& path, const ImageOptions& options) : path_(path) {
    const HeaderScan scan(path, options.limits);
    if (scan.num_parts() > 1) info.notes.push_back(concat("holds ", scan.num_parts(), " parts; the first one is taken"));
    named(path, [&] { open(options); });
  }
  bool random_access() const override { return true; }

  void read_rows(int y0, int rows, float* out) override {
    named(path_, [&] {
      for (int y = 0; y < rows; y += kBand) read_band(y0 + y, std::min(kBand, rows - y), out + static_cast<std::size_t>(y) * row_floats());
    });
  }

 private:
  static constexpr int kBand = 32;
  std::size_t row_floats() const { return static_cast<std::size_t>(info.width) * names_.size(); }

  void open(const ImageOptions& options) {
    stream_ = std::make_unique<FileIn>(path_);
    file_ = std::make_unique<Imf::InputFile>(*stream_, 0);
    const Imf::Header& header = file_->header();
    display_ = header.displayWindow();
    data_ = header.dataWindow();
    info.format = "EXR";
    info.width = display_.max.x - display_.min.x + 1;
    info.height = display_.max.y - display_.min.y + 1;
    info.is_float = true;
    info.bits = 16;
    const Imf::ChannelList& list = header.channels();
    names_ = options.exr_channels.empty() ? colour_names(path_, list, info) : options.exr_channels;
    for (const std::string& name : names_) {
      const Imf::Channel* channel = list.findChannel(name.c_str());
      if (!channel) throw Error(concat(path_.string(), ": has no channel \"", name, "\", found ", joined(all_names(list))));
      if (channel->xSampling != 1 || channel->ySampling != 1) throw Error(concat(path_.string(), ": channel \"", name, "\" is subsampled, which is not supported"));
      if (channel->type != Imf::HALF) info.bits = 32;
    }
    info.channels = static_cast<int>(names_.size());
    if (data_ != display_) info.notes.push_back("data and display window differ; the display window is taken, pixels without data are marked");
    if (Imf::hasChromaticities(header)) note_chromaticities(Imf::chromaticities(header));
  }

  void note_chromaticities(const Imf::Chromaticities& c) {
    const Imf::Chromaticities srgb;
    const float off = std::max({(c.red - srgb.red).length(), (c.green - srgb.green).length(), (c.blue - srgb.blue).length(), (c.white - srgb.white).length()});
    if (!(off < 2e-3f)) info.notes.push_back("its chromaticities are not those of sRGB; channels are taken as they are");
  }

  void read_band(int y0, int rows, float* out) {
    const float nan = std::numeric_limits<float>::quiet_NaN();
    std::fill(out, out + static_cast<std::size_t>(rows) * row_floats(), nan);
    const int first = std::max(display_.min.y + y0, data_.min.y), last = std::min(display_.min.y + y0 + rows - 1, data_.max.y);
    if (first > last) return;
    const std::size_t data_width = static_cast<std::size_t>(data_.max.x - data_.min.x + 1), num = names_.size();
    band_.assign(data_width * num * static_cast<std::size_t>(last - first + 1), nan);
    Imf::FrameBuffer frame;
    const std::size_t x_stride = num * sizeof(float), y_stride = data_width * x_stride;
    for (std::size_t c = 0; c < num; ++c) {
      // The library adds x * x_stride + y * y_stride to the base, with x and y in the file's coordinates; modular arithmetic on the address keeps that right.
      const std::uintptr_t base = reinterpret_cast<std::uintptr_t>(band_.data() + c) - static_cast<std::uintptr_t>(static_cast<std::int64_t>(data_.min.x)) * x_stride -
                                  static_cast<std::uintptr_t>(static_cast<std::int64_t>(first)) * y_stride;
      frame.insert(names_[c].c_str(), Imf::Slice(Imf::FLOAT, reinterpret_cast<char*>(base), x_stride, y_stride, 1, 1, nan));
    }
    file_->setFrameBuffer(frame);
    file_->readPixels(first, last);
    const int x_first = std::max(display_.min.x, data_.min.x), x_last = std::min(display_.max.x, data_.max.x);
    if (x_first > x_last) return;
    const std::size_t count = static_cast<std::size_t>(x_last - x_first + 1) * num;
    for (int y = first; y <= last; ++y)
      std::copy_n(band_.data() + (static_cast<std::size_t>(y - first) * data_width + static_cast<std::size_t>(x_first - data_.min.x)) * num, count,
                  out + static_cast<std::size_t>(y - display_.min.y - y0) * row_floats() + static_cast<std::size_t>(x_first - display_.min.x) * num);
  }

  fs::path path_;
  std::unique_ptr<FileIn> stream_;
  std::unique_ptr<Imf::InputFile> file_;
  Imath::Box2i display_, data_;
  std::vector<std::string> names_;
  std::vector<float> band_;
};

/// Writes into the part file; a failure is kept, since the library swallows those of its last bytes.
class FileOut : public Imf::OStream {
 public:
  explicit FileOut(File& file) : Imf::OStream(file.path().c_str()), file_(file) {}
  void write(const char data[], int n) override {
    try {
      file_.write_at(at_, data, static_cast<std::size_t>(n));
    } catch (const Error& error) {
      if (failure.empty()) failure = error.what();
      throw;
    }
    at_ += static_cast<std::uint64_t>(n);
  }
  std::uint64_t tellp() override { return at_; }
  void seekp(std::uint64_t at) override { at_ = at; }
  std::string failure;

 private:
  File& file_;
  std::uint64_t at_ = 0;
};

}  // namespace

std::unique_ptr<detail::RowReader> detail::open_exr(const fs::path& path, const ImageOptions& options) { return std::make_unique<ExrReader>(path, options); }

std::vector<std::string> exr_channel_names(const fs::path& path) {
  HeaderScan scan(path, ImageLimits{});
  return named(path, [&] {
    FileIn stream(path);
    Imf::InputFile file(stream, 0);
    return all_names(file.header().channels());
  });
}

struct ExrWriter::Impl {
  Impl(const fs::path& p, int w, int h, std::vector<std::string> c, bool is_half)
      : path(p), width(w), height(h), channels(std::move(c)), as_half(is_half), atomic(p), stream(atomic.file()) {}
  fs::path path;
  int width, height, next = 0;
  std::vector<std::string> channels;
  bool as_half;
  AtomicFile atomic;
  FileOut stream;
  std::unique_ptr<Imf::OutputFile> file;
  std::vector<Imath::half> halves;
};

ExrWriter::ExrWriter(const fs::path& path, int width_px, int height_px, std::vector<std::string> channels, bool as_half) {
  if (width_px <= 0 || height_px <= 0 || channels.empty()) throw std::invalid_argument("ExrWriter: empty picture");
  impl_ = std::make_unique<Impl>(path, width_px, height_px, std::move(channels), as_half);
  named(path, [&] {
    Imf::Header header(width_px, height_px);
    header.compression() = Imf::ZIP_COMPRESSION;
    for (const std::string& name : impl_->channels) header.channels().insert(name.c_str(), Imf::Channel(as_half ? Imf::HALF : Imf::FLOAT));
    impl_->file = std::make_unique<Imf::OutputFile>(impl_->stream, header, 0);
  });
}
ExrWriter::ExrWriter(ExrWriter&&) noexcept = default;
ExrWriter::~ExrWriter() = default;

void ExrWriter::write_rows(int rows, std::span<const float> interleaved) {
  Impl& impl = *impl_;
  const std::size_t num = impl.channels.size(), row = static_cast<std::size_t>(impl.width) * num;
  if (rows < 0 || rows > impl.height - impl.next || interleaved.size() != row * static_cast<std::size_t>(rows))
    throw std::invalid_argument("ExrWriter::write_rows: wrong number of rows or values");
  constexpr int kBand = 64;
  named(impl.path, [&] {
    for (int done = 0; done < rows;) {
      const int n = std::min(kBand, rows - done);
      const float* values = interleaved.data() + row * static_cast<std::size_t>(done);
      const std::size_t count = row * static_cast<std::size_t>(n), bytes = impl.as_half ? sizeof(Imath::half) : sizeof(float);
      const char* base = reinterpret_cast<const char*>(values);
      if (impl.as_half) {
        impl.halves.resize(count);
        for (std::size_t i = 0; i < count; ++i) impl.halves[i] = Imath::half(std::isnan(values[i]) ? values[i] : std::clamp(values[i], -65504.0f, 65504.0f));
        base = reinterpret_cast<const char*>(impl.halves.data());
      }
      Imf::FrameBuffer frame;
      for (std::size_t c = 0; c < num; ++c) {
        const std::uintptr_t at = reinterpret_cast<std::uintptr_t>(base) + c * bytes - static_cast<std::uintptr_t>(impl.next) * row * bytes;
        frame.insert(impl.channels[c].c_str(), Imf::Slice(impl.as_half ? Imf::HALF : Imf::FLOAT, reinterpret_cast<char*>(at), num * bytes, row * bytes));
      }
      impl.file->setFrameBuffer(frame);
      impl.file->writePixels(n);
      impl.next += n;
      done += n;
    }
  });
}

void ExrWriter::commit() {
  Impl& impl = *impl_;
  if (impl.next != impl.height) throw std::invalid_argument("ExrWriter::commit: rows are missing");
  impl.file.reset();  // writes the table of line offsets
  if (!impl.stream.failure.empty()) throw Error(impl.stream.failure);
  impl.atomic.commit();
}

}  // namespace chiaro::stream
