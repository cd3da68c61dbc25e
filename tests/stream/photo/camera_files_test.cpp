#include "stream/photo/camera_files.h"

#include <algorithm>
#include <cstring>
#include <map>

#include "tests/stream/photo/photo_support.h"

namespace chiaro::stream {
namespace {
namespace fs = std::filesystem;

std::vector<Camera> read(const fs::path& path, std::vector<std::string>* notes_out = nullptr) {
  std::vector<std::string> notes;
  auto cameras = read_cameras(path, notes);
  if (notes_out) *notes_out = notes;
  return cameras;
}

void put_colmap_text(const fs::path& folder, const std::string& cameras, const std::string& images) {
  put_bytes(folder / "cameras.txt", cameras);
  put_bytes(folder / "images.txt", images);
}

const char* kCameras = "# comment\n1 PINHOLE 640 480 600 610 322.5 238.25\n\n7 SIMPLE_RADIAL 100 200 90 50 100 -0.1\r\n";
const char* kImages =
    "# comment\n\n"
    "1 0.5 0.5 -0.5 0.5 1 2 3 1 dir/photo one.exr\n"
    "1.5 2.5 -1 3 4 17\n"
    "2 1 0 0 0 -1 0 +2.5 7 photo_02.exr\n"
    "\n"
    "# between\n"
    "3 1 0 0 0 0 0 0 7 photo_03.exr";

TEST(ColmapText, ReadsAModelByHand) {
  ScratchFolder scratch;
  put_colmap_text(scratch.path(), kCameras, kImages);
  const auto cameras = read(scratch.path());
  ASSERT_EQ(cameras.size(), 3u);
  EXPECT_EQ(cameras[0].photograph, "dir/photo one.exr");
  EXPECT_EQ(cameras[0].lens.width_px, 640);
  EXPECT_EQ(cameras[0].lens.fy, 610);
  // q = (0.5, 0.5, -0.5, 0.5): worked out by hand
  Mat3d expected;
  expected << 0, -1, 0, 0, 0, -1, 1, 0, 0;
  EXPECT_LT((cameras[0].pose.rotation_camera_from_world - expected).norm(), 1e-15);
  EXPECT_EQ(cameras[0].pose.translation_camera_from_world, Vec3d(1, 2, 3));
  EXPECT_EQ(cameras[1].lens.k[0], -0.1);
  EXPECT_EQ(cameras[1].pose.translation_camera_from_world, Vec3d(-1, 0, 2.5));
  EXPECT_EQ(cameras[2].photograph, "photo_03.exr");
}

TEST(ColmapText, FindsTheModelInSubFoldersAndByFile) {
  ScratchFolder scratch;
  fs::create_directories(scratch.path() / "sparse/0");
  put_colmap_text(scratch.path() / "sparse/0", kCameras, kImages);
  EXPECT_EQ(read(scratch.path()).size(), 3u);
  EXPECT_EQ(read(scratch.path() / "sparse").size(), 3u);
  EXPECT_EQ(read(scratch.path() / "sparse/0/images.txt").size(), 3u);
  EXPECT_NE(error_of([&] { read(scratch.path() / "nothing"); }).find("no such file"), std::string::npos);
  fs::create_directories(scratch.path() / "empty");
  EXPECT_NE(error_of([&] { read(scratch.path() / "empty"); }).find("cameras.txt"), std::string::npos);
}

TEST(ColmapText, NamesFileLineAndCameraInErrors) {
  const auto refusal = [](const std::string& cameras, const std::string& images) {
    ScratchFolder scratch;
    put_colmap_text(scratch.path(), cameras, images);
    return error_of([&] { read(scratch.path()); });
  };
  const std::string image = "1 1 0 0 0 0 0 0 1 a.jpg\n\n";
  EXPECT_EQ(refusal("1 PINHOLE 4 3 5 5 2 1.5\n", image), "");
  const auto expect = [](const std::string& message, const std::string& part) { EXPECT_NE(message.find(part), std::string::npos) << message; };
  expect(refusal("1 PINHOLE 4 3 5 5 2\n", image), "cameras.txt: line 1: camera 1: PINHOLE has 3 parameters, expected 4");
  expect(refusal("1 FOV 4 3 5 5 2 1 1\n", image), "\"FOV\" is not supported");
  expect(refusal("1 PINHOLE 0 3 5 5 2 1\n", image), "image side of 0");
  expect(refusal("1 PINHOLE 99999999999 3 5 5 2 1\n", image), "image side of 99999999999");
  expect(refusal("1 PINHOLE 4 3 nan 5 2 1\n", image), "expected a finite number");
  expect(refusal("1 PINHOLE 4 3 -5 5 2 1\n", image), "focal length -5");
  expect(refusal("2 PINHOLE 4 3 5 5 2 1\n", image), "uses camera 1");
  expect(refusal("1 PINHOLE 4 3 5 5 2 1\n1 PINHOLE 4 3 5 5 2 1\n", image), "given twice");
  const std::string good = "1 PINHOLE 4 3 5 5 2 1\n";
  expect(refusal(good, "#\n1 0 0 0 0 0 0 0 1 a.jpg\n\n"), "images.txt: line 2: image \"a.jpg\": quaternion of length 0");
  expect(refusal(good, "1 1 0 0 0 inf 0 0 1 a.jpg\n\n"), "translation is \"inf\"");
  expect(refusal(good, image + image), "given twice");
  expect(refusal(good, "1 1 0 0 0 0 0 0 1 a.jpg\n2 1 0 0 0 0 0 0 1 b.jpg\n"), "two lines");
  expect(refusal(good, "1 1 0 0 0 0 0 0 1\n\n"), "without a name");
  expect(refusal(good, std::string(1 << 17, '1')), "longer than");
}

TEST(ColmapText, PassesOverPointLinesOfMegabytes) {
  ScratchFolder scratch;
  std::string points;
  for (int i = 0; i < 300000; ++i) points += "1.25 2.5 -1 ";
  put_colmap_text(scratch.path(), "1 PINHOLE 4 3 5 5 2 1.5\n", "1 1 0 0 0 0 0 0 1 a.jpg\n" + points + "\n2 1 0 0 0 0 0 0 1 b.jpg\n" + points);
  EXPECT_EQ(read(scratch.path()).size(), 2u);
}

TEST(ColmapText, SurvivesDamage) {
  ScratchFolder scratch;
  put_colmap_text(scratch.path(), kCameras, kImages);
  EXPECT_GT(survive_damage(scratch.path() / "cameras.txt", kCameras, 1000, [&] { read(scratch.path()); }), 20);
  put_bytes(scratch.path() / "cameras.txt", kCameras);
  EXPECT_GT(survive_damage(scratch.path() / "images.txt", kImages, 1000, [&] { read(scratch.path()); }), 20);
}

TEST(ColmapText, AnImageInPlaceOfPointsIsNoticedWhateverItsName) {
  ScratchFolder scratch;
  // Each image on one line; a name of three words makes twelve words, a multiple of three.
  put_colmap_text(scratch.path(), "1 PINHOLE 640 480 600 610 322.5 238.25\n", "1 1 0 0 0 0 0 0 1 a.jpg\n2 1 0 0 0 0 0 0 1 the second one.jpg\n3 1 0 0 0 0 0 0 1 c.jpg\n");
  EXPECT_NE(error_of([&] { read(scratch.path()); }).find("line 1: image \"a.jpg\": the line of its points that follows holds 12 words that are not all numbers"), std::string::npos);
}

TEST(ColmapText, AByteOrderMarkIsPassedOver) {
  ScratchFolder scratch;
  put_colmap_text(scratch.path(), std::string("\xef\xbb\xbf") + kCameras, std::string("\xef\xbb\xbf") + kImages);
  EXPECT_EQ(read(scratch.path()).size(), 3u);
}

TEST(ColmapText, FurtherModelsAreNoted) {
  ScratchFolder scratch;
  std::vector<std::string> notes;
  for (const char* model : {"0", "1", "2"}) {
    fs::create_directories(scratch.path() / "sparse" / model);
    put_colmap_text(scratch.path() / "sparse" / model, kCameras, kImages);
  }
  read(scratch.path(), &notes);
  ASSERT_EQ(notes.size(), 1u);
  EXPECT_NE(notes[0].find("further models beside it (1, 2)"), std::string::npos) << notes[0];
  notes.clear();
  read(scratch.path() / "sparse/1", &notes);
  EXPECT_TRUE(notes.empty());
}

template <class T>
void append(std::string& out, T value) {
  out.append(reinterpret_cast<const char*>(&value), sizeof value);
}

struct BinaryModel {
  std::string cameras, images;
};

BinaryModel small_binary(std::int32_t model = 6, int num_params = 12) {
  BinaryModel out;
  append<std::uint64_t>(out.cameras, 1);
  append<std::uint32_t>(out.cameras, 3);
  append<std::int32_t>(out.cameras, model);
  append<std::uint64_t>(out.cameras, 640);
  append<std::uint64_t>(out.cameras, 480);
  for (int i = 0; i < num_params; ++i) append<double>(out.cameras, i < 4 ? 600 + i : 0.001 * i);
  append<std::uint64_t>(out.images, 2);
  for (int i = 0; i < 2; ++i) {
    append<std::uint32_t>(out.images, static_cast<std::uint32_t>(i));
    for (const double v : {1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0 + i}) append<double>(out.images, v);
    append<std::uint32_t>(out.images, 3);
    out.images += i ? "b.jpg" : "a.jpg";
    out.images.push_back('\0');
    append<std::uint64_t>(out.images, 2);
    for (int k = 0; k < 6; ++k) append<double>(out.images, k);
  }
  return out;
}

void put_binary(const fs::path& folder, const BinaryModel& model) {
  put_bytes(folder / "cameras.bin", model.cameras);
  put_bytes(folder / "images.bin", model.images);
}

TEST(ColmapBinary, ReadsAModelByHand) {
  ScratchFolder scratch;
  put_binary(scratch.path(), small_binary());
  const auto cameras = read(scratch.path());
  ASSERT_EQ(cameras.size(), 2u);
  EXPECT_EQ(cameras[1].photograph, "b.jpg");
  EXPECT_EQ(cameras[1].pose.translation_camera_from_world, Vec3d(1, 2, 4));
  // FULL_OPENCV order: fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6
  EXPECT_EQ(cameras[0].lens.fy, 601);
  EXPECT_EQ(cameras[0].lens.k, (std::array<double, 7>{0.001 * 4, 0.001 * 5, 0.001 * 8, 0.001 * 9, 0.001 * 10, 0.001 * 11, 0}));
  EXPECT_EQ(cameras[0].lens.p, (std::array<double, 4>{0.006, 0.007, 0, 0}));
}

TEST(ColmapBinary, RefusesModelsByNameAndCountsByFileSize) {
  ScratchFolder scratch;
  put_binary(scratch.path(), small_binary(7, 5));
  EXPECT_NE(error_of([&] { read(scratch.path()); }).find("offset 8: camera 3: lens model FOV (id 7) is not supported"), std::string::npos);
  BinaryModel model = small_binary();
  const std::uint64_t huge = std::uint64_t{1} << 60;
  std::memcpy(model.images.data(), &huge, 8);
  put_binary(scratch.path(), model);
  EXPECT_NE(error_of([&] { read(scratch.path()); }).find("1152921504606846976 images claimed"), std::string::npos);
  model = small_binary();
  std::memcpy(model.images.data() + 8 + 4 + 56 + 4 + 6, &huge, 8);
  put_binary(scratch.path(), model);
  EXPECT_NE(error_of([&] { read(scratch.path()); }).find("points claimed"), std::string::npos);
}

TEST(ColmapBinary, RefusesEveryPrefixAndSurvivesDamage) {
  ScratchFolder scratch;
  const BinaryModel model = small_binary();
  put_binary(scratch.path(), model);
  for (std::size_t i = 0; i < model.images.size(); ++i) {
    put_bytes(scratch.path() / "images.bin", model.images.substr(0, i));
    EXPECT_NE(error_of([&] { read(scratch.path()); }), "") << i;
  }
  survive_damage(scratch.path() / "images.bin", model.images, 1000, [&] { read(scratch.path()); });
  put_binary(scratch.path(), model);
  survive_damage(scratch.path() / "cameras.bin", model.cameras, 1000, [&] { read(scratch.path()); });
}

TEST(LensFromColmap, FisheyeParametersGoToTheAngle) {
  const double params[] = {500, 501, 320, 240, 0.1, 0.2, 0.3, 0.4};
  const Lens lens = lens_from_colmap("OPENCV_FISHEYE", 640, 480, params, "here");
  EXPECT_EQ(lens.kind, LensKind::kFisheye);
  EXPECT_EQ(lens.k, (std::array<double, 7>{0.1, 0.2, 0.3, 0.4, 0, 0, 0}));
  const double radial[] = {500, 320, 240, 0.1, 0.2};
  EXPECT_EQ(lens_from_colmap("RADIAL_FISHEYE", 640, 480, radial, "here").k[1], 0.2);
  EXPECT_EQ(lens_from_colmap("RADIAL", 640, 480, radial, "here").kind, LensKind::kPerspective);
  const double plain[] = {500, 501, 320, 240};
  for (const auto& [model, num] : {std::pair{"FISHEYE", 4u}, {"SIMPLE_FISHEYE", 3u}}) {
    const Lens equidistant = lens_from_colmap(model, 640, 480, std::span(plain).last(num), "here");
    EXPECT_EQ(equidistant.kind, LensKind::kFisheye) << model;
    EXPECT_EQ(equidistant.fx, num == 4 ? 500 : 501) << model;
    EXPECT_EQ(equidistant.cy, 240) << model;
    EXPECT_EQ(equidistant.k, (std::array<double, 7>{})) << model;
  }
}

std::string metashape(const std::string& cameras, const std::string& transform = "", const std::string& calibration =
                                                                                          "<f>500</f><cx>3</cx><cy>-4</cy><k1>0.1</k1><k4>0.04</k4>"
                                                                                          "<p1>0.001</p1><p2>0.002</p2><p3>0.3</p3><b1>2</b1><b2>0.5</b2>") {
  return "<?xml version=\"1.0\"?>\n<document version=\"2.0.0\">\n<chunk enabled=\"true\">\n<sensors>\n"
         "<sensor id=\"0\" label=\"lens\" type=\"frame\"><resolution width=\"640\" height=\"480\"/>\n"
         "<calibration type=\"frame\" class=\"initial\"><resolution width=\"640\" height=\"480\"/><f>1</f></calibration>\n"
         "<calibration type=\"frame\" class=\"adjusted\"><resolution width=\"640\" height=\"480\"/>" + calibration + "</calibration></sensor>\n"
         "<sensor id=\"1\" label=\"bare\" type=\"frame\"><resolution width=\"640\" height=\"480\"/></sensor>\n"
         "<sensor id=\"2\" label=\"ball\" type=\"spherical\"><calibration type=\"spherical\"/></sensor>\n"
         "</sensors>\n<components><component id=\"5\"><transform><translation>0 0 100</translation></transform></component></components>\n"
         "<cameras>\n" + cameras + "</cameras>\n" + transform + "</chunk>\n</document>\n";
}

const char* kIdentity = "<transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform>";

std::string camera_xml(const std::string& label, const std::string& inside, const std::string& attributes = "sensor_id=\"0\"") {
  return "<camera id=\"0\" " + attributes + " label=\"" + label + "\">" + inside + "</camera>\n";
}

TEST(Metashape, ReadsCalibrationPoseAndChunkTransformByHand) {
  ScratchFolder scratch;
  const fs::path file = scratch.path() / "cameras.xml";
  // Camera at (1, 2, 3) in the chunk, turned by 90 degrees about z; the chunk doubles, turns by 90 degrees about x and shifts.
  put_bytes(file, metashape(camera_xml("IMG_1", "<transform>0 -1 0 1 1 0 0 2 0 0 1 3 0 0 0 1</transform>"),
                            "<transform><rotation>1 0 0 0 0 -1 0 1 0</rotation><translation>10 20 30</translation><scale>2</scale></transform>"));
  const auto cameras = read(file);
  ASSERT_EQ(cameras.size(), 1u);
  const Lens& lens = cameras[0].lens;
  EXPECT_EQ(cameras[0].photograph, "IMG_1");
  EXPECT_EQ(lens.fx, 502);
  EXPECT_EQ(lens.fy, 500);
  EXPECT_EQ(lens.skew, 0.5);
  EXPECT_EQ(lens.cx, 323);
  EXPECT_EQ(lens.cy, 236);
  EXPECT_EQ(lens.k, (std::array<double, 7>{0.1, 0, 0, 0, 0, 0, 0.04}));
  EXPECT_EQ(lens.p, (std::array<double, 4>{0.002, 0.001, 0.3, 0}));
  EXPECT_LT((cameras[0].pose.centre_in_world() - Vec3d(10 + 2, 20 - 6, 30 + 4)).norm(), 1e-14);
  // camera x = chunk y = world z
  EXPECT_LT((cameras[0].pose.rotation_camera_from_world.row(0).transpose() - Vec3d(0, 0, 1)).norm(), 1e-15);
}

TEST(Metashape, SkipsUnalignedAndDisabledCamerasAndReadsGroups) {
  ScratchFolder scratch;
  const fs::path file = scratch.path() / "cameras.xml";
  put_bytes(file, metashape(camera_xml("a.jpg", kIdentity) + camera_xml("lost", "") + camera_xml("off", kIdentity, "sensor_id=\"0\" enabled=\"false\"") +
                            "<group id=\"0\"><group id=\"1\">" + camera_xml("b", kIdentity, "sensor_id=\"0\" component_id=\"5\"") + "</group></group>" +
                            camera_xml("c", kIdentity)));
  std::vector<std::string> notes;
  const auto cameras = read(file, &notes);
  ASSERT_EQ(cameras.size(), 3u);
  EXPECT_EQ(cameras[1].photograph, "b");
  EXPECT_EQ(cameras[1].pose.centre_in_world(), Vec3d(0, 0, 100));  // its component's own transform
  EXPECT_EQ(cameras[2].pose.centre_in_world(), Vec3d(0, 0, 0));
  ASSERT_EQ(notes.size(), 2u);
  EXPECT_NE(notes[0].find("1 cameras have no position in the file (not aligned) and are left out: lost"), std::string::npos);
  EXPECT_NE(notes[1].find("disabled"), std::string::npos);
}

TEST(Metashape, CamerasOfAComponentInAFrameOfItsOwnAreLeftOut) {
  ScratchFolder scratch;
  const fs::path file = scratch.path() / "cameras.xml";
  std::string text = metashape(camera_xml("a", kIdentity, "sensor_id=\"0\" component_id=\"0\"") + camera_xml("b", kIdentity, "sensor_id=\"0\" component_id=\"1\"") +
                                   camera_xml("c", kIdentity, "sensor_id=\"0\" component_id=\"5\"") + camera_xml("d", kIdentity),
                               "<transform><translation>0 0 7</translation></transform>");
  const std::string components = "<components>";
  text.replace(text.find(components), components.size(), "<components active_id=\"0\"><component id=\"0\"/><component id=\"1\"/>");
  put_bytes(file, text);
  std::vector<std::string> notes;
  const auto cameras = read(file, &notes);
  ASSERT_EQ(cameras.size(), 3u);
  EXPECT_EQ(cameras[0].pose.centre_in_world(), Vec3d(0, 0, 7));    // the active one's, as the chunk repeats it
  EXPECT_EQ(cameras[1].pose.centre_in_world(), Vec3d(0, 0, 100));  // a transform of its own
  EXPECT_EQ(cameras[2].photograph, "d");
  ASSERT_EQ(notes.size(), 1u);
  EXPECT_NE(notes[0].find("1 cameras belong to another component of the chunk than the active one"), std::string::npos) << notes[0];
}

TEST(Metashape, WhatIsNotFollowedIsNoted) {
  ScratchFolder scratch;
  const fs::path file = scratch.path() / "cameras.xml";
  std::vector<std::string> notes;
  const auto noted = [&](const std::string& cameras, const std::string& calibration, const char* what) {
    put_bytes(file, metashape(cameras, "", calibration));
    notes.clear();
    EXPECT_EQ(read(file, &notes).size(), 1u);
    return std::any_of(notes.begin(), notes.end(), [&](const std::string& note) { return note.find(what) != std::string::npos; });
  };
  const std::string plain = "<f>500</f><cx>3</cx><skew>0</skew><date>2024</date>", one = camera_xml("a", kIdentity);
  EXPECT_FALSE(noted(one, plain, ""));
  EXPECT_TRUE(noted(one, plain + "<k5>0.1</k5><skew>0.2</skew>", "calibration of sensor \"lens\" holds k5, skew, which is not followed"));
  EXPECT_TRUE(noted(one + camera_xml("b", "", "sensor_id=\"0\" master_id=\"0\""), plain, "1 cameras belong to a rig and have their position from another camera (master_id), which is not supported; they are left out: b"));
  EXPECT_TRUE(noted(camera_xml("a", std::string(kIdentity) + "<rolling_shutter>1 0 0 0.1</rolling_shutter>"), plain, "1 cameras have a rolling shutter in the file, which is not followed"));
  EXPECT_FALSE(noted(camera_xml("a", std::string(kIdentity) + "<property name=\"rolling_shutter\" value=\"false\"/>"), plain, "rolling"));
}

TEST(Metashape, NamesFileLineAndCameraInErrors) {
  ScratchFolder scratch;
  const fs::path file = scratch.path() / "cameras.xml";
  const auto expect = [&](const std::string& text, const std::string& part) {
    put_bytes(file, text);
    const std::string message = error_of([&] { read(file); });
    EXPECT_NE(message.find(part), std::string::npos) << message;
  };
  expect("", "not valid XML");
  expect("<document>\n<chunk>\n\n</document>\n", "line 4: not valid XML");
  expect("<html/>", "no <document>");
  expect("<document/>", "no enabled <chunk>");
  expect(metashape(camera_xml("a", "<transform>1 2 3</transform>")), "line 13: <transform> holds 3 numbers, expected 16");
  expect(metashape(camera_xml("a", "<transform>0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 1</transform>")), "line 13: camera \"a\": rotation is not orthonormal");
  expect(metashape(camera_xml("a", "<transform>1 0 0 nan 0 1 0 0 0 0 1 0 0 0 0 1</transform>")), "expected a finite number");
  expect(metashape(camera_xml("a", "<transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2</transform>")), "0 0 0 1");
  expect(metashape(camera_xml("a", kIdentity, "sensor_id=\"9\"")), "sensor \"9\" is not in the file");
  expect(metashape(camera_xml("a", kIdentity, "sensor_id=\"1\"")), "has no <calibration>");
  expect(metashape(camera_xml("a", kIdentity, "sensor_id=\"2\"")), "is of type \"spherical\"");
  expect(metashape(camera_xml("a", kIdentity), "<transform><scale>0</scale></transform>"), "scale is 0");
  expect(metashape(camera_xml("a", kIdentity), "", "<f>-3</f>"), "focal length -3");
  expect(metashape(camera_xml("a", kIdentity), "", "<cx>3</cx>"), "without <f>");
  std::string deep = camera_xml("a", kIdentity);
  for (int i = 0; i < 100; ++i) deep = "<group>" + deep + "</group>";
  expect(metashape(deep), "nested more than 32 deep");
}

TEST(Metashape, RefusesEveryPrefixAndSurvivesDamage) {
  ScratchFolder scratch;
  const fs::path file = scratch.path() / "cameras.xml";
  const std::string text = metashape(camera_xml("a", kIdentity), "<transform><scale>2</scale></transform>");
  for (std::size_t i = 0; i + 12 < text.size(); ++i) {
    put_bytes(file, text.substr(0, i));
    EXPECT_NE(error_of([&] { read(file); }), "") << i;
  }
  survive_damage(file, text, 2000, [&] { read(file); });
}

std::vector<Camera> named(std::initializer_list<const char*> names) {
  std::vector<Camera> cameras;
  for (const char* name : names) cameras.push_back({name, {}, {}});
  return cameras;
}

TEST(FindCamera, PrefersFileNameThenFoldersThenStem) {
  const auto cameras = named({"a.jpg", "left/b.jpg", "right/b.jpg", "IMG_1", "c.tif", "v1.2"});
  const auto found = [&](const char* path) {
    const Camera* camera = find_camera(cameras, path);
    return camera ? camera->photograph : std::string("-");
  };
  EXPECT_EQ(found("/data/photos/a.jpg"), "a.jpg");
  EXPECT_EQ(found("photos/right/b.jpg"), "right/b.jpg");
  EXPECT_EQ(found("photos\\left\\b.jpg"), "left/b.jpg");
  EXPECT_EQ(found("photos/IMG_1.jpg"), "IMG_1");
  EXPECT_EQ(found("photos/c.exr"), "c.tif");
  EXPECT_EQ(found("photos/v1.2.jpg"), "v1.2");
  EXPECT_EQ(found("photos/d.jpg"), "-");
  EXPECT_NE(error_of([&] { found("b.jpg"); }).find("\"left/b.jpg\", \"right/b.jpg\""), std::string::npos);
}

TEST(FindCamera, DoesNotTakeAPhotographOfAnotherFolderWhereNamesRepeat) {
  const auto cameras = named({"left/1.jpg", "left/2.jpg", "right/2.jpg"});
  EXPECT_EQ(find_camera(cameras, "photos/right/1.jpg"), nullptr);
  EXPECT_EQ(find_camera(cameras, "photos/left/1.jpg"), &cameras[0]);
  EXPECT_EQ(find_camera(cameras, "1.jpg"), &cameras[0]);
  const auto unique = named({"day1/1.jpg", "day2/2.jpg"});
  EXPECT_EQ(find_camera(unique, "photos/1.jpg"), &unique[0]);
}

// ---- files that other programs wrote

TEST(RealCameras, MetashapeAgreesWithItsColmapForm) {
  CHIARO_NEED_SHARED(shared);
  const fs::path rodin = shared / "real/rodin_flash";
  std::vector<std::string> notes;
  const auto metashape_cameras = read(rodin / "Mia_001239_Rodin_399cameras.xml", &notes);
  const auto colmap_cameras = read(rodin / "derived/colmap");
  ASSERT_EQ(metashape_cameras.size(), 397u);
  ASSERT_EQ(colmap_cameras.size(), 397u);
  ASSERT_FALSE(notes.empty());
  EXPECT_NE(notes[0].find("2 cameras have no position"), std::string::npos) << notes[0];
  // The derived model leaves the chunk transform out, so points are moved by it first.
  Mat3d r;
  r << -0.018560033512641488, -0.99975592822652748, 0.011983702763517037, 0.99585764783455988, -0.017417951222959804, 0.089242143769704602,
      -0.089011630731200858, 0.013590399225530349, 0.99593786485074631;
  const Vec3d t(-4.4470442155682575, 4.2906599388270266, -0.38572762464686594);
  double worst = 0;
  int compared = 0;
  for (const Camera& colmap : colmap_cameras) {
    const Camera* camera = find_camera(metashape_cameras, "photos/" + colmap.photograph);
    ASSERT_TRUE(camera) << colmap.photograph;
    const Lens quarter = scaled_to(camera->lens, 2172, 1448, colmap.photograph);
    for (std::uint32_t i = 0; i < 50; ++i) {
      const Vec3d p(uniform(i, 0, -12, 4), uniform(i, 1, -4, 4), uniform(i, 2, -11, -3));
      const auto a = project(colmap.lens, colmap.pose.camera_from_world(p)), b = project(quarter, camera->pose.camera_from_world(r * p + t));
      if (!a || a->x() < 0 || a->y() < 0 || a->x() > 2172 || a->y() > 1448) continue;
      ASSERT_TRUE(b);
      worst = std::max(worst, (*a - *b).norm());
      ++compared;
    }
  }
  EXPECT_GT(compared, 2000);
  EXPECT_LT(worst, 1e-6);  // measured 1e-9; the issue asks for 1e-3
  RecordProperty("worst_px", std::to_string(worst));
}

TEST(RealCameras, ColmapTextAndBinaryAgree) {
  CHIARO_NEED_SHARED(shared);
  const auto text = read(shared / "real/sceaux/formats/colmap_txt"), binary = read(shared / "real/sceaux/formats/colmap_bin");
  ASSERT_EQ(text.size(), 11u);
  ASSERT_EQ(binary.size(), 11u);
  for (const Camera& a : text) {
    const Camera* b = find_camera(binary, a.photograph);
    ASSERT_TRUE(b) << a.photograph;
    EXPECT_EQ(a.photograph, b->photograph);
    // The text model holds 6 digits.
    EXPECT_LT((a.pose.rotation_camera_from_world - b->pose.rotation_camera_from_world).norm(), 1e-5);
    EXPECT_LT((a.pose.translation_camera_from_world - b->pose.translation_camera_from_world).norm(), 1e-4);
    EXPECT_NEAR(a.lens.fx, b->lens.fx, 0.01);
    EXPECT_NEAR(a.lens.k[0], b->lens.k[0], 1e-6);
  }
}

TEST(RealCameras, ProjectsColmapPointsOntoTheirObservations) {
  CHIARO_NEED_SHARED(shared);
  const fs::path folder = shared / "real/sceaux/formats/colmap_txt";
  const auto cameras = read(folder);
  // points3D.txt: id x y z r g b error (image point)...; images.txt holds the observed pixels.
  std::ifstream images(folder / "images.txt");
  std::map<int, std::pair<const Camera*, std::vector<Vec2d>>> observed;
  for (std::string line; std::getline(images, line);) {
    if (line.empty() || line[0] == '#') continue;
    std::istringstream head(line);
    int id = 0;
    head >> id;
    const std::string name = line.substr(line.rfind(' ') + 1);
    std::getline(images, line);
    std::istringstream points(line);
    std::vector<Vec2d> pixels;
    double x = 0, y = 0, point = 0;
    while (points >> x >> y >> point) pixels.push_back({x, y});
    observed[id] = {find_camera(cameras, name), pixels};
  }
  std::ifstream points(folder / "points3D.txt");
  std::vector<double> errors;
  for (std::string line; std::getline(points, line);) {
    if (line.empty() || line[0] == '#') continue;
    std::istringstream in(line);
    double id = 0, red = 0, green = 0, blue = 0, error = 0;
    Vec3d p;
    in >> id >> p.x() >> p.y() >> p.z() >> red >> green >> blue >> error;
    int image = 0;
    std::size_t index = 0;
    while (in >> image >> index) {
      const auto& [camera, pixels] = observed.at(image);
      const auto pixel = project(camera->lens, camera->pose.camera_from_world(p));
      ASSERT_TRUE(pixel);
      errors.push_back((*pixel - pixels.at(index)).norm());
    }
  }
  ASSERT_GT(errors.size(), 10000u);
  std::nth_element(errors.begin(), errors.begin() + static_cast<std::ptrdiff_t>(errors.size() / 2), errors.end());
  EXPECT_LT(errors[errors.size() / 2], 0.6);  // half-pixel mistakes would show here
}

TEST(RealCameras, ReadsTheRenderedScenes) {
  CHIARO_NEED_SHARED(shared);
  for (const char* scene : {"sphere", "vplanes", "tower", "chamber"}) {
    if (!fs::exists(shared / "scenes" / scene)) continue;
    const auto cameras = read(shared / "scenes" / scene / "sparse");
    EXPECT_FALSE(cameras.empty()) << scene;
  }
}

}  // namespace
}  // namespace chiaro::stream
