/// Cameras: lens models, poses, and projection both ways. All importers convert to this one convention.
///
/// Camera frame: x right, y down, z forward, metres (project units). Pixels: origin at the image's upper left corner, so the centre of
/// pixel (column i, row j) is (i + 0.5, j + 0.5). Distortion maps undistorted to distorted, in focal-normalised coordinates.
#pragma once
#include <array>
#include <optional>
#include <string>

#include "stream/base/types.h"

namespace chiaro::stream {

enum class LensKind {
  kPerspective,  ///< rational radial + tangential: covers COLMAP SIMPLE_PINHOLE .. FULL_OPENCV, Metashape frame, Bundler
  kFisheye,      ///< equidistant, k1..k4 polynomial in theta, then p1..p4 as below: COLMAP OPENCV_FISHEYE, (SIMPLE_)RADIAL_FISHEYE, Metashape fisheye
};

/// x = X/Z, y = Y/Z, r2 = x^2 + y^2,  rho = (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k7 r2^4) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
/// x_d = x rho + (2 p1 x y + p2 (r2 + 2 x^2)) t,  y_d = y rho + (p1 (r2 + 2 y^2) + 2 p2 x y) t,  t = 1 + p3 r2 + p4 r2^2
/// u = cx + fx x_d + skew y_d,  v = cy + fy y_d
/// source: OpenCV / COLMAP FULL_OPENCV (k1..k6, p1, p2); Metashape's K4 is k7, its P1, P2 are p2, p1, its P3, P4 are p3, p4; B1, B2: fx = f + B1, skew = B2.
struct Lens {
  LensKind kind = LensKind::kPerspective;
  int width_px = 0, height_px = 0;
  double fx = 0, fy = 0, cx = 0, cy = 0, skew = 0;
  std::array<double, 7> k{};  ///< k1 .. k7 (fisheye: k1..k4 on theta)
  std::array<double, 4> p{};  ///< p1 .. p4
};

/// World to camera, as COLMAP: p_in_camera = rotation_camera_from_world * p_in_world + translation_camera_from_world.
struct Pose {
  Mat3d rotation_camera_from_world = Mat3d::Identity();
  Vec3d translation_camera_from_world = Vec3d::Zero();
  Vec3d centre_in_world() const { return -rotation_camera_from_world.transpose() * translation_camera_from_world; }
  Vec3d camera_from_world(const Vec3d& p_in_world) const { return rotation_camera_from_world * p_in_world + translation_camera_from_world; }
  Vec3d world_from_camera(const Vec3d& p_in_camera) const { return rotation_camera_from_world.transpose() * (p_in_camera - translation_camera_from_world); }
};

/// What the lens was set to. aperture 0: not known, or sharp everywhere.
struct Focus {
  double aperture = 0;   ///< diameter of the entrance pupil (focal length / f-number), project units
  double distance = 0;   ///< of the plane in focus from the camera's centre, along its axis, project units
};

struct Camera {
  std::string photograph;  ///< name as the camera file gives it, e.g. "photo_00.exr" or "IMG_1234" (Metashape labels may lack the extension)
  Lens lens;
  Pose pose;
  Focus focus{};
};

/// Pixel coordinates of a point in the camera frame; nullopt behind the camera (a fisheye also sees beyond 90 degrees) or where the lens model folds back (beyond its monotonic range).
/// The result may lie outside the image.
std::optional<Vec2d> project(const Lens& lens, const Vec3d& p_in_camera);

/// Whether the lens is without distortion; then project() and project_pinhole() have the same bits wherever both have a pixel of a picture.
bool is_pinhole(const Lens& lens);
inline std::optional<Vec2d> project_pinhole(const Lens& lens, const Vec3d& p_in_camera) {
  if (!(p_in_camera.z() > 0)) return std::nullopt;
  const double x = p_in_camera.x() / p_in_camera.z(), y = p_in_camera.y() / p_in_camera.z();
  return Vec2d(lens.cx + lens.fx * x + lens.skew * y, lens.cy + lens.fy * y);
}

/// Unit direction in the camera frame of a pixel coordinate: the inverse of project(), by Newton iteration to 1e-10; nullopt where it does not converge.
std::optional<Vec3d> unproject(const Lens& lens, const Vec2d& pixel);

/// Diameter, in pixels, of the disc into which the lens spreads a point at that depth (along the axis): aperture f |1 / distance - 1 / depth|, f the calibrated
/// focal length in pixels, which is the image's distance. source: thin lens. 0 where the focus is not known.
double blur_px(const Camera& camera, double depth_along_axis);

/// How many times smaller the spot of a pixel in focus is, as an area: variances of pixel (1/12) and disc (diameter^2 / 16) add up.
inline float focus_share(float blur_px) { return 1 / (1 + 0.75f * blur_px * blur_px); }

/// throws Error naming the camera if a value is not finite, a focal length or size not positive, or the rotation not orthonormal to 1e-4 (then re-orthonormalised).
void check_camera(Camera& camera, const std::string& where);

/// The same lens for a copy of the picture in another size (e.g. 25 %): fx, fy, cx, cy, skew scale. throws Error where it can be no such copy: sides that are
/// not in one proportion, but for rounding to pixels, or that differ by less than 2 %, as borders and crops do (nobody makes such copies).
Lens scaled_to(const Lens& lens, int width_px, int height_px, const std::string& where);

/// The same lens for whole cells of cell_px x cell_px pixels that become one each, from the upper left corner on.
Lens lens_of_cells(const Lens& lens, int cell_px);

}  // namespace chiaro::stream
