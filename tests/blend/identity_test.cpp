/// What a blend's state depends on is in its key: a state of something else is never gone on from.
#include "blend/identity.h"

#include <gtest/gtest.h>

#include <set>

#include "stream/base/file.h"
#include "tests/blend/workplace.h"

namespace chiaro::blend {
namespace {

using namespace testing;

TEST(Identity, EverythingThatAPhotographIsCountsInItsKey) {
  const ScratchFolder folder;
  BlendPhotograph p;
  p.name = "a";
  for (const auto& [path, name] : {std::pair{&p.gbuffer, "gbuffer"}, {&p.albedo, "albedo"}, {&p.radiance, "radiance"}}) {
    *path = folder.path() / name;
    write_text(*path, std::string(200000, 'x'));
  }
  std::set<std::string> keys{photograph_key(p)};
  std::size_t changes = 0;
  const auto expect_another_key = [&](const BlendPhotograph& other, const std::string& what) {
    ++changes;
    EXPECT_TRUE(keys.insert(photograph_key(other)).second) << what;
  };
  const auto change = [&](const std::string& what, const auto& how) {
    BlendPhotograph other = p;
    how(other);
    expect_another_key(other, what);
  };
  change("name", [](BlendPhotograph& o) { o.name = "b"; });
  change("lens kind", [](BlendPhotograph& o) { o.camera.lens.kind = stream::LensKind::kFisheye; });
  using Lens = stream::Lens;
  for (double Lens::*const value : {&Lens::fx, &Lens::fy, &Lens::cx, &Lens::cy, &Lens::skew}) change("lens", [&](BlendPhotograph& o) { o.camera.lens.*value = 3; });
  for (std::size_t i = 0; i < 7; ++i) change("k", [&](BlendPhotograph& o) { o.camera.lens.k[i] = 0.1; });
  for (std::size_t i = 0; i < 4; ++i) change("p", [&](BlendPhotograph& o) { o.camera.lens.p[i] = 0.1; });
  for (int i = 0; i < 9; ++i) change("rotation", [&](BlendPhotograph& o) { o.camera.pose.rotation_camera_from_world(i / 3, i % 3) = 0.5; });
  for (int i = 0; i < 3; ++i) change("translation", [&](BlendPhotograph& o) { o.camera.pose.translation_camera_from_world[i] = 0.5; });
  change("aperture", [](BlendPhotograph& o) { o.camera.focus = {0.01, 2}; });
  change("focus distance", [](BlendPhotograph& o) { o.camera.focus = {0.01, 3}; });
  for (const std::filesystem::path& raster : {p.gbuffer, p.albedo, p.radiance})
    for (const std::size_t at : {100u, 199990u}) {   // planes are told by the checksums at the end
      std::string bytes(200000, 'x');
      bytes[at] = 'y';
      write_text(raster, bytes);
      expect_another_key(p, raster.string());
      write_text(raster, std::string(200000, 'x'));
    }
  EXPECT_EQ(keys.size(), changes + 1);
}

TEST(Identity, EveryOptionThatTheSumsDependOnCountsInTheKey) {
  const Workplace w(plane_scene());
  std::set<std::string> keys{options_key(*w.store, {})};
  const auto key_with = [&](const auto& set) {
    BlendOptions options;
    set(options);
    return options_key(*w.store, options);
  };
  EXPECT_TRUE(keys.insert(key_with([](BlendOptions& o) { o.bands = 3; })).second);
  EXPECT_TRUE(keys.insert(key_with([](BlendOptions& o) { o.bands = 4; })).second);
  EXPECT_TRUE(keys.insert(key_with([](BlendOptions& o) { o.low_band_px = 9; })).second);
  EXPECT_TRUE(keys.insert(key_with([](BlendOptions& o) { o.border_px = 9; })).second);
  EXPECT_TRUE(keys.insert(key_with([](BlendOptions& o) { o.high_band_power = 3; })).second);
  EXPECT_TRUE(keys.insert(key_with([](BlendOptions& o) { o.reject = false; })).second);
  EXPECT_TRUE(keys.insert(key_with([](BlendOptions& o) { o.gain = Gain::kChannels; })).second);
  EXPECT_TRUE(keys.insert(key_with([](BlendOptions& o) { o.align = false; })).second);
  // What is applied when all is added up is not part of it.
  EXPECT_TRUE(keys.contains(key_with([](BlendOptions& o) { o.layer = "other", o.shared_sigma = 0.1, o.denoise = true; })));
}

}  // namespace
}  // namespace chiaro::blend
