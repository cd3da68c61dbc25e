/// What the tests of light transport share: a sampled surface as a proxy, with everything gathered.
#pragma once
#include <algorithm>
#include <memory>
#include <span>
#include <vector>

#include "optimize/gather.h"
#include "optimize/radiosity.h"
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

/// The radiosity of one photograph, completed by itself; returns what is gathered.
inline std::vector<float> complete_alone(const Transport& transport, const Smoother& smoother, int smooth_passes, const Lights& lights, std::span<const float> albedo, Observation& o, int max_sweeps,
                                         double tolerance, int* sweeps = nullptr) {
  Completion completion(transport, smoother, smooth_passes, 1);
  completion.add(lights, albedo, o);
  completion.solve(max_sweeps, tolerance);
  completion.take_unseen(0, o);
  if (sweeps) *sweeps = completion.sweeps(0);
  return completion.gathered(0);
}

}  // namespace chiaro::optimize::tests
