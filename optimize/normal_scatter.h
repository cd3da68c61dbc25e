/// How far the normals of a cloud scatter from point to point: an error of each by itself, which no surface has.
#pragma once
#include "optimize/proxy.h"

namespace chiaro::optimize {

/// Median over surfels of the angle between a normal and the mean of its neighbours' normals, as the rms angle of normal errors that would cause it, radians. Curvature cancels
/// in the mean of neighbours all around; edges are few and do not move a median.
///
/// threads  one; looks at 20 000 surfels at most.
double normal_scatter_rad(const Proxy& proxy, const NearestPoints& nearest);

}  // namespace chiaro::optimize
