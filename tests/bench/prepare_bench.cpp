// What preparing photographs for blending costs: processor time, and a checksum of what surfels may read of them, so that versions can be compared.
//
//   prepare_bench RUN [--wider N] [--rows N] [--threads N] [--rounds 3] [--vectors 0|1|2]
//
// RUN: the folder of a run that kept its work. Each photograph is prepared whole, or with --rows in bands of so many rows, as where memory does not hold it;
// --wider: further bands (blend.bands less two); --vectors: 0 plain, 1 up to AVX2, 2 what the processor has. Seconds are the processor's, of all threads; the best round counts.
#include <algorithm>
#include <cstdio>
#include <ctime>
#include <fstream>
#include <string>

#include <nlohmann/json.hpp>

#include "blend/photo_window.h"
#include "stream/base/error.h"
#include "stream/base/hash.h"
#include "stream/base/parallel.h"
#include "stream/base/vector_width.h"
#include "tools/camera_record.h"
#include "tools/run_folder.h"

namespace {

using namespace chiaro;

struct Options {
  std::filesystem::path run;
  int wider = 0, rows = 0, threads = 1, rounds = 3, vectors = 2;
};

Options parse(int argc, char** argv) {
  Options o;
  for (int i = 1; i < argc; ++i) {
    const std::string word = argv[i];
    if (!word.starts_with("--")) {
      o.run = word;
      continue;
    }
    int* to = word == "--wider" ? &o.wider : word == "--rows" ? &o.rows : word == "--threads" ? &o.threads : word == "--rounds" ? &o.rounds : word == "--vectors" ? &o.vectors : nullptr;
    if (!to || ++i == argc) throw Error(concat("unknown option or missing value: ", word));
    *to = std::stoi(argv[i]);
  }
  if (o.run.empty() || o.wider < 0 || o.wider > blend::kMostWider || o.rows < 0 || o.threads < 0 || o.rounds < 1 || o.vectors < 0 || o.vectors > 2) throw Error("usage: prepare_bench RUN [--wider N] [--rows N] [--threads N] [--rounds 3] [--vectors 0|1|2]");
  return o;
}

blend::WindowOptions window_options(const tools::RunFolder& folder, int wider) {
  std::ifstream in(folder.record());
  const nlohmann::json weights = nlohmann::json::parse(in).at("blending").at("weights");
  return {.low_radius = weights.at("low_radius"), .reference_footprint = weights.at("footprint"), .border_px = weights.at("border_px"), .wider = wider};
}

double processor_s() { return static_cast<double>(std::clock()) / CLOCKS_PER_SEC; }

/// Of the pixels that surfels may read, and of which these are.
std::uint32_t checksum(const blend::PhotoWindow& window, std::uint32_t sum) {
  for (std::size_t i = 0; i < window.pixels.size(); ++i) {
    const blend::WindowPixel& p = window.pixels[i];
    if (!(p.weight > 0)) {
      sum = crc32c(&i, sizeof i, sum);
      continue;
    }
    const float values[] = {p.depth, p.footprint, p.radius, p.weight, p.normal.x(), p.normal.y(), p.normal.z(), p.sigma, p.low.x(), p.low.y(), p.low.z(), p.shared, p.high.x(), p.high.y(), p.high.z()};
    sum = crc32c(values, sizeof values, sum);
    if (window.wider > 0) sum = crc32c(&window.wider_means[i * static_cast<std::size_t>(window.wider)], static_cast<std::size_t>(window.wider) * sizeof(Vec3f), sum);
  }
  return sum;
}

struct Cost {
  double seconds = 0;
  std::uint32_t sum = 0;
};
Cost prepare(const tools::RunFolder& folder, const tools::PhotographCamera& c, const blend::WindowOptions& options, int band, blend::WindowRoom& room) {
  const std::string& key = c.camera.photograph;
  Cost cost;
  const double began = processor_s();
  double checking = 0;
  const blend::PhotographRasters rasters(c.camera.lens, folder.gbuffer(key), folder.albedo(key), folder.radiance(key));
  const int halo = band > 0 ? blend::halo_rows(options, blend::footprints(rasters).smallest()) : blend::kPyramidRows;
  for (int y = 0; y < rasters.height(); y += band > 0 ? band : rasters.height()) {
    const blend::PhotoWindow window = blend::load_window(rasters, c.camera, y, band > 0 ? std::min(y + band, rasters.height()) : rasters.height(), 0, halo, options, room);
    const double prepared = processor_s();
    cost.sum = checksum(window, cost.sum);
    checking += processor_s() - prepared;
  }
  cost.seconds = processor_s() - began - checking;
  return cost;
}

void measure(const Options& o) {
  const tools::RunFolder folder{o.run};
  const blend::WindowOptions options = window_options(folder, o.wider);
  const ThreadLimit limit(o.threads);
  limit_vectors(static_cast<VectorWidth>(o.vectors));
  double all = 0, megapixels = 0;
  blend::WindowRoom room;   // as a walk has it for a group of photographs
  for (const tools::PhotographCamera& c : tools::read_camera_record(folder.cameras())) {
    Cost best = prepare(folder, c, options, o.rows, room);
    for (int round = 1; round < o.rounds; ++round) best.seconds = std::min(best.seconds, prepare(folder, c, options, o.rows, room).seconds);
    const double mpx = 1e-6 * c.camera.lens.width_px * c.camera.lens.height_px;
    std::printf("%-24s %7.2f Mpx %8.3f s %8.3f s/Mpx  %08x\n", c.camera.photograph.c_str(), mpx, best.seconds, best.seconds / mpx, best.sum);
    all += best.seconds;
    megapixels += mpx;
  }
  std::printf("%-24s %7.2f Mpx %8.3f s %8.3f s/Mpx\n", "together", megapixels, all, all / megapixels);
}

}  // namespace

int main(int argc, char** argv) {
  try {
    measure(parse(argc, argv));
  } catch (const std::exception& e) {
    std::fprintf(stderr, "error: %s\n", e.what());
    return 1;
  }
  return 0;
}
