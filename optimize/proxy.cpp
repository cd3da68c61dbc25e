#include "optimize/proxy.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "stream/base/parallel.h"

namespace chiaro::optimize {
namespace {

constexpr std::size_t kGrain = 2048;

}  // namespace

std::uint32_t Proxy::index_of(const SurfelId& id) const {
  const auto it = std::lower_bound(chunks.begin(), chunks.end(), id.chunk);
  if (it == chunks.end() || *it != id.chunk) throw std::out_of_range("Proxy::index_of: chunk is not part of the proxy");
  return first[static_cast<std::size_t>(it - chunks.begin())] + id.slot;
}

Proxy load_proxy(const stream::Store& store, const surfels::WorkingSet& cut) {
  Proxy proxy;
  proxy.origin_in_world = 0.5 * (store.manifest().bounds.min + store.manifest().bounds.max);
  proxy.metres_per_unit = stream::metres_per_unit(store.manifest().unit);
  proxy.chunks = cut.chunks;
  for (const std::uint32_t c : cut.chunks) {
    proxy.first.push_back(static_cast<std::uint32_t>(proxy.size()));
    const stream::Chunk chunk = store.read_chunk(c);
    for (std::uint32_t s = 0; s < chunk.count; ++s) {
      const stream::Surfel surfel = chunk.surfel(s);
      proxy.position.push_back((surfel.position_in_world - proxy.origin_in_world).cast<float>());
      proxy.normal.push_back(surfel.normal);
      proxy.radius.push_back(surfel.radius);
      proxy.oriented.push_back((surfel.flags & stream::SurfelBlock::kOriented) != 0);
    }
  }
  return proxy;
}

surfels::Tracer make_tracer(const stream::Store& store, const Proxy& proxy, MemoryBudget& budget) {
  surfels::Tracer tracer(proxy.origin_in_world, budget);
  for (const std::uint32_t c : proxy.chunks) tracer.add(store.read_chunk(c));
  tracer.commit();
  return tracer;
}

void orient(Proxy& proxy, std::span<const float> votes, const NearestPoints& nearest) {
  std::vector<std::uint32_t> open;
  for (std::size_t i = 0; i < proxy.size(); ++i) {
    if (proxy.oriented[i]) continue;
    if (votes[i] != 0) {
      if (votes[i] < 0) proxy.normal[i] = -proxy.normal[i];
      proxy.oriented[i] = 1;
    } else {
      open.push_back(static_cast<std::uint32_t>(i));
    }
  }
  constexpr std::size_t kNeighbours = 12;
  std::vector<std::int8_t> decision(proxy.size(), 0);
  while (!open.empty()) {
    parallel_blocks(open.size(), 512, [&](std::size_t b, std::size_t e) {
      std::uint32_t index[kNeighbours];
      float d2[kNeighbours];
      for (std::size_t o = b; o < e; ++o) {
        const std::uint32_t i = open[o];
        const std::size_t n = nearest.find(proxy.position[i], kNeighbours, index, d2);
        float sum = 0;
        for (std::size_t j = 0; j < n; ++j)
          if (proxy.oriented[index[j]]) sum += proxy.normal[i].dot(proxy.normal[index[j]]);
        decision[i] = sum > 0 ? 1 : sum < 0 ? -1 : 0;
      }
    });
    std::vector<std::uint32_t> still;
    for (const std::uint32_t i : open) {
      if (decision[i] == 0) {
        still.push_back(i);
        continue;
      }
      if (decision[i] < 0) proxy.normal[i] = -proxy.normal[i];
      proxy.oriented[i] = 1;
    }
    if (still.size() == open.size()) break;  // an island without any oriented neighbour: it keeps the estimate's sign
    open.swap(still);
  }
}

void Smoother::apply(std::vector<float>& values, int channels, int passes) const {
  const std::size_t n = index.size() / k, c = static_cast<std::size_t>(channels);
  std::vector<float> out(values.size());
  for (int pass = 0; pass < passes; ++pass) {
    parallel_blocks(n, kGrain, [&](std::size_t b, std::size_t e) {
      for (std::size_t i = b; i < e; ++i)
        for (std::size_t ch = 0; ch < c; ++ch) {
          float sum = 0;
          for (std::size_t j = i * k; j < (i + 1) * k; ++j) sum += weight[j] * values[index[j] * c + ch];
          out[i * c + ch] = sum;
        }
    });
    values.swap(out);
  }
}

Smoother make_smoother(const Proxy& proxy, const NearestPoints& nearest, std::size_t k) {
  Smoother s;
  s.k = k;
  s.index.resize(proxy.size() * k);
  s.weight.resize(proxy.size() * k);
  constexpr float kNormalSigma = 0.2f;
  parallel_blocks(proxy.size(), kGrain, [&](std::size_t b, std::size_t e) {
    std::vector<float> d2(k);
    for (std::size_t i = b; i < e; ++i) {
      std::uint32_t* index = s.index.data() + i * k;
      float* weight = s.weight.data() + i * k;
      const std::size_t n = nearest.find(proxy.position[i], k, index, d2.data());
      float sum = 0;
      const float reach2 = 2.0f * d2[n - 1] + 1e-20f;
      for (std::size_t j = 0; j < n; ++j) {
        const std::uint32_t o = index[j];
        const float off = proxy.normal[i].dot(proxy.position[o] - proxy.position[i]) / proxy.radius[i];
        weight[j] = std::exp(-(proxy.normal[i] - proxy.normal[o]).squaredNorm() / (2 * kNormalSigma * kNormalSigma) - 0.5f * off * off - d2[j] / reach2);
        sum += weight[j];
      }
      for (std::size_t j = 0; j < k; ++j) {
        if (j >= n) index[j] = static_cast<std::uint32_t>(i);
        weight[j] = j < n ? weight[j] / sum : 0.0f;
      }
    }
  });
  return s;
}

}  // namespace chiaro::optimize
