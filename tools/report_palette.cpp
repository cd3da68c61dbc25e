#include "tools/report_palette.h"

#include <png.h>

#include <algorithm>
#include <cmath>
#include <csetjmp>
#include <cstring>
#include <numbers>
#include <stdexcept>

#include "stream/base/error.h"

namespace chiaro::tools {
namespace {

std::uint8_t byte_of(double v) { return static_cast<std::uint8_t>(std::clamp(v, 0.0, 1.0) * 255 + 0.5); }

void append(png_structp png, png_bytep data, std::size_t bytes) { static_cast<std::string*>(png_get_io_ptr(png))->append(reinterpret_cast<const char*>(data), bytes); }
void no_flush(png_structp) {}
/// libpng is C: nothing may be thrown through it. What went wrong is kept here and thrown after the jump back.
void on_error(png_structp png, png_const_charp message) {
  std::strncpy(static_cast<char*>(png_get_error_ptr(png)), message, 127);
  longjmp(png_jmpbuf(png), 1);
}
void on_warning(png_structp, png_const_charp) {}

/// Only plain data lives in this frame: the jump skips destructors.
bool write_png(std::string& out, char* message, int width, int height, int colour_type, const std::uint8_t* pixels, std::size_t row_bytes, const png_color* palette, int colours) {
  png_structp png = png_create_write_struct(PNG_LIBPNG_VER_STRING, message, on_error, on_warning);
  if (!png) return false;
  png_infop info = png_create_info_struct(png);
  if (!info || setjmp(png_jmpbuf(png))) {
    png_destroy_write_struct(&png, &info);
    return false;
  }
  png_set_write_fn(png, &out, append, no_flush);
  png_set_IHDR(png, info, static_cast<png_uint_32>(width), static_cast<png_uint_32>(height), 8, colour_type, PNG_INTERLACE_NONE, PNG_COMPRESSION_TYPE_DEFAULT,
               PNG_FILTER_TYPE_DEFAULT);
  if (palette) png_set_PLTE(png, info, palette, colours);
  png_set_sRGB(png, info, PNG_sRGB_INTENT_PERCEPTUAL);
  png_set_compression_level(png, 6);
  png_write_info(png, info);
  for (int y = 0; y < height; ++y) png_write_row(png, const_cast<png_bytep>(pixels + static_cast<std::size_t>(y) * row_bytes));
  png_write_end(png, info);
  png_destroy_write_struct(&png, &info);
  return true;
}

std::string encode(int width, int height, int colour_type, const std::uint8_t* pixels, std::size_t row_bytes, const png_color* palette, int colours) {
  std::string out;
  char message[128] = "no memory";
  if (!write_png(out, message, width, height, colour_type, pixels, row_bytes, palette, colours)) throw Error(concat("a picture of the report could not be encoded: ", message));
  return out;
}

void require_size(int width, int height, std::size_t pixels) {
  if (width <= 0 || height <= 0 || pixels != static_cast<std::size_t>(width) * static_cast<std::size_t>(height))
    throw std::invalid_argument(concat("PNG: ", pixels, " pixels for ", width, " x ", height));
}

}  // namespace

Rgb8 cubehelix(double x) {
  if (!(x > 0)) x = 0;   // NaN too
  if (x > 1) x = 1;
  constexpr double kStart = 0.5, kRotations = -1.5, kHue = 1;
  const double phi = 2 * std::numbers::pi * (kStart / 3 + kRotations * x), a = kHue * x * (1 - x) / 2;
  const double c = std::cos(phi), s = std::sin(phi);
  return {byte_of(x + a * (-0.14861 * c + 1.78277 * s)), byte_of(x + a * (-0.29227 * c - 0.90649 * s)), byte_of(x + a * 1.97294 * c)};
}

Rgb8 no_value(int x, int y) {
  const std::uint8_t grey = ((x >> 3) + (y >> 3)) % 2 ? 74 : 66;
  return {grey, grey, grey};
}

std::string png_rgb(int width, int height, std::span<const Rgb8> pixels) {
  require_size(width, height, pixels.size());
  static_assert(sizeof(Rgb8) == 3);
  return encode(width, height, PNG_COLOR_TYPE_RGB, pixels[0].data(), 3 * static_cast<std::size_t>(width), nullptr, 0);
}

std::string png_indexed(int width, int height, std::span<const std::uint8_t> indices, std::span<const Rgb8> palette) {
  require_size(width, height, indices.size());
  if (palette.empty() || palette.size() > 256 || *std::max_element(indices.begin(), indices.end()) >= palette.size()) throw std::invalid_argument("PNG: palette");
  std::vector<png_color> colours;
  for (const Rgb8& c : palette) colours.push_back({c[0], c[1], c[2]});
  return encode(width, height, PNG_COLOR_TYPE_PALETTE, indices.data(), static_cast<std::size_t>(width), colours.data(), static_cast<int>(colours.size()));
}

std::string png_scale(int width, int height, std::span<const double> values, bool grey) {
  require_size(width, height, values.size());
  constexpr int kColours = 254;   // the last two are those of no value
  std::vector<Rgb8> palette;
  for (int i = 0; i < kColours; ++i) {
    const auto v = static_cast<std::uint8_t>(i * 255 / (kColours - 1));
    palette.push_back(grey ? Rgb8{v, v, v} : cubehelix(i / (kColours - 1.0)));
  }
  palette.push_back(no_value(0, 0));
  palette.push_back(no_value(8, 0));
  std::vector<std::uint8_t> indices(values.size());
  for (std::size_t i = 0; i < values.size(); ++i) {
    const int x = static_cast<int>(i % static_cast<std::size_t>(width)), y = static_cast<int>(i / static_cast<std::size_t>(width));
    if (!std::isnan(values[i])) indices[i] = static_cast<std::uint8_t>(std::clamp(values[i], 0.0, 1.0) * (kColours - 1) + 0.5);
    else indices[i] = no_value(x, y) == palette[kColours] ? kColours : kColours + 1;
  }
  return png_indexed(width, height, indices, palette);
}

std::string base64(std::string_view bytes) {
  static const char kDigits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string out;
  out.reserve((bytes.size() + 2) / 3 * 4);
  for (std::size_t i = 0; i < bytes.size(); i += 3) {
    const std::size_t n = std::min<std::size_t>(3, bytes.size() - i);
    std::uint32_t v = 0;
    for (std::size_t k = 0; k < 3; ++k) v = v << 8 | (k < n ? static_cast<std::uint8_t>(bytes[i + k]) : 0u);
    for (std::size_t k = 0; k < 4; ++k) out += k <= n ? kDigits[v >> (18 - 6 * k) & 63] : '=';
  }
  return out;
}

}  // namespace chiaro::tools
