#include "surfels/gbuffer_edges.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "stream/base/parallel.h"

namespace chiaro::surfels {
namespace {

constexpr int kRowsAtOnce = 256;
constexpr int kEdgeReach = 64;  ///< pixels beyond which the distance to an edge does not matter

/// One band of geometry with its neighbouring rows, for finding depth edges.
struct DepthBand {
  int y0, rows, width;
  std::vector<float> depth, nx, ny, nz, footprint, coverage, radius;

  DepthBand(const stream::RasterWriter& in, int first, int count) : y0(first), rows(count), width(in.width()) {
    depth = in.read_back<float>("depth", y0, rows);
    nx = in.read_back<float>("nx", y0, rows);
    ny = in.read_back<float>("ny", y0, rows);
    nz = in.read_back<float>("nz", y0, rows);
    footprint = in.read_back<float>("footprint", y0, rows);
    coverage = in.read_back<float>("coverage", y0, rows);
    radius = in.read_back<float>("radius", y0, rows);
  }
  std::size_t at(int x, int row) const { return static_cast<std::size_t>(row) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x); }
  Vec3f normal(std::size_t i) const { return {nx[i], ny[i], nz[i]}; }
};

/// Two neighbouring pixels lie on different surfaces when each point is off the other's tangent plane by more than their footprints and the
/// sampling of the cloud explain. A crease is no depth edge.
bool breaks(const DepthBand& band, const std::vector<Vec3f>& points, std::size_t a, std::size_t b) {
  const Vec3f delta = points[b] - points[a];
  const float off = std::min(std::fabs(band.normal(a).dot(delta)), std::fabs(band.normal(b).dot(delta)));
  return off > 2.0f * std::max(band.footprint[a], band.footprint[b]) + 0.5f * std::max(band.radius[a], band.radius[b]);
}

/// A pixel whose neighbours to both sides, and above and below, lie on one surface while it does not: a ray that slipped between two discs of a
/// surface seen at a grazing angle. It is no edge, since nothing begins or ends there.
std::vector<std::uint8_t> slipped_pixels(const DepthBand& band, const std::vector<Vec3f>& points) {
  std::vector<std::uint8_t> slipped(band.depth.size(), 0);
  const auto whole = [&](std::size_t i) { return band.coverage[i] >= 0.999f; };
  parallel_blocks(static_cast<std::size_t>(std::max(0, band.rows - 2)), 8, [&](std::size_t b, std::size_t e) {
    for (std::size_t r = b + 1; r < e + 1; ++r)
      for (int x = 1; x + 1 < band.width; ++x) {
        const std::size_t i = band.at(x, static_cast<int>(r)), w = static_cast<std::size_t>(band.width);
        if (!whole(i - 1) || !whole(i + 1) || !whole(i - w) || !whole(i + w)) continue;
        if (whole(i) && !breaks(band, points, i, i - 1) && !breaks(band, points, i, i + 1) && !breaks(band, points, i, i - w) && !breaks(band, points, i, i + w)) continue;
        slipped[i] = !breaks(band, points, i - 1, i + 1) && !breaks(band, points, i - w, i + w);
      }
  });
  return slipped;
}

/// 1 where the pixel is at a depth edge, a hole, or partly covered.
std::vector<std::uint8_t> edge_pixels(const DepthBand& band, const stream::Lens& lens, const Mat3d& world_from_camera) {
  std::vector<Vec3f> points(band.depth.size(), Vec3f::Zero());
  parallel_blocks(static_cast<std::size_t>(band.rows), 8, [&](std::size_t r0, std::size_t r1) {
    for (std::size_t r = r0; r < r1; ++r)
      for (int x = 0; x < band.width; ++x)
        if (const auto d = stream::unproject(lens, {x + 0.5, band.y0 + static_cast<int>(r) + 0.5}))
          points[band.at(x, static_cast<int>(r))] = (world_from_camera * *d).cast<float>() * band.depth[band.at(x, static_cast<int>(r))];
  });
  const std::vector<std::uint8_t> slipped = slipped_pixels(band, points);
  std::vector<std::uint8_t> edge(band.depth.size(), 0);
  for (int r = 0; r < band.rows; ++r)
    for (int x = 0; x < band.width; ++x) {
      const std::size_t a = band.at(x, r);
      if (slipped[a]) continue;
      if (band.coverage[a] < 0.999f) edge[a] = 1;
      for (const auto& [dx, dy] : {std::pair{1, 0}, std::pair{0, 1}}) {
        if (x + dx >= band.width || r + dy >= band.rows) continue;
        const std::size_t b = band.at(x + dx, r + dy);
        if (slipped[b]) continue;
        if (band.depth[a] > 0 && band.depth[b] > 0 && breaks(band, points, a, b)) edge[a] = edge[b] = 1;
      }
    }
  return edge;
}

/// Exact Euclidean distance to the nearest edge pixel or the image border, capped, from a band with kEdgeReach rows of halo.
std::vector<float> edge_distance(const std::vector<std::uint8_t>& edge, int width, int band_y0, int band_rows, int y0, int rows, int height) {
  // Distance along the column first, then the lower envelope along the row.
  std::vector<float> result(static_cast<std::size_t>(rows) * static_cast<std::size_t>(width));
  std::vector<int> column(static_cast<std::size_t>(rows) * static_cast<std::size_t>(width), kEdgeReach);
  parallel_blocks(static_cast<std::size_t>(width), 64, [&](std::size_t x0, std::size_t x1) {
    for (std::size_t x = x0; x < x1; ++x) {
      const auto is_edge = [&](int y) { return edge[static_cast<std::size_t>(y - band_y0) * static_cast<std::size_t>(width) + x] != 0; };
      int since = kEdgeReach;
      for (int y = band_y0; y < y0 + rows; ++y) {
        since = is_edge(y) ? 0 : std::min(since + 1, kEdgeReach);
        if (y >= y0) column[static_cast<std::size_t>(y - y0) * static_cast<std::size_t>(width) + x] = since;
      }
      since = kEdgeReach;
      for (int y = band_y0 + band_rows - 1; y >= y0; --y) {
        since = is_edge(y) ? 0 : std::min(since + 1, kEdgeReach);
        if (y < y0 + rows) {
          int& c = column[static_cast<std::size_t>(y - y0) * static_cast<std::size_t>(width) + x];
          c = std::min(c, since);
        }
      }
    }
  });
  parallel_blocks(static_cast<std::size_t>(rows), 4, [&](std::size_t r0, std::size_t r1) {
    for (std::size_t r = r0; r < r1; ++r) {
      const int* c = column.data() + r * static_cast<std::size_t>(width);
      const int y = y0 + static_cast<int>(r), border_y = std::min(y, height - 1 - y);
      for (int x = 0; x < width; ++x) {
        int best = kEdgeReach * kEdgeReach;
        for (int dx = 0; dx < kEdgeReach && dx * dx < best; ++dx) {
          if (x >= dx) best = std::min(best, dx * dx + c[x - dx] * c[x - dx]);
          if (x + dx < width) best = std::min(best, dx * dx + c[x + dx] * c[x + dx]);
        }
        const float border = static_cast<float>(std::min({x, width - 1 - x, border_y}));
        result[r * static_cast<std::size_t>(width) + static_cast<std::size_t>(x)] = std::min(std::sqrt(static_cast<float>(best)), border);
      }
    }
  });
  return result;
}

/// Around each pixel that a shadow's edge crosses, as far as the edge is uncertain: 1 on the edge, falling to 0.
std::vector<float> shadow_doubt(const std::vector<float>& penumbra, int width, int first, int y0, int rows) {
  struct EdgePixel {
    int x, y;
    float reach;
  };
  std::vector<EdgePixel> edges;
  for (std::size_t i = 0; i < penumbra.size(); ++i)
    if (penumbra[i] > 0) edges.push_back({static_cast<int>(i) % width, first + static_cast<int>(i) / width, penumbra[i] + 1});
  std::vector<float> doubt(static_cast<std::size_t>(rows) * static_cast<std::size_t>(width), 0.0f);
  parallel_blocks(static_cast<std::size_t>(rows), 8, [&](std::size_t b, std::size_t e) {
    for (std::size_t r = b; r < e; ++r) {
      float* row = doubt.data() + r * static_cast<std::size_t>(width);
      const int y = y0 + static_cast<int>(r), most = static_cast<int>(kPenumbraReach) + 1;
      const auto from = std::lower_bound(edges.begin(), edges.end(), y - most, [](const EdgePixel& p, int v) { return p.y < v; });
      for (auto p = from; p != edges.end() && p->y <= y + most; ++p) {
        const auto dy = static_cast<float>(y - p->y);
        const float half2 = p->reach * p->reach - dy * dy;
        if (half2 <= 0) continue;
        const int half = static_cast<int>(std::sqrt(half2));
        for (int x = std::max(0, p->x - half); x <= std::min(width - 1, p->x + half); ++x) {
          const auto dx = static_cast<float>(x - p->x);
          row[x] = std::max(row[x], 1 - std::sqrt(dx * dx + dy * dy) / p->reach);
        }
      }
    }
  });
  return doubt;
}

}  // namespace

