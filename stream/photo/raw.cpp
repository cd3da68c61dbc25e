#include "stream/photo/raw.h"

#include <libraw/libraw.h>

#include <algorithm>
#include <array>
#include <limits>
#include <optional>

#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/photo/plateau.h"

namespace chiaro::stream {
namespace {

struct DataErrors {
  bool any = false;
  long offset = 0;
};

void on_data_error(void* data, const char*, const int offset) {
  auto* errors = static_cast<DataErrors*>(data);
  if (!errors->any) errors->offset = offset;
  errors->any = true;
}

/// LibRaw goes through as many tags as a file claims to have, each a failed read where the file has long ended: hours for four thousand million of them.
class EndingStream : public LibRaw_bigfile_datastream {
 public:
  explicit EndingStream(const char* path) : LibRaw_bigfile_datastream(path) {}
  int read(void* to, std::size_t size, std::size_t count) override {
    const int got = LibRaw_bigfile_datastream::read(to, size, count);
    if (got == 0 && size > 0 && count > 0) count_beyond_end();
    return got;
  }
  int get_char() override {
    const int got = LibRaw_bigfile_datastream::get_char();
    if (got < 0) count_beyond_end();
    return got;
  }

 private:
  void count_beyond_end() {
    constexpr int kMostBeyondEnd = 200'000;
    if (++beyond_end_ > kMostBeyondEnd) throw LIBRAW_EXCEPTION_IO_EOF;
  }
  int beyond_end_ = 0;
};

/// LibRaw opens what only its own picture is made with.
struct Decoder : LibRaw {
  using LibRaw::is_phaseone_compressed;
};

/// Colour index (into cdesc) of a mosaic place in visible coordinates; the mosaic's code packs 8 rows of 2 columns, 2 bits each.
int mosaic_colour(unsigned filters, int row, int column) { return static_cast<int>(filters >> ((((row << 1) & 14) + (column & 1)) << 1)) & 3; }

}  // namespace

struct RawSource::Impl {
  std::filesystem::path path;
  RawInfo info;
  std::optional<EndingStream> stream;    ///< outlives what reads it
  std::unique_ptr<Decoder> raw = std::make_unique<Decoder>();  // the object is large: never on a stack
  DataErrors errors;
  const std::uint16_t* first = nullptr;  ///< upper left of the visible area
  std::size_t pitch = 0;                 ///< raw values a stored row
  std::array<int, 4> channel{};          ///< R, G, B = 0, 1, 2 of the places (0,0) (0,1) (1,0) (1,1) of a cell
  std::vector<float> black;              ///< one repeat of the black pattern
  int black_rows = 0, black_columns = 0;
  bool black_is_off = false;             ///< taken off the values already

  template <class... Parts>
  [[noreturn]] void fail(const Parts&... parts) const {
    throw Error(concat(path.string(), ": RAW: ", parts...));
  }
  void check(int code, const char* what) const {
    if (code != LIBRAW_SUCCESS) fail(what, ": ", code > 0 ? std::generic_category().message(code) : std::string(libraw_strerror(code)));
    if (errors.any) fail(what, ": pixel data is damaged or ends early near offset ", errors.offset);
  }

  void open(bool with_pixels) {
    File readable(path, File::Mode::kRead);
    raw->set_dataerror_handler(on_data_error, &errors);
#if LIBRAW_MAJOR_VERSION > 0 || LIBRAW_MINOR_VERSION > 20
    raw->imgdata.rawparams.max_raw_memory_mb = 1024;
#else
    raw->imgdata.params.max_raw_memory_mb = 1024;
#endif
    try {
      stream.emplace(path.c_str());
      check(raw->open_datastream(&*stream), "not readable as camera RAW");
      const libraw_image_sizes_t& s = raw->imgdata.sizes;
      if (std::uint64_t{s.raw_width} * s.raw_height > (std::uint64_t{1} << 29)) fail("claims ", s.raw_width, " x ", s.raw_height, " pixels");
      if (!with_pixels) return;
      check(raw->unpack(), "pixels cannot be unpacked");
      if (raw->is_phaseone_compressed()) correct_phase_one();
    } catch (const Error&) {
      throw;
    } catch (const LibRaw_exceptions code) {   // of what LibRaw does not call itself
      fail("damaged (LibRaw's ", static_cast<int>(code), ")");
    } catch (const std::exception& error) {
      fail(error.what());
    }
  }

  /// Phase One backs: black levels of rows, columns and quadrants, and what the back's calibration in the file holds (linearity, gains, flat fields, dead pixels),
  /// LibRaw takes off when it makes its picture, and not when it unpacks. In place; what is below black becomes 0.
  void correct_phase_one() {
    std::uint16_t* values = raw->imgdata.rawdata.raw_image;
    if (!values) return;   // refused by check_mosaic()
    check(raw->phase_one_subtract_black(values, values), "black levels of the back");
    check(raw->phase_one_correct(), "calibration of the back");
    black_is_off = true;
  }

