#include <tiffio.h>

#include <algorithm>
#include <cstring>

#include "stream/base/file.h"
#include "stream/photo/image_io_detail.h"

namespace chiaro::stream {
namespace {

struct CloseTiff {
  void operator()(TIFF* tiff) const { TIFFClose(tiff); }
};
using TiffPtr = std::unique_ptr<TIFF, CloseTiff>;

struct Messages {
  std::string path;   ///< the library often begins with it, and so do we
  std::string error;  ///< the first one since it was cleared
};

int on_error(TIFF*, void* user, const char* module, const char* format, va_list arguments) {
  auto* messages = static_cast<Messages*>(user);
  char text[256];
  std::vsnprintf(text, sizeof text, format, arguments);
  std::string_view message = text;
  if (message.starts_with(messages->path)) message.remove_prefix(std::min(message.size(), messages->path.size() + 2));
  if (messages->error.empty()) messages->error = concat(message, " (", module ? module : "", ")");
  return 1;
}
int on_warning(TIFF*, void*, const char*, const char*, va_list) { return 1; }

/// "rm": without memory mapping, so that a file that shrinks meanwhile is an error and not a signal.
TiffPtr open_handle(const std::filesystem::path& path, Messages& messages, const ImageLimits& limits) {
  File check(path, File::Mode::kRead);
  TIFFOpenOptions* options = TIFFOpenOptionsAlloc();
  TIFFOpenOptionsSetErrorHandlerExtR(options, on_error, &messages);
  TIFFOpenOptionsSetWarningHandlerExtR(options, on_warning, nullptr);
  TIFFOpenOptionsSetMaxSingleMemAlloc(options, static_cast<tmsize_t>(limits.max_buffer_bytes));
  TIFF* tiff = TIFFOpenExt(path.c_str(), "rm", options);
  TIFFOpenOptionsFree(options);
  if (!tiff) throw Error(concat(path.string(), ": TIFF: ", messages.error.empty() ? "cannot be opened" : messages.error));
  return TiffPtr(tiff);
}

/// Samples of one plane (planar files) or of all channels (contiguous files), row after row; tiles are kept one row of tiles at a time.
class Plane {
 public:
  Plane(const std::filesystem::path& path, Messages& messages, const ImageLimits& limits, std::uint16_t plane, std::size_t row_bytes, std::size_t pixel_bytes)
      : path_(path), messages_(messages), tiff_(open_handle(path, messages, limits)), plane_(plane), pixel_bytes_(pixel_bytes), row_(row_bytes) {
    TIFF* tiff = tiff_.get();
    set_colour_mode(tiff);
    TIFFGetField(tiff, TIFFTAG_IMAGEWIDTH, &width_);
    TIFFGetField(tiff, TIFFTAG_IMAGELENGTH, &height_);
    tiled_ = TIFFIsTiled(tiff) != 0;
    if (tiled_) {
      TIFFGetField(tiff, TIFFTAG_TILEWIDTH, &tile_width_);
      TIFFGetField(tiff, TIFFTAG_TILELENGTH, &tile_height_);
      if (tile_width_ == 0 || tile_height_ == 0) throw Error(concat(path_.string(), ": TIFF tiles of ", tile_width_, " x ", tile_height_, " pixels"));
      const std::uint64_t tile_bytes = std::uint64_t{tile_width_} * tile_height_ * pixel_bytes_;
      detail::check_buffer(path_, tile_bytes, limits, "a tile");
      detail::check_buffer(path_, row_bytes * std::uint64_t{tile_height_}, limits, "a row of tiles");
      if (TIFFTileSize64(tiff) != tile_bytes) throw Error(concat(path_.string(), ": TIFF tile of ", TIFFTileSize64(tiff), " bytes, expected ", tile_bytes));
      tile_.resize(tile_bytes);
      band_.resize(row_bytes * tile_height_);
    } else {
      if (TIFFScanlineSize64(tiff) != row_bytes) throw Error(concat(path_.string(), ": TIFF row of ", TIFFScanlineSize64(tiff), " bytes, expected ", row_bytes));
      check_strips(limits);
    }
  }

