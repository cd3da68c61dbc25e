#include "surfels/frustum.h"

#include <algorithm>

namespace chiaro::surfels {

double distance_to_box(const Vec3d& p, const Box3d& box) { return (box.min - p).cwiseMax(p - box.max).cwiseMax(0.0).norm(); }

bool Frustum::misses(const Box3d& box) const {
  for (const Vec3d& n : inward) {
    const Vec3d corner(n.x() > 0 ? box.max.x() : box.min.x(), n.y() > 0 ? box.max.y() : box.min.y(), n.z() > 0 ? box.max.z() : box.min.z());
    if (n.dot(corner - centre) < 0) return true;
  }
  return false;
}

Frustum make_frustum(const View& view, double margin_px, const Vec3d& centre) {
  Frustum f;
  f.centre = centre;
  const Mat3d world_from_camera = view.pose.rotation_camera_from_world.transpose();
  f.camera_from_world = view.pose.rotation_camera_from_world;
  double x0 = 1e9, x1 = -1e9, y0 = 1e9, y1 = -1e9;
  const PixelRect r = view.rect;
  constexpr int kSteps = 16;
  bool wide = false;
  const auto visit = [&](double u, double v) {
    const auto d = stream::unproject(view.lens, {u, v});
    if (!d || d->z() < 0.05) {
      wide = true;
      return;
    }
    x0 = std::min(x0, d->x() / d->z());
    x1 = std::max(x1, d->x() / d->z());
    y0 = std::min(y0, d->y() / d->z());
    y1 = std::max(y1, d->y() / d->z());
  };
  for (int i = 0; i <= kSteps; ++i) {
    const double u = r.x0 - margin_px + (r.width() + 2 * margin_px) * i / kSteps, v = r.y0 - margin_px + (r.height() + 2 * margin_px) * i / kSteps;
    visit(u, r.y0 - margin_px);
    visit(u, r.y1 + margin_px);
    visit(r.x0 - margin_px, v);
    visit(r.x1 + margin_px, v);
  }
  if (wide) return f;
  const Vec3d planes[] = {{1, 0, -x0}, {-1, 0, x1}, {0, 1, -y0}, {0, -1, y1}, {0, 0, 1}};
  for (const Vec3d& p : planes) f.inward.push_back((world_from_camera * p).normalized());
  f.x0 = x0;
  f.x1 = x1;
  f.y0 = y0;
  f.y1 = y1;
  return f;
}

}  // namespace chiaro::surfels