  void check_mosaic() {
    const libraw_data_t& data = raw->imgdata;
    if (!data.rawdata.raw_image) fail("holds no mosaic of raw values (sRAW, linear DNG or a layered sensor), which is not supported");
    if (data.rawdata.ioparams.fuji_width) fail("a sensor turned by 45 degrees is not supported");
    if (data.color.as_shot_wb_applied) fail("its values are already white-balanced by the camera, so they are not raw");
    const unsigned filters = data.idata.filters;
    if (filters < 1000 || data.idata.colors != 3) fail("mosaic ", filters, " with ", data.idata.colors, " colours is not supported, expected a 2x2 Bayer mosaic");
    for (int row = 0; row < 8; ++row)
      for (int column = 0; column < 2; ++column)
        if (letter(row, column) != letter(row & 1, column)) fail("its mosaic does not repeat every 2 rows");
    std::array<int, 3> count{};
    for (int place = 0; place < 4; ++place) {
      const char c = letter(place >> 1, place & 1);
      channel[static_cast<std::size_t>(place)] = c == 'R' ? 0 : c == 'G' ? 1 : c == 'B' ? 2 : 3;
      if (channel[static_cast<std::size_t>(place)] == 3) fail("its mosaic holds a colour '", c, "', expected R, G, B");
      ++count[static_cast<std::size_t>(channel[static_cast<std::size_t>(place)])];
    }
    if (count != std::array<int, 3>{1, 2, 1}) fail("its mosaic is not R G G B");
  }
  std::uint16_t value(int row, int column) const { return first[static_cast<std::size_t>(row) * pitch + static_cast<std::size_t>(column)]; }
  int channel_at(int row, int column) const { return channel[static_cast<std::size_t>(2 * (row & 1) + (column & 1))]; }
  char letter(int row, int column) const { return raw->imgdata.idata.cdesc[mosaic_colour(raw->imgdata.idata.filters, row, column)]; }

  void read_sizes() {
    const libraw_data_t& data = raw->imgdata;
    const libraw_image_sizes_t& s = data.sizes;
    pitch = s.raw_pitch / sizeof(std::uint16_t);
    if (s.width < 2 || s.height < 2 || s.left_margin + s.width > s.raw_width || s.top_margin + s.height > s.raw_height || pitch < s.raw_width)
      fail("visible area of ", s.width, " x ", s.height, " at ", s.left_margin, ", ", s.top_margin, " does not fit ", s.raw_width, " x ", s.raw_height);
    first = data.rawdata.raw_image + std::size_t{s.top_margin} * pitch + s.left_margin;
    info.camera = concat(data.idata.make, " ", data.idata.model);
    info.sensor_width_px = s.width;
    info.sensor_height_px = s.height;
    info.width_px = s.width / kCellPx;
    info.height_px = s.height / kCellPx;
    info.crop_left_px = s.left_margin;
    info.crop_top_px = s.top_margin;
    info.notes.push_back(concat("holds the sensor's ", s.width, " x ", s.height, " pixels, read at half size: a camera calibrated on pictures of another size, as the camera's own JPEGs often are by some pixels, does not fit"));
    if (s.flip != 0) info.notes.push_back("the camera marks the picture as turned; pixels stay as stored");
    if (std::abs(s.pixel_aspect - 1) > 1e-3) info.notes.push_back(concat("its pixels are not square (", s.pixel_aspect, "); they stay as stored"));
  }

  /// Decoders of several formats leave zeros, silently, where a file ends early. Above a black level of some height a sensor gives no zeros.
  void check_presence() const {
    std::uint64_t zeros = 0;
    const std::uint64_t total = static_cast<std::uint64_t>(info.sensor_width_px) * static_cast<std::uint64_t>(info.sensor_height_px);
    for (int y = 0; y < info.sensor_height_px; ++y) {
      const std::uint16_t* row = first + static_cast<std::size_t>(y) * pitch;
      zeros += static_cast<std::uint64_t>(std::count(row, row + info.sensor_width_px, std::uint16_t{0}));
    }
    constexpr double kClearBlack = 32, kTooMany = 0.01;
    if (zeros == total || (info.black > kClearBlack && static_cast<double>(zeros) > kTooMany * static_cast<double>(total)))
      fail(zeros, " of ", total, " raw values are zero: pixel data is missing");
  }