  /// JPEG inside a TIFF: let the codec give RGB instead of subsampled YCbCr.
  static void set_colour_mode(TIFF* tiff) {
    std::uint16_t compression = 0, photometric = 0;
    TIFFGetFieldDefaulted(tiff, TIFFTAG_COMPRESSION, &compression);
    TIFFGetFieldDefaulted(tiff, TIFFTAG_PHOTOMETRIC, &photometric);
    if (compression == COMPRESSION_JPEG && photometric == PHOTOMETRIC_YCBCR) TIFFSetField(tiff, TIFFTAG_JPEGCOLORMODE, JPEGCOLORMODE_RGB);
  }

  const std::uint8_t* row(std::uint32_t y) {
    messages_.error.clear();
    if (!tiled_) {
      if (TIFFReadScanline(tiff_.get(), row_.data(), y, plane_) != 1) fail(y);
      return row_.data();
    }
    const std::uint32_t first = y / tile_height_ * tile_height_;
    if (!have_band_ || first != band_first_) load_tiles(first);
    return band_.data() + std::size_t{y - first} * row_.size();
  }

 private:
  [[noreturn]] void fail(std::uint32_t y) const {
    throw Error(concat(path_.string(), ": TIFF row ", y, ": ", messages_.error.empty() ? "cannot be read" : messages_.error));
  }

  /// The library reads a whole compressed strip: its claimed size must fit the file.
  void check_strips(const ImageLimits& limits) const {
    const File file(path_, File::Mode::kRead);
    const std::uint32_t strips = TIFFNumberOfStrips(tiff_.get());
    if (strips == 0 || strips > height_ * std::uint64_t{64}) throw Error(concat(path_.string(), ": TIFF with ", strips, " strips for ", height_, " rows"));
    for (std::uint32_t i = 0; i < strips; ++i) {
      const std::uint64_t bytes = TIFFGetStrileByteCount(tiff_.get(), i);
      if (bytes > file.size()) throw Error(concat(path_.string(), ": TIFF strip ", i, " claims ", bytes, " bytes, the file has ", file.size()));
      detail::check_buffer(path_, bytes, limits, "a strip");
    }
  }

  void load_tiles(std::uint32_t first) {
    for (std::uint32_t x = 0; x < width_; x += tile_width_) {
      if (TIFFReadTile(tiff_.get(), tile_.data(), x, first, 0, plane_) < 0) fail(first);
      const std::size_t bytes = std::min(tile_width_, width_ - x) * pixel_bytes_;
      for (std::uint32_t r = 0; r < tile_height_; ++r)
        std::memcpy(band_.data() + r * row_.size() + x * pixel_bytes_, tile_.data() + std::size_t{r} * tile_width_ * pixel_bytes_, bytes);
    }
    band_first_ = first;
    have_band_ = true;
  }

  std::filesystem::path path_;
  Messages& messages_;
  TiffPtr tiff_;
  std::uint16_t plane_;
  std::size_t pixel_bytes_;
  std::uint32_t width_ = 0, height_ = 0, tile_width_ = 0, tile_height_ = 0, band_first_ = 0;
  bool tiled_ = false, have_band_ = false;
  std::vector<std::uint8_t> row_, tile_, band_;
};

class TiffReader : public detail::RowReader {
 public:
  TiffReader(const std::filesystem::path& path, const ImageOptions& options) : path_(path), messages_{path.string(), {}} {
    const TiffPtr tiff = open_handle(path, messages_, options.limits);
    read_tags(tiff.get(), options);
    const std::size_t sample = static_cast<std::size_t>(info.bits / 8), width = static_cast<std::size_t>(info.width);
    if (info.bits == 1) {
      planes_.push_back(std::make_unique<Plane>(path, messages_, options.limits, std::uint16_t{0}, (width + 7) / 8, std::size_t{0}));
      return;
    }
    // Each plane of a planar file has a handle of its own, so that all of them stream in order.
    for (std::uint16_t p = 0; p < (planar_ ? static_cast<std::uint16_t>(info.channels) : std::uint16_t{1}); ++p) {
      const std::size_t pixel = planar_ ? sample : sample * samples_;
      planes_.push_back(std::make_unique<Plane>(path, messages_, options.limits, p, width * pixel, pixel));
    }
  }

