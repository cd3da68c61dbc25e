#include <png.h>

#include <cmath>
#include <cstring>

#include "stream/base/file.h"
#include "stream/photo/image_io_detail.h"

namespace chiaro::stream {
namespace {

/// What libpng's callbacks see.
struct Context {
  std::jmp_buf jump;
  char message[256] = {};
  std::FILE* file = nullptr;
  AtomicFile* out = nullptr;
};

[[noreturn]] void on_error(png_structp png, png_const_charp message) {
  auto* context = static_cast<Context*>(png_get_error_ptr(png));
  std::strncpy(context->message, message, sizeof context->message - 1);
  std::longjmp(context->jump, 1);
}
void on_warning(png_structp, png_const_charp) {}

void on_read(png_structp png, png_bytep data, std::size_t bytes) {
  auto* context = static_cast<Context*>(png_get_io_ptr(png));
  if (std::fread(data, 1, bytes, context->file) != bytes) png_error(png, "file ends early");
}

/// No exception may pass through libpng, and no longjmp may leave a catch block: the failure is kept and raised after it.
void on_write(png_structp png, png_bytep data, std::size_t bytes) {
  auto* context = static_cast<Context*>(png_get_io_ptr(png));
  bool failed = false;
  try {
    context->out->append(data, bytes);
  } catch (const std::exception& error) {
    std::strncpy(context->message, error.what(), sizeof context->message - 1);
    failed = true;
  }
  if (failed) {
    char message[256];
    std::memcpy(message, context->message, sizeof message);
    png_error(png, message);
  }
}
void on_flush(png_structp) {}

class PngReader : public detail::RowReader {
 public:
  PngReader(const std::filesystem::path& path, const ImageOptions& options) : path_(path), file_(detail::open_c_file(path)) {
    context_.file = file_.get();
    png_ = png_create_read_struct(PNG_LIBPNG_VER_STRING, &context_, on_error, on_warning);
    if (png_) info_ = png_create_info_struct(png_);
    if (!info_) {
      png_destroy_read_struct(&png_, &info_, nullptr);
      throw Error(concat(path.string(), ": no memory for PNG"));
    }
    try {
      open(options);
    } catch (...) {
      png_destroy_read_struct(&png_, &info_, nullptr);
      throw;
    }
  }
  ~PngReader() override { png_destroy_read_struct(&png_, &info_, nullptr); }

  void read_rows(int y0, int rows, float* out) override {
    if (interlaced_ && whole_.empty()) read_whole();
    for (int y = y0; y < y0 + rows; ++y, out += samples()) {
      const png_byte* bytes = row_.data();
      if (interlaced_)
        bytes = whole_.data() + static_cast<std::size_t>(y) * row_.size();
      else
        call(y, [&] { png_read_row(png_, row_.data(), nullptr); });
      convert(bytes, out);
    }
    if (y0 + rows == info.height && !interlaced_) call(info.height - 1, [&] { png_read_end(png_, nullptr); });
  }

 private:
  std::size_t samples() const { return static_cast<std::size_t>(info.width) * static_cast<std::size_t>(info.channels); }

  template <class Call>
  void call(int y, Call&& body) {
    if (detail::guarded(context_.jump, body)) return;
    throw Error(y < 0 ? concat(path_.string(), ": PNG header: ", context_.message) : concat(path_.string(), ": PNG row ", y, ": ", context_.message));
  }

  void open(const ImageOptions& options) {
    png_uint_32 width = 0, height = 0;
    int depth = 0, type = 0, interlace = 0;
    call(-1, [&] {
      png_set_read_fn(png_, &context_, on_read);
      png_set_user_limits(png_, 0x7fffffff, 0x7fffffff);  // our own check below names the limit
      png_set_chunk_malloc_max(png_, 16u << 20);
      png_set_chunk_cache_max(png_, 128);
      png_read_info(png_, info_);
      png_get_IHDR(png_, info_, &width, &height, &depth, &type, &interlace, nullptr, nullptr);
    });
    detail::check_size(path_, width, height, options.limits);
    interlaced_ = interlace != PNG_INTERLACE_NONE;
    call(-1, [&] {
      png_set_expand(png_);  // palettes, 1 to 4 bits, transparent colours
      if (depth == 16) png_set_swap(png_);
      if (interlaced_) png_set_interlace_handling(png_);
      png_read_update_info(png_, info_);
    });
    info.format = "PNG";
    info.width = static_cast<int>(width);
    info.height = static_cast<int>(height);
    info.channels = png_get_channels(png_, info_);
    info.has_alpha = info.channels == 2 || info.channels == 4;
    info.bits = png_get_bit_depth(png_, info_);
    read_profile();
    row_.resize(png_get_rowbytes(png_, info_));
    if (row_.size() != samples() * static_cast<std::size_t>(info.bits / 8)) throw Error(concat(path_.string(), ": PNG row of ", row_.size(), " bytes"));
    if (interlaced_) detail::check_buffer(path_, row_.size() * static_cast<std::uint64_t>(info.height), options.limits, "an interlaced PNG");
  }