  /// Black = common level + level of the mosaic colour + a repeating pattern, all in visible coordinates.
  void read_levels() {
    const libraw_colordata_t& color = raw->imgdata.color;
    info.white = color.maximum;
    if (black_is_off) {
      black.assign(4, 0.0f);
      black_rows = black_columns = 2;
      info.white = std::min(info.white, 65535.0 - color.phase_one_data.t_black);
      return check_presence();
    }
    const unsigned rows = color.cblack[4], columns = color.cblack[5];
    const bool pattern = rows > 0 && columns > 0;
    if (pattern && (rows > LIBRAW_CBLACK_SIZE || columns > LIBRAW_CBLACK_SIZE || rows * columns > LIBRAW_CBLACK_SIZE - 6)) fail("black pattern of ", rows, " x ", columns);
    black_rows = pattern ? static_cast<int>(rows % 2 ? 2 * rows : rows) : 2;
    black_columns = pattern ? static_cast<int>(columns % 2 ? 2 * columns : columns) : 2;
    double sum = 0;
    for (int r = 0; r < black_rows; ++r)
      for (int c = 0; c < black_columns; ++c) {
        double level = color.black + color.cblack[mosaic_colour(raw->imgdata.idata.filters, r & 1, c & 1)];
        if (pattern) level += color.cblack[6 + static_cast<unsigned>(r) % rows * columns + static_cast<unsigned>(c) % columns];
        black.push_back(static_cast<float>(level));
        sum += level;
      }
    info.black = sum / static_cast<double>(black.size());
    check_presence();
    for (const float level : black)
      if (!(info.white > static_cast<double>(level))) fail("white level ", info.white, " is not above black level ", level);
  }
};

RawSource::RawSource(const std::filesystem::path& path) : impl_(std::make_unique<Impl>()) {
  impl_->path = path;
  impl_->open(true);
  impl_->check_mosaic();
  impl_->read_sizes();
  impl_->read_levels();
}
RawSource::RawSource(RawSource&&) noexcept = default;
RawSource::~RawSource() = default;
const RawInfo& RawSource::info() const { return impl_->info; }

std::array<int, 2> RawSource::sensor_size_px(const std::filesystem::path& path) {
  Impl impl;
  impl.path = path;
  impl.open(false);
  const libraw_image_sizes_t& s = impl.raw->imgdata.sizes;
  return {s.width, s.height};
}

std::array<std::optional<int>, 3> RawSource::heaps() const {
  constexpr std::size_t kValues = 65536, kLeastAboveBlack = 400;   // below, the values that a heap is compared with are too few
  const Impl& impl = *impl_;
  std::array<std::vector<std::uint32_t>, 3> count;
  for (auto& c : count) c.assign(kValues, 0);
  for (int row = 0; row < kCellPx * impl.info.height_px; ++row)
    for (int column = 0; column < kCellPx * impl.info.width_px; ++column)
      ++count[static_cast<std::size_t>(impl.channel_at(row, column))][impl.value(row, column)];
  std::array<std::optional<int>, 3> heaps;
  for (std::size_t c = 0; c < 3; ++c)
    if (const auto level = plateau_of_counts(count[c]); level && static_cast<double>(*level) >= impl.info.black + static_cast<double>(kLeastAboveBlack)) heaps[c] = static_cast<int>(*level);
  return heaps;
}

void RawSource::read_rows(int y0, int rows, double saturation, const std::array<std::optional<int>, 3>& heap, float* rgb, std::uint8_t* saturated) const {
  const Impl& impl = *impl_;
  if (y0 < 0 || rows < 0 || y0 > impl.info.height_px - rows) throw std::invalid_argument("RawSource::read_rows: rows outside the picture");
  const float white = static_cast<float>(impl.info.white), limit = static_cast<float>(saturation);
  std::array<int, 3> least_full{};
  for (std::size_t c = 0; c < 3; ++c) least_full[c] = heap[c].value_or(std::numeric_limits<int>::max());
  for (int y = y0; y < y0 + rows; ++y)
    for (int x = 0; x < impl.info.width_px; ++x, rgb += 3, ++saturated) {
      std::array<float, 3> sum{};
      bool full = false;
      for (int place = 0; place < 4; ++place) {
        const int row = 2 * y + (place >> 1), column = 2 * x + (place & 1);
        const float black = impl.black[static_cast<std::size_t>(row % impl.black_rows * impl.black_columns + column % impl.black_columns)];
        const int count_dn = impl.value(row, column);
        const float value = (static_cast<float>(count_dn) - black) / (white - black);
        const auto channel = static_cast<std::size_t>(impl.channel[static_cast<std::size_t>(place)]);
        full = full || value >= limit || count_dn >= least_full[channel];
        sum[channel] += value;
      }
      rgb[0] = sum[0];
      rgb[1] = 0.5f * sum[1];
      rgb[2] = sum[2];
      *saturated = full;
    }
}

}  // namespace chiaro::stream