  void read_rows(int y0, int rows, float* out) override {
    const std::size_t width = static_cast<std::size_t>(info.width), num = static_cast<std::size_t>(info.channels);
    for (int y = y0; y < y0 + rows; ++y, out += width * num) {
      if (planar_) {
        for (std::size_t c = 0; c < num; ++c) convert(planes_[c]->row(static_cast<std::uint32_t>(y)), 1, 1, out + c, num);
      } else {
        convert(planes_[0]->row(static_cast<std::uint32_t>(y)), samples_, num, out, num);
      }
      if (inverted_)
        for (std::size_t x = 0; x < width; ++x) out[x * num] = 1 - out[x * num];
    }
  }

 private:
  template <class... Parts>
  [[noreturn]] void fail(const Parts&... parts) const {
    throw Error(concat(path_.string(), ": TIFF ", parts...));
  }

  void read_tags(TIFF* tiff, const ImageOptions& options) {
    std::uint32_t width = 0, height = 0;
    std::uint16_t bits = 1, samples = 1, format = SAMPLEFORMAT_UINT, planar = PLANARCONFIG_CONTIG, photometric = 0, compression = 1, num_extra = 0;
    std::uint16_t* extra = nullptr;
    TIFFGetField(tiff, TIFFTAG_IMAGEWIDTH, &width);
    TIFFGetField(tiff, TIFFTAG_IMAGELENGTH, &height);
    detail::check_size(path_, width, height, options.limits);
    TIFFGetFieldDefaulted(tiff, TIFFTAG_BITSPERSAMPLE, &bits);
    TIFFGetFieldDefaulted(tiff, TIFFTAG_SAMPLESPERPIXEL, &samples);
    TIFFGetFieldDefaulted(tiff, TIFFTAG_SAMPLEFORMAT, &format);
    TIFFGetFieldDefaulted(tiff, TIFFTAG_PLANARCONFIG, &planar);
    TIFFGetFieldDefaulted(tiff, TIFFTAG_COMPRESSION, &compression);
    TIFFGetFieldDefaulted(tiff, TIFFTAG_EXTRASAMPLES, &num_extra, &extra);
    if (!TIFFGetField(tiff, TIFFTAG_PHOTOMETRIC, &photometric)) fail("has no photometric interpretation");
    if (!TIFFIsCODECConfigured(compression)) fail("compression ", compression, " is not supported");
    is_float_ = format == SAMPLEFORMAT_IEEEFP;
    is_signed_ = format == SAMPLEFORMAT_INT;
    const bool mask = bits == 1 && samples == 1 && (photometric == PHOTOMETRIC_MINISBLACK || photometric == PHOTOMETRIC_MINISWHITE) && TIFFIsTiled(tiff) == 0;
    const bool float_size = bits == 32 || bits == 64, integer_size = bits == 8 || bits == 16 || mask;
    if (is_signed_ || (!is_float_ && format != SAMPLEFORMAT_UINT && format != SAMPLEFORMAT_VOID) || !(is_float_ ? float_size : integer_size))
      fail("samples of ", bits, " bits, format ", format, ", are not supported, expected unsigned integers of 8 or 16 bits, floats of 32 or 64, or black and white");
    if (samples == 0 || num_extra >= samples) fail("has ", samples, " samples a pixel, ", num_extra, " of them extra");
    const int colours = samples - num_extra;
    const bool jpeg_ycbcr = photometric == PHOTOMETRIC_YCBCR && compression == COMPRESSION_JPEG;
    const bool grey = photometric == PHOTOMETRIC_MINISBLACK || photometric == PHOTOMETRIC_MINISWHITE;
    if (!grey && photometric != PHOTOMETRIC_RGB && !jpeg_ycbcr) fail("photometric interpretation ", photometric, " is not supported, expected grey or RGB");
    if (!grey && colours != 3 && !(colours > 3 && num_extra == 0)) fail("has ", colours, " colours, expected 3");
    inverted_ = photometric == PHOTOMETRIC_MINISWHITE && !is_float_;
    planar_ = planar == PLANARCONFIG_SEPARATE && samples > 1;
    samples_ = samples;

    info.format = "TIFF";
    info.width = static_cast<int>(width);
    info.height = static_cast<int>(height);
    info.bits = bits;
    info.is_float = is_float_;
    info.channels = grey ? 1 : 3;
    // Alpha follows the colours; of a single extra sample it is assumed, since many writers do not declare it.
    const bool declared = num_extra > 0 && extra[0] != EXTRASAMPLE_UNSPECIFIED && colours == info.channels;
    if (declared || samples == info.channels + 1) {
      info.has_alpha = true;
      info.alpha_is_assumed = !declared;
      ++info.channels;
    }
    if (samples > info.channels) info.notes.push_back(concat("samples beyond the first ", info.channels, " of ", samples, " are passed over"));
    std::uint32_t icc_bytes = 0;
    void* icc = nullptr;
    if (TIFFGetField(tiff, TIFFTAG_ICCPROFILE, &icc_bytes, &icc) && icc) detail::read_profile({static_cast<const std::uint8_t*>(icc), icc_bytes}, info);
    std::uint16_t orientation = 1;
    TIFFGetFieldDefaulted(tiff, TIFFTAG_ORIENTATION, &orientation);
    detail::note_orientation(orientation, info);
    if (TIFFLastDirectory(tiff) == 0) info.notes.push_back("holds several pictures; the first one is taken");
  }

