// How fast point files become a store: one table for each run, with the disk, memcpy and, if given, PotreeConverter on the same file for scale.
//
//   ingest_bench --points 20000000 --format las --normals none --folder /data/scratch [--memory 1GiB] [--threads 2] [--repeat 3] [--peer potree=/path/PotreeConverter]
//
// The cloud is a bumpy sphere of 10 m radius with 1 mm of noise, colours, 0.1 mm steps, in random order: the worst locality a file can have. It is made in
// --folder once and kept (--delete removes it at the end); a LAZ file has to be made from the LAS file by another program. --keep leaves the last store there as bench.chiaro, --verify checks it. Before
// each run the cloud's pages are dropped from the cache; times include every sync to disk. Processor time says more than the clock where others work too.
#include <fcntl.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <bit>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <iostream>
#include <map>
#include <string>
#include <thread>
#include <vector>

#include "stream/base/budget.h"
#include "stream/base/error.h"
#include "stream/base/file.h"
#include "stream/base/parallel.h"
#include "stream/cloud/point_stream.h"
#include "stream/store/octree_build.h"

namespace {

using namespace chiaro;
namespace fs = std::filesystem;
using Clock = std::chrono::steady_clock;

struct Options {
  std::uint64_t points = 5'000'000, memory = std::uint64_t{1} << 30;
  std::string format = "las", normals = "auto", peer;
  fs::path folder = fs::temp_directory_path() / "chiaro_ingest_bench";
  int threads = 0, repeat = 1;
  bool remove = false, verify = false, keep = false;
};

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

double cpu_seconds() {
  rusage use{};
  getrusage(RUSAGE_SELF, &use);
  return static_cast<double>(use.ru_utime.tv_sec + use.ru_stime.tv_sec) + 1e-6 * static_cast<double>(use.ru_utime.tv_usec + use.ru_stime.tv_usec);
}

std::uint64_t hash(std::uint64_t v) {
  v += 0x9e3779b97f4a7c15ull;
  v = (v ^ (v >> 30)) * 0xbf58476d1ce4e5b9ull;
  v = (v ^ (v >> 27)) * 0x94d049bb133111ebull;
  return v ^ (v >> 31);
}
double uniform(std::uint64_t i, std::uint64_t draw) { return static_cast<double>(hash(i * 8 + draw) >> 11) * 0x1p-53; }

struct Sample {
  double x, y, z;
  float nx, ny, nz;
  std::uint8_t red, green, blue;
};

Sample sample(std::uint64_t i) {
  const double z = 2 * uniform(i, 0) - 1, angle = 6.283185307179586 * uniform(i, 1), r = std::sqrt(1 - z * z);
  const double x = r * std::cos(angle), y = r * std::sin(angle);
  const double noise = 0.001 * (uniform(i, 2) + uniform(i, 3) + uniform(i, 4) - 1.5) * 2;
  const double radius = 10 + 0.2 * std::sin(9 * x) * std::sin(7 * y) * std::sin(8 * z) + noise;
  const std::uint64_t c = hash(i * 8 + 5);
  return {radius * x, radius * y, radius * z, static_cast<float>(x), static_cast<float>(y), static_cast<float>(z),
          static_cast<std::uint8_t>(c & 255), static_cast<std::uint8_t>(c >> 8 & 255), static_cast<std::uint8_t>(c >> 16 & 255)};
}

template <class T>
void put(std::byte*& at, T value) {
  std::memcpy(at, &value, sizeof value);
  at += sizeof value;
}

constexpr std::size_t kLasRow = 26, kPlyRow = 27;

void las_row(const Sample& s, std::byte* at) {
  for (const double v : {s.x, s.y, s.z}) put(at, static_cast<std::int32_t>(std::lround(v / 1e-4)));
  put(at, std::uint16_t{1000});
  put(at, std::uint8_t{9});
  put(at, std::uint8_t{2});
  put(at, std::int8_t{0});
  put(at, std::uint8_t{0});
  put(at, std::uint16_t{7});
  for (const std::uint8_t c : {s.red, s.green, s.blue}) put(at, static_cast<std::uint16_t>(257 * c));
}

void ply_row(const Sample& s, std::byte* at) {
  for (const double v : {s.x, s.y, s.z}) put(at, static_cast<float>(v));
  for (const float v : {s.nx, s.ny, s.nz}) put(at, v);
  for (const std::uint8_t c : {s.red, s.green, s.blue}) put(at, c);
}

std::string las_header(std::uint64_t points) {
  std::string h(375, '\0');
  const auto set = [&](std::size_t at, auto value) { std::memcpy(&h[at], &value, sizeof value); };
  std::memcpy(&h[0], "LASF", 4);
  set(24, std::uint8_t{1});
  set(25, std::uint8_t{4});
  set(94, std::uint16_t{375});
  set(96, std::uint32_t{375});
  set(104, std::uint8_t{2});
  set(105, static_cast<std::uint16_t>(kLasRow));
  set(107, static_cast<std::uint32_t>(points <= 0xffffffffu ? points : 0));
  set(247, points);
  for (std::size_t a = 0; a < 3; ++a) {
    set(131 + 8 * a, 1e-4);
    set(179 + 16 * a, 10.25);
    set(187 + 16 * a, -10.25);
  }
  return h;
}

std::string ply_header(std::uint64_t points) {
  return concat("ply\nformat binary_little_endian 1.0\nelement vertex ", points,
                "\nproperty float x\nproperty float y\nproperty float z\nproperty float nx\nproperty float ny\nproperty float nz\n"
                "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n");
}

void write_cloud(const fs::path& path, const Options& options) {
  AtomicFile out(path);
  const bool las = options.format == "las", text = options.format == "xyz";
  if (!text) out.append(las ? las_header(options.points) : ply_header(options.points));
  constexpr std::uint64_t kBatch = 1 << 20;
  const std::size_t row = text ? 64 : las ? kLasRow : kPlyRow;
  std::vector<std::byte> rows(kBatch * row);
  std::vector<std::string> lines(text ? 64 : 0);
  for (std::uint64_t first = 0; first < options.points; first += kBatch) {
    const auto n = static_cast<std::size_t>(std::min(kBatch, options.points - first));
    parallel_blocks(n, kBatch / 64, [&](std::size_t begin, std::size_t end) {
      std::string* block = text ? &lines[begin / (kBatch / 64)] : nullptr;
      if (text) block->clear();
      for (std::size_t i = begin; i < end; ++i) {
        const Sample s = sample(first + i);
        if (las) las_row(s, &rows[i * row]);
        else if (!text) ply_row(s, &rows[i * row]);
        else {
          char line[96];
          block->append(line, static_cast<std::size_t>(std::snprintf(line, sizeof line, "%.4f %.4f %.4f %d %d %d\n", s.x, s.y, s.z, s.red, s.green, s.blue)));
        }
      }
    });
    if (!text) out.append(rows.data(), n * row);
    else
      for (std::size_t b = 0; b * (kBatch / 64) < n; ++b) out.append(lines[b]);
  }
  out.commit();
}

void drop_from_cache(const fs::path& path) {
  const File file(path, File::Mode::kRead);
  fsync(file.descriptor());
  posix_fadvise(file.descriptor(), 0, 0, POSIX_FADV_DONTNEED);
}

std::uint64_t disk_bytes(const fs::path& folder) {
  std::uint64_t sum = 0;
  std::error_code code;
  for (fs::recursive_directory_iterator it(folder, code), end; !code && it != end; it.increment(code)) {
    struct stat info {};
    if (lstat(it->path().c_str(), &info) == 0 && S_ISREG(info.st_mode)) sum += static_cast<std::uint64_t>(info.st_blocks) * 512;
  }
  return sum;
}

struct Phase {
  std::string name;
  double seconds = 0, cpu = 0;
};

// What lies between two stages (syncs, journals) counts to the stage before.
class TimingReporter : public Reporter {
 public:
  void begin(std::string_view stage, std::uint64_t, std::string_view) override {
    close();
    phases.push_back({std::string(stage)});
  }
  void progress(std::uint64_t) override {}
  void end() override {}
  void note(std::string_view text) override { std::printf("  note: %.*s\n", static_cast<int>(text.size()), text.data()); }
  bool cancelled() const override { return false; }
  void close() {
    const Clock::time_point now = Clock::now();
    const double cpu = cpu_seconds();
    if (!phases.empty()) {
      phases.back().seconds = std::chrono::duration<double>(now - wall_).count();
      phases.back().cpu = cpu - cpu_;
    }
    wall_ = now;
    cpu_ = cpu;
  }
  std::vector<Phase> phases{{"start"}};

