/// What the tests of light transport share: a sampled surface as a proxy, with everything gathered.
#pragma once
#include <algorithm>
#include <memory>
#include <vector>

#include "optimize/gather.h"
#include "stream/base/file.h"
#include "tests/support/sampled_surface.h"

namespace chiaro::optimize::tests {

using namespace chiaro::tests;

/// A proxy of all leaves of a test store, with its transport.
struct Lit {
  Lit(const std::vector<SampledPoint>& points, int rays, int smooth_passes = 0) : store(build_test_store(points, folder.path())) {
    surfels::WorkingSet cut;
    cut.chunks = store.leaves();
    std::sort(cut.chunks.begin(), cut.chunks.end());
    proxy = load_proxy(store, cut);
    nearest = std::make_unique<NearestPoints>(proxy.position);
    smoother = make_smoother(proxy, *nearest);
    tracer = std::make_unique<surfels::Tracer>(proxy.origin_in_world, budget);
    for (const std::uint32_t c : proxy.chunks) tracer->add(store.read_chunk(c));
    tracer->commit();
    transport = gather(proxy, *tracer, smoother, {rays, 1, smooth_passes}, silent_reporter());
  }
  ScratchFolder folder;
  MemoryBudget budget{512u << 20};
  stream::Store store;
  Proxy proxy;
  std::unique_ptr<NearestPoints> nearest;
  Smoother smoother;
  std::unique_ptr<surfels::Tracer> tracer;
  Transport transport;
};

}  // namespace chiaro::optimize::tests
