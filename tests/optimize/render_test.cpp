#include "optimize/render.h"

#include <gtest/gtest.h>


#include "stream/base/file.h"
#include "stream/photo/image_io.h"
#include "tests/support/planes.h"
#include "tests/support/sampled_surface.h"

namespace chiaro::optimize {
namespace {

constexpr float kAlbedo = 0.5f;

stream::Layer write_even_layer(const stream::Store& store) {
  stream::LayerWriter writer(store, "albedo", stream::albedo_fields(), "{}");
  for (const std::uint32_t leaf : store.leaves()) {
    const std::size_t n = store.read_chunk(leaf).count;
    const std::vector<float> albedo(3 * n, kAlbedo), sigma(n, 0.01f);
    const std::vector<std::uint16_t> photos(n, 1);
    writer.write_chunk(leaf, tests::planes_of(albedo, sigma, photos));
  }
  writer.finish_inner(silent_reporter());
  writer.commit();
  return stream::Layer(store, "albedo");
}

/// From three metres above, a pixel a quarter of the wedge's spacing wide.
RenderView from_above() {
  RenderView view;
  view.name = "above";
  view.lens.width_px = 64;
  view.lens.height_px = 128;
  view.lens.fx = view.lens.fy = 4 * 3 / tests::kWedgeSpacing;
  view.lens.cx = 32;
  view.lens.cy = 64;
  view.pose.rotation_camera_from_world = Vec3d(1, -1, -1).asDiagonal();
  view.pose.translation_camera_from_world = {0, 0, 3};
  return view;
}

TEST(Render, AnOutlineLiesWhereThePointsEnd) {
  const ScratchFolder folder;
  const stream::Store store = tests::build_test_store(tests::blunt_wedge(), folder.path());
  const stream::Layer layer = write_even_layer(store);
  const RenderView view = from_above();
  RenderOptions options;
  options.mode = RenderMode::kAlbedo;
  MemoryBudget budget(256u << 20);
  render(store, layer, nullptr, view, options, folder.path() / "above.exr", budget, silent_reporter());
  const stream::Image picture = stream::read_exr_channels(folder.path() / "above.exr", {"R"});
  double covered = 0;
  for (const float value : picture.values) covered += static_cast<double>(value / kAlbedo);
  const double width_px = covered / view.lens.height_px, true_px = view.lens.cx - view.lens.fx * tests::kBlunt / 3;
  constexpr double kMostOff = 0.3;   // of 4 pixels a spacing
  EXPECT_NEAR(width_px, true_px, kMostOff);
}

}  // namespace
}  // namespace chiaro::optimize