 private:
  Clock::time_point wall_ = Clock::now();
  double cpu_ = cpu_seconds();
};

stream::NormalSource normals_of(const std::string& word) {
  if (word == "file") return stream::NormalSource::kFile;
  if (word == "none") return stream::NormalSource::kNone;
  if (word == "estimate") return stream::NormalSource::kEstimate;
  return stream::NormalSource::kAuto;
}

/// The parent starts no thread: a child would take it that they are there, and work alone. Returns the exit status.
int in_child(const std::function<void()>& work) {
  std::fflush(stdout);
  if (const pid_t child = fork(); child != 0) {
    int status = 0;
    waitpid(child, &status, 0);
    return status;
  }
  int code = 0;
  try {
    work();
  } catch (const std::exception& e) {
    std::fprintf(stderr, "error: %s\n", e.what());
    code = 1;
  }
  std::fflush(stdout);
  _exit(code);
}

void measure_build(const fs::path& cloud, const fs::path& out, const Options& options) {
  const ThreadLimit limit(options.threads);
  const std::uint64_t held = resident_bytes(), slack = std::clamp<std::uint64_t>(options.memory / 8, 24u << 20, 256u << 20);
  MemoryBudget budget(options.memory - held - slack);
  stream::BuildOptions build;
  build.normals = normals_of(options.normals);
  std::atomic<std::uint64_t> peak_disk{0};
  std::jthread watch([&](std::stop_token stop) {
    while (!stop.stop_requested()) {
      peak_disk = std::max<std::uint64_t>(peak_disk, disk_bytes(out.string() + ".part"));
      std::this_thread::sleep_for(std::chrono::milliseconds(20));
    }
  });
  TimingReporter report;
  const double cpu_start = cpu_seconds();
  const auto start = Clock::now();
  const stream::Manifest m = stream::build_store({cloud}, out, build, budget, report);
  const double seconds = seconds_since(start), cpu = cpu_seconds() - cpu_start;
  report.close();
  watch.request_stop();
  watch.join();
  const auto n = static_cast<double>(options.points);
  const std::uint64_t final_disk = disk_bytes(out);
  for (const Phase& p : report.phases)
    if (p.seconds > 0.01) std::printf("  %-20s %8.2f s %8.2f Mpoint/s %8.3f us CPU/point\n", p.name.c_str(), p.seconds, 1e-6 * n / p.seconds, 1e6 * p.cpu / n);
  std::printf("  %-20s %8.2f s %8.2f Mpoint/s %8.3f us CPU/point\n", "TOTAL", seconds, 1e-6 * n / seconds, 1e6 * cpu / n);
  std::uint64_t layers = disk_bytes(out / "layers");
  std::printf("  peak resident %.0f MiB, disk at the peak %.1f B/point, result %.1f B/point (without layers %.2f B per surfel of %llu), stored %llu\n",
              static_cast<double>(peak_resident_bytes()) / 1048576, static_cast<double>(peak_disk.load()) / n, static_cast<double>(final_disk) / n,
              static_cast<double>(final_disk - layers) / static_cast<double>(m.points_stored + m.surfels_inner), static_cast<unsigned long long>(m.points_stored + m.surfels_inner),
              static_cast<unsigned long long>(m.points_stored));
  if (options.verify) {
    const auto result = stream::verify_store(out, budget, silent_reporter());
    std::printf("  verify: %zu problems\n", result.problems.size());
    for (std::size_t i = 0; i < std::min<std::size_t>(3, result.problems.size()); ++i) std::printf("    %s\n", result.problems[i].c_str());
  }
}

void run_ours(const fs::path& cloud, const Options& options) {
  const fs::path out = options.folder / "bench.chiaro";
  fs::remove_all(out);
  fs::remove_all(out.string() + ".part");
  drop_from_cache(cloud);
  if (in_child([&] { measure_build(cloud, out, options); }) != 0) std::printf("  the run failed\n");
  if (!options.keep) fs::remove_all(out);
}

void run_potree(const std::string& program, const fs::path& cloud, const Options& options) {
  const fs::path out = options.folder / "potree";
  fs::remove_all(out);
  drop_from_cache(cloud);
  const auto start = Clock::now();
  const pid_t child = fork();
  if (child == 0) {
    const int null = open("/dev/null", O_WRONLY);
    dup2(null, 1);
    dup2(null, 2);
    execl(program.c_str(), program.c_str(), cloud.c_str(), "-o", out.c_str(), static_cast<char*>(nullptr));
    _exit(127);
  }
  int status = 0;
  rusage use{};
  wait4(child, &status, 0, &use);
  const double seconds = seconds_since(start), n = static_cast<double>(options.points);
  const double cpu = static_cast<double>(use.ru_utime.tv_sec + use.ru_stime.tv_sec) + 1e-6 * static_cast<double>(use.ru_utime.tv_usec + use.ru_stime.tv_usec);
  std::printf("  %-20s %8.2f s %8.2f Mpoint/s %8.3f us CPU/point, peak resident %.0f MiB, result %.1f B/point%s\n", "PotreeConverter", seconds, 1e-6 * n / seconds, 1e6 * cpu / n,
              static_cast<double>(use.ru_maxrss) / 1024, static_cast<double>(disk_bytes(out)) / n, status == 0 ? "" : " FAILED");
  fs::remove_all(out);
}

void measure_machine(const fs::path& folder) {
  constexpr std::size_t kBytes = 64u << 20;
  constexpr int kTimes = 8;
  const std::vector<char> from(kBytes, 1);
  std::vector<char> to(kBytes);
  auto start = Clock::now();
  for (int i = 0; i < kTimes; ++i) {
    std::memcpy(to.data(), from.data(), kBytes);
    __asm__ volatile("" : : "r"(to.data()) : "memory");
  }
  const double copy = seconds_since(start);
  const fs::path path = folder / "disk.bin";
  start = Clock::now();
  {
    File file(path, File::Mode::kCreate);
    for (int i = 0; i < kTimes; ++i) file.write_at(static_cast<std::uint64_t>(i) * kBytes, from.data(), kBytes);
    file.sync();
  }
  const double written = seconds_since(start);
  drop_from_cache(path);
  start = Clock::now();
  {
    const File file(path, File::Mode::kRead);
    for (int i = 0; i < kTimes; ++i) file.read_at(static_cast<std::uint64_t>(i) * kBytes, to.data(), kBytes);
  }
  const double read = seconds_since(start), bytes = kTimes * static_cast<double>(kBytes);
  fs::remove(path);
  std::printf("machine: memcpy %.1f GB/s, disk write with sync %.2f GB/s, cold read %.2f GB/s, %u processors\n", 1e-9 * bytes / copy, 1e-9 * bytes / written, 1e-9 * bytes / read,
              std::thread::hardware_concurrency());
}

Options parse(int count, char** words) {
  Options o;
  for (int i = 1; i < count; ++i) {
    const std::string word = words[i];
    if (word == "--delete") o.remove = true;
    else if (word == "--verify") o.verify = true;
    else if (word == "--keep") o.keep = true;
    else if (i + 1 == count) throw Error(concat(word, ": a value is missing"));
    else if (word == "--points") o.points = static_cast<std::uint64_t>(std::stod(words[++i]));
    else if (word == "--format") o.format = words[++i];
    else if (word == "--normals") o.normals = words[++i];
    else if (word == "--folder") o.folder = words[++i];
    else if (word == "--memory") o.memory = parse_bytes(words[++i]);
    else if (word == "--threads") o.threads = std::stoi(words[++i]);
    else if (word == "--repeat") o.repeat = std::stoi(words[++i]);
    else if (word == "--peer") o.peer = words[++i];
    else throw Error(concat(word, ": unknown; see the head of ingest_bench.cpp"));
  }
  if (o.format != "las" && o.format != "laz" && o.format != "ply" && o.format != "xyz") throw Error("--format is las, laz, ply or xyz");
  if (!o.peer.empty() && !o.peer.starts_with("potree=")) throw Error("--peer is potree=/path/to/PotreeConverter");
  return o;
}

}  // namespace

int main(int count, char** words) {
  try {
    const Options options = parse(count, words);
    make_folder(options.folder);
    const fs::path cloud = options.folder / concat("cloud_", options.points, ".", options.format);
    if (!fs::exists(cloud) && options.format == "laz") throw Error(concat(cloud.string(), ": is not there; make the .las, compress it with another program, e.g. laspy"));
    if (!fs::exists(cloud) && in_child([&] { write_cloud(cloud, options); }) != 0) throw Error(concat(cloud.string(), ": writing it failed"));
    std::printf("%llu points, %s (%.1f B/point), normals %s, memory %s\n", static_cast<unsigned long long>(options.points), options.format.c_str(),
                static_cast<double>(fs::file_size(cloud)) / static_cast<double>(options.points), options.normals.c_str(), format_bytes(options.memory).c_str());
    measure_machine(options.folder);
    for (int i = 0; i < options.repeat; ++i) {
      run_ours(cloud, options);
      if (!options.peer.empty()) run_potree(options.peer.substr(7), cloud, options);
    }
    if (options.remove) fs::remove(cloud);
    return 0;
  } catch (const std::exception& e) {
    std::fprintf(stderr, "error: %s\n", e.what());
    return 1;
  }
}
