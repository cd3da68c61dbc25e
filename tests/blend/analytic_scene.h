/// Rectangles and spheres with a painted albedo: their points, and what a camera sees of them, computed exactly and without the ray caster.
#pragma once
#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "blend/blend.h"
#include "stream/photo/camera.h"

namespace chiaro::blend::testing {

struct Rectangle {
  Vec3d corner, u, v;   ///< corner + s u + t v, s and t in [0, 1]; the normal is u x v
};
struct Sphere {
  Vec3d centre;
  double radius = 1;
};

struct AnalyticScene {
  std::vector<Rectangle> rectangles;
  std::vector<Sphere> spheres;
  std::function<Vec3f(const Vec3d& position)> albedo;
  double spacing = 0.01;   ///< of the points; the discs' radius in the G-buffer is 0.75 of it

  struct Hit {
    double distance = 0;
    Vec3d normal;
  };
  std::optional<Hit> cast(const Vec3d& origin, const Vec3d& direction) const;
  struct Point {
    Vec3d position;
    Vec3d normal;
  };
  /// About one point a square of the spacing, in an order that is not the order in space.
  std::vector<Point> points() const;
};

/// Binary PLY with float positions and normals and, for some tests, extras.
void write_scene_ply(const std::filesystem::path& path, const std::vector<AnalyticScene::Point>& points);

stream::Camera look_at(const std::string& name, const Vec3d& eye, const Vec3d& target, int width_px, int height_px, double focal_px);

struct ShotOptions {
  float gain = 1;                                                ///< the photograph's albedo is this times the truth
  float sigma = 0.02f;
  std::function<std::uint8_t(int x, int y)> mask;                ///< bits as in the contract; default 1
  std::function<Vec3f(int x, int y, const Vec3f& albedo)> paint; ///< disturbs the picture
};

/// Writes the three rasters of a photograph into `folder`: pixel values are means over 4 x 4 rays.
BlendPhotograph shoot(const AnalyticScene& scene, const stream::Camera& camera, const std::filesystem::path& folder, const ShotOptions& options = {});

}  // namespace chiaro::blend::testing