void write_shadow_doubt(stream::RasterWriter& out) {
  const int height = out.height(), halo = static_cast<int>(kPenumbraReach) + 1;
  for (int y0 = 0; y0 < height; y0 += kRowsAtOnce) {
    const int rows = std::min(kRowsAtOnce, height - y0), first = std::max(0, y0 - halo), last = std::min(height, y0 + rows + halo);
    out.write_rows<float>("shadow", y0, shadow_doubt(out.read_back<float>("penumbra", first, last - first), out.width(), first, y0, rows));
  }
}

void write_edge_distance(stream::RasterWriter& out, const stream::Camera& camera) {
  const int height = out.height();
  const Mat3d world_from_camera = camera.pose.rotation_camera_from_world.transpose();
  for (int y0 = 0; y0 < height; y0 += kRowsAtOnce) {
    const int rows = std::min(kRowsAtOnce, height - y0);
    const int first = std::max(0, y0 - kEdgeReach), last = std::min(height, y0 + rows + kEdgeReach);
    const DepthBand band(out, first, last - first);
    const auto edge = edge_pixels(band, camera.lens, world_from_camera);
    const auto distance = edge_distance(edge, out.width(), first, last - first, y0, rows, height);
    out.write_rows<float>("edge", y0, distance);
  }
}

}  // namespace chiaro::surfels
