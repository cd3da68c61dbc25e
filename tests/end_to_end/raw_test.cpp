/// Projects of camera RAW: which cameras belong to it.
#include <cmath>

#include "stream/base/error.h"
#include "stream/photo/image_io.h"
#include "tests/support/dng.h"
#include "tests/support/run_fixture.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

class RawProject : public RunTest {
 protected:
  /// The scene's photograph as a mosaic: each pixel is a cell of 2 x 2, `columns` and `rows` of the sensor more are repeated at its end.
  void scene_of_raw(int columns, int rows, double gain = 0.1) {
    scene({.photographs = 1, .masks = false});
    const stream::Image picture = stream::read_image(at("scene/photos/photo_00.exr"));
    const int width = 2 * picture.width + columns, height = 2 * picture.height + rows;
    std::vector<std::uint16_t> mosaic;
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x) {
        const double value = static_cast<double>(picture.at(std::min(x / 2, picture.width - 1), std::min(y / 2, picture.height - 1), (x & 1) + (y & 1)));
        mosaic.push_back(static_cast<std::uint16_t>(std::lround(512 + gain * value * (16383 - 512))));
      }
    write_dng(at("scene/photos/photo_00.DNG"), static_cast<std::uint32_t>(width), static_cast<std::uint32_t>(height), mosaic);
    fs::remove(at("scene/photos/photo_00.exr"));
    edit("scene/project.toml", "photos/photo_*.exr", "photos/*.DNG");
    edit("scene/project.toml", "encoding = \"linear\"\n", "");
  }
  void cameras_of(int width, int height, double focal_px, double cx, double cy) {
    put_bytes(at("scene/sparse/cameras.txt"), concat("1 PINHOLE ", width, ' ', height, ' ', focal_px, ' ', focal_px, ' ', cx, ' ', cy, '\n'));
  }
  std::vector<double> lens(const std::string& out) const {
    const nlohmann::json l = json(out + "/work/cameras.json")["cameras"][0]["lens"];
    return {l["size"][0], l["size"][1], l["focal"][0], l["focal"][1], l["centre"][0], l["centre"][1]};
  }
};

TEST_F(RawProject, TakesCamerasOfTheSensorsPixelsByHalf) {
  scene_of_raw(1, 0);   // an odd column is no half pixel
  cameras_of(193, 144, 220, 96, 72);
  const ProcessResult ran = run("out", {"--set", "solve.method=none"});
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_EQ(lens("out"), (std::vector<double>{96, 72, 110, 110, 48, 36}));
}

TEST_F(RawProject, TakesCamerasOfPicturesThatWereDevelopedSmaller) {
  scene_of_raw(0, 0);
  cameras_of(96, 72, 110, 48, 36);
  const ProcessResult ran = run("out", {"--set", "solve.method=none"});
  ASSERT_EQ(ran.code, 0) << ran.err;
  EXPECT_EQ(lens("out"), (std::vector<double>{96, 72, 110, 110, 48, 36}));
  EXPECT_THAT(ran.err, HasSubstr("192 x 144 pixels where the camera is of 96 x 72"));
}

TEST_F(RawProject, LeavesOutWhatCamerasOfTheCameraSJpegsDoNotFit) {
  // The sensor has 22 columns and 12 rows more than the JPEGs of the same shots (an ILCE-7RM2, by a hundredth), which half of it hides: 97 x 72.5 of 96 x 72.
  scene_of_raw(2, 1);
  cameras_of(192, 144, 220, 96, 72);
  const ProcessResult ran = run("out", {"--set", "solve.method=none"});
  EXPECT_EQ(ran.code, 1) << ran.err;
  EXPECT_THAT(ran.err, HasSubstr("photo_00.DNG: is 194 x 145 pixels, but its camera was calibrated for 192 x 144"));
  EXPECT_THAT(ran.err, testing::Not(HasSubstr("taken as a scaled copy")));
}

}  // namespace
}  // namespace chiaro::test
