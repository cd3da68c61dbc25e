#include "optimize/pictures.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <limits>

#include "stream/photo/image_io.h"
#include "tests/optimize/pictured_ground.h"
#include "tests/support/sampled_surface.h"

namespace chiaro::optimize {
namespace {

using tests::even;

constexpr int kWidth = 5, kHeight = 3;
constexpr double kHalf = 1e-3;   // of a half float, relative

const std::vector<std::string> kPlanes{"r", "g", "b", "sigma", "shared", "direct", "indirect", "ambient"};

/// The value of one channel at a pixel.
double at(const std::filesystem::path& path, const char* channel, int x, int y) {
  const stream::Image image = stream::read_exr_channels(path, {channel});
  return static_cast<double>(image.values[static_cast<std::size_t>(y * image.width + x)]);
}

TEST(AlbedoPictures, ShowAlbedoSigmaAndSharesOfTheLight) {
  const ScratchFolder folder;
  std::map<std::string, tests::Plane> planes;
  double value = 0.1;
  for (const std::string& name : kPlanes) planes[name] = even(value += 0.05);   // .15 .2 .25 | .3 .35 | .4 .45 .5
  planes["r"] = [](int x, int y) { return x == 1 && y == 2 ? std::numeric_limits<float>::quiet_NaN() : 0.15f + 0.1f * static_cast<float>(x); };
  planes["sigma"] = [](int x, int y) { return x == 1 && y == 2 ? std::numeric_limits<float>::quiet_NaN() : 0.3f; };
  tests::write_planes(folder.path() / "albedo.raster", kWidth, kHeight, kPlanes, planes);
  write_albedo_pictures(folder.path() / "albedo.raster", folder.path() / "pictures");
  const auto albedo = folder.path() / "pictures/albedo.exr", sigma = folder.path() / "pictures/sigma.exr", light = folder.path() / "pictures/light.exr";
  EXPECT_NEAR(at(albedo, "R", 3, 0), 0.45, kHalf);
  EXPECT_NEAR(at(albedo, "G", 3, 0), 0.2, kHalf);
  EXPECT_NEAR(at(albedo, "B", 3, 0), 0.25, kHalf);
  EXPECT_EQ(at(albedo, "R", 1, 2), 0) << "no value";
  EXPECT_NEAR(at(sigma, "Y", 0, 0), std::hypot(0.3, 0.35), kHalf) << "of its own and shared";
  EXPECT_EQ(at(sigma, "Y", 1, 2), 0);
  EXPECT_NEAR(at(light, "direct", 0, 0), 0.4, kHalf);
  EXPECT_NEAR(at(light, "indirect", 0, 0), 0.45, kHalf);
  EXPECT_NEAR(at(light, "ambient", 0, 0), 0.5, kHalf);
}

TEST(ColourAsAlbedo, IsThePixelWithTheDeviationOfItsNoise) {
  tests::PicturedGround s;
  s.planes["r"] = even(0.3);
  s.planes["g"] = even(0.2);
  s.planes["b"] = even(0.1);
  s.planes["mask"] = [](int x, int) { return x == 0 ? 0.0f : x == 1 ? 3.0f : 1.0f; };
  s.planes["depth"] = [depth = s.planes["depth"]](int x, int y) { return x == 2 ? 0.0f : depth(x, y); };
  s.photo.noise = {1e-3, 0.01};
  s.write();
  colour_as_albedo(s.photo, s.folder.path() / "albedo.raster", silent_reporter());
  const stream::RasterReader out(s.folder.path() / "albedo.raster");
  const auto row = [&](const char* plane) { return out.rows<float>(plane, 3, 1); };
  for (std::size_t x = 0; x < 5; ++x)
    for (const char* plane : {"r", "g", "b", "sigma", "shared"}) EXPECT_EQ(std::isnan(row(plane)[x]), x < 3) << plane << x;
  constexpr double kKept = 0x1p-16;   // 15 bits of the fraction
  EXPECT_NEAR(row("r")[4], 0.3, 0.3 * kKept);
  EXPECT_NEAR(row("g")[4], 0.2, 0.2 * kKept);
  EXPECT_NEAR(row("b")[4], 0.1, 0.1 * kKept);
  EXPECT_NEAR(row("sigma")[4], std::sqrt((1e-3 * 0.2 + 1e-4) / 0.04 + 1e-4), 1e-6) << "and one per cent";
  EXPECT_EQ(row("shared")[4], 0);
}

// The photograph's own albedo is 0.4, 0.5, 0.6 where the layer has 0.5, 0.5 and 2: a quarter less, nothing, and more than all.
TEST(Residual, IsWhatTheBlendedAlbedoLeavesOfThePhotograph) {
  const ScratchFolder folder;
  const stream::Store store = chiaro::tests::build_test_store(chiaro::tests::square_points(10, 1, {0, 0, 0}, {0, 0, 1}, 1), folder.path());
  const std::uint32_t leaf = store.leaves().at(0);
  stream::LayerWriter writer(store, "albedo", stream::albedo_fields(), "{}");
  const std::size_t n = store.read_chunk(leaf).count;
  std::vector<float> values(4 * n, 0.5f);
  for (std::size_t c = 0; c < 3; ++c) {
    values[c * n + 2] = 2;
    values[c * n + 3] = std::nanf("");
  }
  const std::vector<std::uint16_t> photos(n, 1);
  std::vector<std::byte> planar(18 * n);
  std::memcpy(planar.data(), values.data(), 16 * n);
  std::memcpy(planar.data() + 16 * n, photos.data(), 2 * n);
  writer.write_chunk(leaf, planar);
  writer.finish_inner(silent_reporter());
  writer.commit();
  ObserveInput photo;
  photo.radiance = folder.path() / "radiance.raster";
  photo.gbuffer = folder.path() / "gbuffer.raster";
  tests::write_planes(photo.radiance, kWidth, 1, {"r", "g", "b"}, {{"r", even(0.3)}, {"g", even(0.2)}, {"b", even(0.1)}});
  tests::write_planes(folder.path() / "albedo.raster", kWidth, 1, {"r", "g", "b"}, {{"r", even(0.5)}, {"g", [](int x, int) { return 0.4f + 0.1f * static_cast<float>(x); }}, {"b", even(0.5)}});
  {
    stream::RasterWriter out(photo.gbuffer, kWidth, 1, {{"chunk", stream::PlaneType::kU32}, {"slot", stream::PlaneType::kU16}});
    std::vector<std::uint32_t> chunk(kWidth, leaf);
    chunk[4] = SurfelId::kNone;
    const std::vector<std::uint16_t> slot{0, 1, 2, 3, 0};
    out.write_rows<std::uint32_t>("chunk", 0, chunk);
    out.write_rows<std::uint16_t>("slot", 0, slot);
    out.commit();
  }
  const stream::Layer layer(store, "albedo");
  const double rms = write_residual(store, layer, photo, folder.path() / "albedo.raster", folder.path() / "residual.exr", silent_reporter());
  const auto picture = folder.path() / "residual.exr";
  EXPECT_NEAR(at(picture, "G", 0, 0), 0.2 * (1 - 0.5 / 0.4), kHalf);
  EXPECT_NEAR(at(picture, "G", 1, 0), 0, 1e-6);
  EXPECT_NEAR(at(picture, "G", 2, 0), 0.2 * (1 - 2 / 0.6), kHalf);
  EXPECT_NEAR(at(picture, "R", 2, 0), 0.3 * (1 - 2 / 0.5), 1.5 * kHalf);
  EXPECT_EQ(at(picture, "G", 3, 0), 0) << "nothing blended";
  EXPECT_EQ(at(picture, "G", 4, 0), 0) << "nothing there";
  EXPECT_NEAR(rms, std::sqrt((0.25 * 0.25 + 0 + 1) / 3), 1e-5) << "all there is at most";
}

}  // namespace
}  // namespace chiaro::optimize
