/// Colours of the report's pictures, and PNG files in memory.
#pragma once
#include <array>
#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

namespace chiaro::tools {

using Rgb8 = std::array<std::uint8_t, 3>;

/// CubeHelix: lightness rises evenly while the hue turns, so that it also reads in grey. start 0.5, rotations -1.5, hue 1, gamma 1.
/// x: 0..1, clamped; NaN gives black.
/// source  Green, "A colour scheme for the display of astronomical intensity images", Bull. Astr. Soc. India 39, 2011.
Rgb8 cubehelix(double x);

/// Grey, one of two by a chequer of 8 pixels: where a picture has no value. Cannot be taken for a colour of any scale.
Rgb8 no_value(int x, int y);

/// PNG of 3 bytes a pixel, sRGB declared. The same pixels give the same bytes.
std::string png_rgb(int width, int height, std::span<const Rgb8> pixels);
/// PNG of one byte a pixel that chooses from `palette` (at most 256 colours, every index below its size).
std::string png_indexed(int width, int height, std::span<const std::uint8_t> indices, std::span<const Rgb8> palette);

/// One value a pixel, 0 .. 1, through the colours of cubehelix() or from black to white; NaN: no_value().
std::string png_scale(int width, int height, std::span<const double> values, bool grey);

/// RFC 4648 with padding.
std::string base64(std::string_view bytes);

}  // namespace chiaro::tools