  void read_profile() {
    png_charp name = nullptr;
    png_bytep data = nullptr;
    png_uint_32 size = 0;
    int compression = 0;
    if (png_get_iCCP(png_, info_, &name, &compression, &data, &size) != 0) return detail::read_profile({data, size}, info);
    int intent = 0;
    double exponent = 0;
    if (png_get_sRGB(png_, info_, &intent) != 0) info.says_linear = false;
    else if (png_get_gAMA(png_, info_, &exponent) != 0) info.says_linear = std::abs(exponent - 1) < 0.01;
  }

  /// An interlaced picture is complete only at the end of the file.
  void read_whole() {
    whole_.resize(row_.size() * static_cast<std::size_t>(info.height));
    std::vector<png_bytep> rows(static_cast<std::size_t>(info.height));
    for (std::size_t y = 0; y < rows.size(); ++y) rows[y] = whole_.data() + y * row_.size();
    call(0, [&] {
      png_read_image(png_, rows.data());
      png_read_end(png_, nullptr);
    });
  }

  void convert(const png_byte* bytes, float* out) const {
    const std::size_t count = samples();
    if (info.bits == 8) {
      for (std::size_t i = 0; i < count; ++i) out[i] = static_cast<float>(bytes[i]) / 255.0f;
      return;
    }
    for (std::size_t i = 0; i < count; ++i) {
      std::uint16_t v = 0;
      std::memcpy(&v, bytes + 2 * i, 2);
      out[i] = static_cast<float>(v) / 65535.0f;
    }
  }

  std::filesystem::path path_;
  detail::FilePtr file_;
  Context context_;
  png_structp png_ = nullptr;
  png_infop info_ = nullptr;
  bool interlaced_ = false;
  std::vector<png_byte> row_, whole_;
};

void write_png(const std::filesystem::path& path, int width, int height, int channels, int bits, const void* values, std::size_t count) {
  const std::size_t row = static_cast<std::size_t>(std::max(width, 0)) * static_cast<std::size_t>(channels);
  if (width <= 0 || height <= 0 || (channels != 1 && channels != 3) || count != row * static_cast<std::size_t>(height))
    throw std::invalid_argument("write_png: wrong size");
  AtomicFile atomic(path);
  Context context;
  context.out = &atomic;
  png_structp png = png_create_write_struct(PNG_LIBPNG_VER_STRING, &context, on_error, on_warning);
  png_infop info = png ? png_create_info_struct(png) : nullptr;
  const bool good = info && detail::guarded(context.jump, [&] {
    png_set_write_fn(png, &context, on_write, on_flush);
    png_set_IHDR(png, info, static_cast<png_uint_32>(width), static_cast<png_uint_32>(height), bits, channels == 1 ? PNG_COLOR_TYPE_GRAY : PNG_COLOR_TYPE_RGB,
                 PNG_INTERLACE_NONE, PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
    png_set_sRGB(png, info, PNG_sRGB_INTENT_RELATIVE);
    png_write_info(png, info);
    if (bits == 16) png_set_swap(png);
    const auto* bytes = static_cast<const png_byte*>(values);
    for (int y = 0; y < height; ++y) png_write_row(png, bytes + static_cast<std::size_t>(y) * row * static_cast<std::size_t>(bits / 8));
    png_write_end(png, info);
  });
  png_destroy_write_struct(&png, &info);
  if (!good) throw Error(concat(path.string(), ": PNG cannot be written: ", context.message));
  atomic.commit();
}

}  // namespace

std::unique_ptr<detail::RowReader> detail::open_png(const std::filesystem::path& path, const ImageOptions& options) { return std::make_unique<PngReader>(path, options); }

void write_png_srgb8(const std::filesystem::path& path, int width_px, int height_px, std::span<const std::uint8_t> values, int channels) {
  write_png(path, width_px, height_px, channels, 8, values.data(), values.size());
}

void write_png_srgb16(const std::filesystem::path& path, int width_px, int height_px, std::span<const std::uint16_t> values, int channels) {
  write_png(path, width_px, height_px, channels, 16, values.data(), values.size());
}

}  // namespace chiaro::stream
