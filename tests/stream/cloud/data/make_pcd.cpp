// Writes compressed.pcd with PCL itself; pcd_test.cpp has the same formulas.
// g++ make_pcd.cpp $(pkg-config --cflags --libs pcl_io pcl_common eigen3) && ./a.out
#include <pcl/io/pcd_io.h>
#include <pcl/point_types.h>

#include <limits>

int main() {
  pcl::PointCloud<pcl::PointXYZRGBNormal> cloud;
  for (int i = 0; i < 500; ++i) {
    pcl::PointXYZRGBNormal p;
    p.x = 0.25f * i;
    p.y = i == 7 ? std::numeric_limits<float>::quiet_NaN() : -1.5f * i;
    p.z = 3.0f;
    p.r = static_cast<std::uint8_t>(i % 256);
    p.g = 17;
    p.b = static_cast<std::uint8_t>(255 - i % 256);
    p.normal_x = 0.6f, p.normal_y = 0.0f, p.normal_z = 0.8f;
    p.curvature = 0.001f * i;
    cloud.push_back(p);
  }
  return pcl::PCDWriter().writeBinaryCompressed("compressed.pcd", cloud);
}
