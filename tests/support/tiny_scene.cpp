#include "tests/support/tiny_scene.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <fstream>
#include <iomanip>
#include <numbers>
#include <optional>
#include <sstream>

#include "stream/photo/image_io.h"

namespace chiaro::test {
namespace {

namespace fs = std::filesystem;
constexpr double kPi = std::numbers::pi;
constexpr int kSub = 4;   // rays per pixel and side: pixel means like a sensor's
const Vec3d kNovelFlashInCamera(-0.4, -0.1, 0.1);

struct View {
  std::string name;
  Mat3d rotation;      // camera from world
  Vec3d eye;
  double ambient = 1;  // factor
};

View look_from(const std::string& name, const Vec3d& eye) {
  View v{name, Mat3d::Identity(), eye, 1};
  const Vec3d z = (-eye).normalized();
  const Vec3d x = z.cross(Vec3d(0, 0, 1)).normalized();
  v.rotation.row(0) = x;
  v.rotation.row(1) = z.cross(x);   // y points down
  v.rotation.row(2) = z;
  return v;
}

std::vector<View> make_views(const TinySceneOptions& o) {
  std::vector<View> views;
  for (int i = 0; i < o.photographs; ++i) {
    const double azimuth = -1.2 + o.azimuth_step * i, distance = i % 2 == 0 ? 3.6 : 4.6, up = o.from_level ? 0 : 0.5 + 0.35 * (i % 3);
    std::ostringstream name;
    name << "photo_" << std::setw(2) << std::setfill('0') << i;
    views.push_back(look_from(name.str(), distance * Vec3d(std::cos(azimuth), std::sin(azimuth), up).normalized()));
    if (static_cast<std::size_t>(i) < o.ambient_factors.size()) views.back().ambient = o.ambient_factors[static_cast<std::size_t>(i)];
  }
  return views;
}

/// Distance along the unit direction to the unit sphere, if it is hit.
std::optional<double> cast(const Vec3d& origin, const Vec3d& direction) {
  const double b = origin.dot(direction), c = origin.squaredNorm() - 1, d = b * b - c;
  if (d < 0) return std::nullopt;
  return -b - std::sqrt(d);
}

/// Direction in camera axes through a position of the image; Newton on r (1 + k r^2) = r_distorted.
Vec3d ray_through(const TinySceneOptions& o, double u, double v) {
  Vec2d q((u - o.width_px / 2.0) / o.focal_px, (v - o.height_px / 2.0) / o.focal_px);
  const double distorted = q.norm();
  if (o.radial_k1 != 0 && distorted > 0) {
    double r = distorted;
    for (int i = 0; i < 30; ++i) r -= (r * (1 + o.radial_k1 * r * r) - distorted) / (1 + 3 * o.radial_k1 * r * r);
    q *= r / distorted;
  }
  return Vec3d(q.x(), q.y(), 1).normalized();
}

/// What a lens keeps of the light at a position of the image.
double lens_keeps(const TinySceneOptions& o, double u, double v) {
  const double corner = std::hypot(o.width_px, o.height_px) / 2, r = std::hypot(u - o.width_px / 2.0, v - o.height_px / 2.0) / corner;
  const double a = 1 / std::sqrt(1 - o.lens_loss) - 1;
  return 1 / ((1 + a * r * r) * (1 + a * r * r));
}

/// What the flash sends into a direction of the camera's axes, of what it sends forward.
double flash_sends(const TinySceneOptions& o, const Vec3d& direction) {
  const double corner = std::atan(std::hypot(o.width_px, o.height_px) / 2 / o.focal_px), angle = std::acos(std::min(1.0, direction.z() / direction.norm()));
  return std::exp(std::log(1 - o.flash_loss) * angle * angle / (corner * corner));
}

struct Rendered {
  std::vector<float> rgb;
  std::vector<std::uint8_t> mask;
};

Rendered render(const TinySceneOptions& o, const View& view, const Vec3d& flash_in_camera) {
  const auto pixels = static_cast<std::size_t>(o.width_px) * static_cast<std::size_t>(o.height_px);
  Rendered out{std::vector<float>(3 * pixels, 0.f), std::vector<std::uint8_t>(pixels, 0)};
  const Vec3d flash = view.eye + view.rotation.transpose() * flash_in_camera;
  for (std::size_t i = 0; i < pixels; ++i) {
    const double x = static_cast<double>(i % static_cast<std::size_t>(o.width_px)), y = static_cast<double>(i / static_cast<std::size_t>(o.width_px));
    int hits = 0;
    std::array<double, 3> sum{};
    for (int s = 0; s < kSub * kSub; ++s) {
      const double u = x + (s % kSub + 0.5) / kSub, v = y + (s / kSub + 0.5) / kSub;
      const Vec3d direction = view.rotation.transpose() * ray_through(o, u, v);
      const auto distance = cast(view.eye, direction);
      if (!distance) continue;
      ++hits;
      const Vec3d p = view.eye + *distance * direction, to_flash = flash - p;
      const double r2 = to_flash.squaredNorm(), cosine = std::max(0.0, p.dot(to_flash) / std::sqrt(r2));   // the unit sphere's normal is its position
      const double irradiance = (o.flash ? o.flash_intensity : 0) * flash_sends(o, view.rotation * (p - flash)) * cosine / r2 + kPi * o.ambient_radiance * view.ambient;
      const std::array<double, 3> albedo = tiny_albedo(o, p);
      for (std::size_t c = 0; c < 3; ++c) sum[c] += albedo[c] / kPi * irradiance * lens_keeps(o, u, v);
    }
    for (std::size_t c = 0; c < 3; ++c) out.rgb[3 * i + c] = static_cast<float>(sum[c] / (kSub * kSub));
    out.mask[i] = hits == kSub * kSub ? 255 : 0;
  }
  return out;
}

/// The value as a float holds it. Volatile, as GCC 12 drops the rounding of two neighbours' double -> float -> double when it vectorises them.
double as_float(double value) {
  volatile float f = static_cast<float>(value);
  return static_cast<double>(f);
}

double units_per_metre(const TinySceneOptions& o) { return o.unit == "mm" ? 1000 : o.unit == "cm" ? 100 : 1; }

/// A spiral of equal areas; taken in steps of a number without common factors, so that the file's order is not the order in space.
std::vector<Vec3d> sphere_points(std::size_t count) {
  std::vector<Vec3d> points(count);
  std::size_t step = 7919;
  while (count % step == 0) step += 2;
  for (std::size_t k = 0; k < count; ++k) {
    const double i = static_cast<double>((k * step) % count);
    const double z = 1 - 2 * (i + 0.5) / static_cast<double>(count), ring = std::sqrt(1 - z * z), angle = i * kPi * (3 - std::sqrt(5.0));
    points[k] = Vec3d(as_float(ring * std::cos(angle)), as_float(ring * std::sin(angle)), as_float(z));
  }
  return points;
}

void write_cloud(const fs::path& path, const TinySceneOptions& o, const std::vector<Vec3d>& points) {
  std::string text = "ply\nformat binary_little_endian 1.0\nelement vertex " + std::to_string(points.size()) + "\nproperty float x\nproperty float y\nproperty float z\n";
  if (o.with_normals) text += "property float nx\nproperty float ny\nproperty float nz\n";
  if (o.with_colours) text += "property uchar red\nproperty uchar green\nproperty uchar blue\n";
  text += "end_header\n";
  const auto put = [&](double v) {
    const float f = static_cast<float>(v);
    char bytes[4];
    std::memcpy(bytes, &f, 4);
    text.append(bytes, 4);
  };
  for (const Vec3d& p : points) {
    for (int c = 0; c < 3; ++c) put(p[c] * units_per_metre(o));
    for (int c = 0; c < 3 && o.with_normals; ++c) put(o.normals_inwards ? -p[c] : p[c]);
    if (o.with_colours) text.append(3, static_cast<char>(128));
  }
  std::ofstream(path, std::ios::binary) << text;
}

void write_cameras(const fs::path& folder, const TinySceneOptions& o, const std::vector<View>& views) {
  std::ofstream cameras(folder / "cameras.txt");
  cameras << "1 " << (o.radial_k1 != 0 ? "SIMPLE_RADIAL " : "PINHOLE ") << o.width_px << ' ' << o.height_px << ' ' << o.focal_px;
  if (o.radial_k1 == 0) cameras << ' ' << o.focal_px;
  cameras << ' ' << o.width_px / 2.0 << ' ' << o.height_px / 2.0;
  if (o.radial_k1 != 0) cameras << ' ' << o.radial_k1;
  cameras << '\n';
  std::ofstream images(folder / "images.txt");
  images << std::setprecision(15);
  for (std::size_t i = 0; i < views.size(); ++i) {
    const Eigen::Quaterniond q(views[i].rotation);
    const Vec3d t = -(views[i].rotation * views[i].eye) * units_per_metre(o);
    images << i + 1 << ' ' << q.w() << ' ' << q.x() << ' ' << q.y() << ' ' << q.z() << ' ' << t.x() << ' ' << t.y() << ' ' << t.z() << " 1 " << views[i].name << ".exr\n\n";
  }
  std::ofstream(folder / "points3D.txt") << "# none\n";
}

/// A few pixels in the middle of photo_00, and the mean albedo they show.
std::string reference_text(const TinySceneOptions& o, const View& view) {
  const int x0 = o.width_px / 2 - 2, y0 = o.height_px / 2 - 2, size = 4;
  std::array<double, 3> sum{};
  const int n = size * kSub;
  for (int s = 0; s < n * n; ++s) {
    const Vec3d direction = view.rotation.transpose() * ray_through(o, x0 + (s % n + 0.5) / kSub, y0 + (s / n + 0.5) / kSub);
    const std::array<double, 3> albedo = tiny_albedo(o, view.eye + *cast(view.eye, direction) * direction);
    for (std::size_t c = 0; c < 3; ++c) sum[c] += albedo[c] / (n * n);
  }
  std::ostringstream text;
  text << "\n[[acquisition.reference]]\nphotograph = \"" << view.name << "\"\npolygon = [[" << x0 << ", " << y0 << "], [" << x0 + size << ", " << y0 << "], [" << x0 + size << ", "
       << y0 + size << "], [" << x0 << ", " << y0 + size << "]]\nalbedo = [" << sum[0] << ", " << sum[1] << ", " << sum[2] << "]\nsigma = 0.01\n";
  return text.str();
}

std::string project_text(const TinySceneOptions& o, const std::vector<View>& views) {
  std::ostringstream text;
  text << "[project]\nname = \"tiny\"\nunit = \"" << o.unit << "\"\n\n[cloud]\nfiles = [\"cloud.ply\"]\nnormals = \"auto\"\n\n[[acquisition]]\nname = \"day1\"\nphotographs = [\"photos/photo_*.exr\"]\n"
       << "encoding = \"linear\"\n" << (o.masks ? "masks = \"masks/{stem}.png\"\n" : "") << "cameras = \"sparse\"\nnoise = { gain = " << o.noise_gain << ", read_sigma = " << o.read_sigma << " }\n";
  if (o.flash) {
    text << "\n[acquisition.flash]\noffset_in_camera = [" << o.flash_in_camera[0] * units_per_metre(o) << ", " << o.flash_in_camera[1] * units_per_metre(o) << ", " << o.flash_in_camera[2] * units_per_metre(o) << "]\n";
    if (o.write_range) text << "intensity_range = [" << o.intensity_range[0] << ", " << o.intensity_range[1] << "]\n";
  }
  if (o.reference && !views.empty()) text << reference_text(o, views.front());
  text << "\n[acquisition.ambient]\nmodel = \"auto\"\n\n[[export]]\nfile = \"albedo.ply\"\n";
  return text.str();
}

void write_novel_view(const fs::path& folder, const TinySceneOptions& o) {
  const View view = look_from("novel_00", Vec3d(2.6, -2.3, 1.5));
  TinySceneOptions even = o;   // as it is, not as the lens shows it
  even.lens_loss = 0;
  stream::write_exr(folder / (view.name + ".exr"), o.width_px, o.height_px, {"R", "G", "B"}, render(even, view, kNovelFlashInCamera).rgb, false);
  std::ofstream text(folder / "views.toml");
  text << std::setprecision(15) << "[[view]]\nname = \"" << view.name << "\"\nsize = [" << o.width_px << ", " << o.height_px << "]\ncamera = { model = \""
       << (o.radial_k1 != 0 ? "SIMPLE_RADIAL" : "PINHOLE") << "\", params = [" << std::showpoint << o.focal_px << ", ";
  if (o.radial_k1 == 0) text << o.focal_px << ", ";
  text << o.width_px / 2.0 << ", " << o.height_px / 2.0;
  if (o.radial_k1 != 0) text << ", " << o.radial_k1;
  text << "] }\nrotation_camera_from_world = [";
  for (int r = 0; r < 3; ++r) text << (r > 0 ? ", " : "") << "[" << view.rotation(r, 0) << ", " << view.rotation(r, 1) << ", " << view.rotation(r, 2) << "]";
  const Vec3d t = -(view.rotation * view.eye) * units_per_metre(o), f = kNovelFlashInCamera * units_per_metre(o);
  text << "]\ntranslation_camera_from_world = [" << t.x() << ", " << t.y() << ", " << t.z() << "]\nflash_offset_in_camera = [" << f.x() << ", " << f.y() << ", " << f.z() << "]\n";
}

}  // namespace

std::array<double, 3> tiny_albedo(const TinySceneOptions& options, const Vec3d& p) {
  if (options.uniform_paint) return {0.55, 0.5, 0.4};
  // Two chromas that pass into each other around the equator, and a lightness that changes slowly.
  const double lightness = 0.5 + 0.18 * std::sin(2.5 * p.x() + 0.7) * std::cos(2 * p.y());
  const double second = 1 / (1 + std::exp(-8 * p.z()));
  return {lightness * (1.2 - 0.4 * second), lightness, lightness * (0.8 + 0.5 * second)};
}

TinyScene write_tiny_scene(const fs::path& folder, const TinySceneOptions& options) {
  TinyScene scene{folder, folder / "project.toml", options, sphere_points(options.points), {}};
  for (const Vec3d& p : scene.positions) scene.albedo.push_back(tiny_albedo(options, p));
  for (const char* sub : {"photos", "masks", "sparse", "novel"}) fs::create_directories(folder / sub);
  const std::vector<View> views = make_views(options);
  write_cloud(folder / "cloud.ply", options, scene.positions);
  write_cameras(folder / "sparse", options, views);
  for (const View& view : views) {
    const Rendered picture = render(options, view, Vec3d(options.flash_in_camera[0], options.flash_in_camera[1], options.flash_in_camera[2]));
    stream::write_exr(folder / "photos" / (view.name + ".exr"), options.width_px, options.height_px, {"R", "G", "B"}, picture.rgb, false);
    if (options.masks) stream::write_png_srgb8(folder / "masks" / (view.name + ".png"), options.width_px, options.height_px, picture.mask, 1);
  }
  write_novel_view(folder / "novel", options);
  std::ofstream(scene.project) << project_text(options, views);
  return scene;
}

}  // namespace chiaro::test
