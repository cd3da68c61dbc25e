#include "surfels/frustum.h"

#include <algorithm>

namespace chiaro::surfels {

namespace {

Vec3d corner_of(const Box3d& box, int corner) { return {corner & 1 ? box.max.x() : box.min.x(), corner & 2 ? box.max.y() : box.min.y(), corner & 4 ? box.max.z() : box.min.z()}; }

/// A range of slopes x/z and y/z.
struct Slopes {
  double x0 = 1e9, x1 = -1e9, y0 = 1e9, y1 = -1e9;
  void extend(double x, double y) {
    x0 = std::min(x0, x);
    x1 = std::max(x1, x);
    y0 = std::min(y0, y);
    y1 = std::max(y1, y);
  }
};

void bound(Frustum& f, const Slopes& s) {
  const Vec3d planes[] = {{1, 0, -s.x0}, {-1, 0, s.x1}, {0, 1, -s.y0}, {0, -1, s.y1}, {0, 0, 1}};
  f.inward.clear();
  for (const Vec3d& p : planes) f.inward.push_back((f.camera_from_world.transpose() * p).normalized());
  f.x0 = s.x0;
  f.x1 = s.x1;
  f.y0 = s.y0;
  f.y1 = s.y1;
}

/// Slopes of what a box shows within the pyramid of a cube's face. It meets the pyramid.
void extend_within_face(Slopes& slopes, const Frustum& face, const Box3d& box) {
  for (int corner = 0; corner < 8; ++corner) {
    const Vec3d c = face.camera_from_world * (corner_of(box, corner) - face.centre);
    if (!(c.z() > 0)) {   // beside the light and behind it: in any direction
      slopes.extend(-1, -1);
      slopes.extend(1, 1);
      return;
    }
    slopes.extend(std::clamp(c.x() / c.z(), -1.0, 1.0), std::clamp(c.y() / c.z(), -1.0, 1.0));
  }
}

}  // namespace

double distance_to_box(const Vec3d& p, const Box3d& box) { return (box.min - p).cwiseMax(p - box.max).cwiseMax(0.0).norm(); }

bool Frustum::misses(const Box3d& box) const {
  if ((box.min.array() > within.max.array()).any() || (box.max.array() < within.min.array()).any()) return true;
  for (const Vec3d& n : inward) {
    const Vec3d corner(n.x() > 0 ? box.max.x() : box.min.x(), n.y() > 0 ? box.max.y() : box.min.y(), n.z() > 0 ? box.max.z() : box.min.z());
    if (n.dot(corner - centre) < 0) return true;
  }
  return false;
}

Frustum make_frustum(const View& view, double margin_px, const Vec3d& centre) {
  Frustum f;
  f.centre = centre;
  f.camera_from_world = view.pose.rotation_camera_from_world;
  Slopes slopes;
  const PixelRect r = view.rect;
  constexpr int kSteps = 16;
  bool wide = false;
  const auto visit = [&](double u, double v) {
    const auto d = stream::unproject(view.lens, {u, v});
    if (!d || d->z() < 0.05) {
      wide = true;
      return;
    }
    slopes.extend(d->x() / d->z(), d->y() / d->z());
  };
  for (int i = 0; i <= kSteps; ++i) {
    const double u = r.x0 - margin_px + (r.width() + 2 * margin_px) * i / kSteps, v = r.y0 - margin_px + (r.height() + 2 * margin_px) * i / kSteps;
    visit(u, r.y0 - margin_px);
    visit(u, r.y1 + margin_px);
    visit(r.x0 - margin_px, v);
    visit(r.x1 + margin_px, v);
  }
  if (!wide) bound(f, slopes);
  return f;
}

std::vector<Frustum> frusta_of_light(const Vec3d& light, std::span<const Box3d> boxes) {
  constexpr double kMargin = 0.01;   // rays start a little above their surface
  Box3d within;
  within.extend(light);
  Vec3d sum = Vec3d::Zero();
  for (const Box3d& box : boxes) {
    within.extend(box.min);
    within.extend(box.max);
    sum += 0.5 * (box.min + box.max) - light;
  }
  const Vec3d forward = sum.norm() > 0 ? sum.normalized() : Vec3d::UnitZ(), right = forward.unitOrthogonal();
  const Vec3d axes[] = {forward, right, forward.cross(right)};
  std::vector<Frustum> frusta;
  for (int face = 0; face < 6; ++face) {
    const Vec3d z = axes[face % 3] * (face < 3 ? 1 : -1), x = axes[(face + 1) % 3];
    Frustum f;
    f.centre = light;
    f.camera_from_world << x.transpose(), z.cross(x).transpose(), z.transpose();
    f.within = within;
    bound(f, {-1, 1, -1, 1});
    Slopes seen;
    for (const Box3d& box : boxes)
      if (!f.misses(box)) extend_within_face(seen, f, box);
    if (!(seen.x0 <= seen.x1)) continue;
    bound(f, {seen.x0 - kMargin, seen.x1 + kMargin, seen.y0 - kMargin, seen.y1 + kMargin});
    frusta.push_back(std::move(f));
  }
  return frusta;
}

}  // namespace chiaro::surfels
