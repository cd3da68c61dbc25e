/// A ground that one photograph shows, all by hand: no store, no rays.
#pragma once
#include "optimize/acquisition.h"
#include "stream/base/file.h"
#include "tests/optimize/picture.h"

namespace chiaro::optimize::tests {

inline constexpr int kWidth = 9, kHeight = 7;   ///< pixels, until a test says otherwise

/// The ground z = 0 before a camera that looks down, a little aslant, and is turned about its axis. The transport is empty.
struct PicturedGround {
  explicit PicturedGround(double focal_px = 14, int width = kWidth, int height = kHeight) {
    scene.proxy.origin_in_world = Vec3d(3, -2, 0.5);
    for (int i = 0; i < 21; ++i)
      for (int k = 0; k < 21; ++k) {
        scene.proxy.position.push_back((Vec3d(0.1 * (i - 10), 0.1 * (k - 10), 0) - scene.proxy.origin_in_world).cast<float>());
        scene.proxy.normal.push_back(Vec3f::UnitZ());
        scene.proxy.radius.push_back(0.06f);
      }
    scene.nearest = std::make_unique<NearestPoints>(scene.proxy.position);
    stream::Lens& lens = photo.camera.lens;
    lens.width_px = width;
    lens.height_px = height;
    lens.fx = lens.fy = focal_px;
    lens.cx = width / 2.0;
    lens.cy = height / 2.0;
    const Mat3d look_down = Vec3d(1, -1, -1).asDiagonal();
    photo.camera.pose.rotation_camera_from_world = look_down * (Eigen::AngleAxisd(0.7, Vec3d::UnitZ()) * Eigen::AngleAxisd(0.1, Vec3d::UnitX())).toRotationMatrix();
    photo.camera.pose.translation_camera_from_world = -photo.camera.pose.rotation_camera_from_world * eye;
    photo.radiance = folder.path() / "radiance.raster";
    photo.gbuffer = folder.path() / "gbuffer.raster";
    for (const char* name : {"nx", "ny", "shadow", "spread", "flash"}) planes[name] = even(0);
    for (const char* name : {"nz", "cosv", "coverage", "mask", "lit"}) planes[name] = even(1);
    for (const char* name : {"r", "g", "b"}) planes[name] = even(0.2);
    planes["radius"] = planes["footprint"] = even(0.05);
    planes["edge"] = even(20);
    planes["depth"] = [this](int x, int y) { return static_cast<float>(eye.z() / -to_pixel(x, y).z()); };
  }
  PicturedGround(const PicturedGround&) = delete;   // the planes know where they are

  /// Unit, world.
  Vec3d to_pixel(int x, int y) const {
    const stream::Lens& lens = photo.camera.lens;
    return photo.camera.pose.rotation_camera_from_world.transpose() * Vec3d((x + 0.5 - lens.cx) / lens.fx, (y + 0.5 - lens.cy) / lens.fy, 1).normalized();
  }
  /// On the ground, world.
  Vec3d place(int x, int y) const {
    const Vec3d d = to_pixel(x, y);
    return eye + d * (eye.z() / -d.z());
  }
  double depth_along_axis(const Vec3d& p) const { return (photo.camera.pose.rotation_camera_from_world * (p - eye)).z(); }
  Vec3d in_world(std::size_t surfel) const { return scene.proxy.position[surfel].cast<double>() + scene.proxy.origin_in_world; }
  /// Pixel coordinates.
  Vec2d in_picture(std::size_t surfel) const {
    const Vec3d p = photo.camera.pose.rotation_camera_from_world * (in_world(surfel) - eye);
    const stream::Lens& lens = photo.camera.lens;
    return {lens.cx + lens.fx * p.x() / p.z(), lens.cy + lens.fy * p.y() / p.z()};
  }
  void write() const { write_picture(photo.radiance, photo.gbuffer, photo.camera.lens.width_px, photo.camera.lens.height_px, planes); }

  const Vec3d eye{0.12, -0.07, 1.5};
  ScratchFolder folder;
  Scene scene;
  ObserveInput photo;
  std::map<std::string, Plane> planes;
};

}  // namespace chiaro::optimize::tests