  template <class T>
  static float load(const std::uint8_t* at) {
    T value;
    std::memcpy(&value, at, sizeof value);
    return static_cast<float>(value);
  }

  /// num samples of each group of `stride` samples, to groups of `out_stride` floats.
  void convert(const std::uint8_t* bytes, std::size_t stride, std::size_t num, float* out, std::size_t out_stride) const {
    const std::size_t width = static_cast<std::size_t>(info.width), sample = static_cast<std::size_t>(info.bits / 8);
    if (info.bits == 1) {   // the library gives the first pixel as the highest bit
      for (std::size_t x = 0; x < width; ++x) out[x] = static_cast<float>(bytes[x / 8] >> (7 - x % 8) & 1);
      return;
    }
    for (std::size_t x = 0; x < width; ++x)
      for (std::size_t c = 0; c < num; ++c) {
        const std::uint8_t* at = bytes + (x * stride + c) * sample;
        float& value = out[x * out_stride + c];
        switch (info.bits) {
          case 8: value = static_cast<float>(*at) / 255.0f; break;
          case 16: value = load<std::uint16_t>(at) / 65535.0f; break;
          case 32: value = load<float>(at); break;
          default: value = load<double>(at); break;
        }
      }
  }

  std::filesystem::path path_;
  Messages messages_;
  std::vector<std::unique_ptr<Plane>> planes_;
  std::size_t samples_ = 1;
  bool planar_ = false, inverted_ = false, is_float_ = false, is_signed_ = false;
};

}  // namespace

std::unique_ptr<detail::RowReader> detail::open_tiff(const std::filesystem::path& path, const ImageOptions& options) { return std::make_unique<TiffReader>(path, options); }

}  // namespace chiaro::stream
