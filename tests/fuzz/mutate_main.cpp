/// Stands in for libFuzzer where the compiler has none: mutates the files of a corpus, without feedback.
///   fuzz_TARGET FOLDER [SECONDS=600] [SEED=1]        the input that runs is kept in crash-TARGET, so that it is there after a crash
///   fuzz_TARGET FILE                                  runs one file
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <filesystem>

#include "stream/base/file.h"
#include "stream/base/rng.h"
#include "tests/fuzz/mutate.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size);

namespace fs = std::filesystem;

namespace {

int run(const std::string& bytes) { return LLVMFuzzerTestOneInput(reinterpret_cast<const std::uint8_t*>(bytes.data()), bytes.size()); }

void keep(const std::string& name, const std::string& bytes) {
  chiaro::File file(name, chiaro::File::Mode::kCreate);
  file.write_at(0, bytes.data(), bytes.size());
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 2) return std::fprintf(stderr, "usage: %s FOLDER [SECONDS] [SEED], or FILE\n", argv[0]), 2;
  if (fs::is_regular_file(argv[1])) return run(chiaro::read_text(argv[1]));
  std::vector<std::string> corpus;
  for (const auto& entry : fs::directory_iterator(argv[1]))
    if (entry.is_regular_file()) corpus.push_back(chiaro::read_text(entry.path()));
  if (corpus.empty()) return std::fprintf(stderr, "%s holds no files\n", argv[1]), 2;
  const double seconds = argc > 2 ? std::atof(argv[2]) : 600;
  const std::uint64_t seed = argc > 3 ? std::strtoull(argv[3], nullptr, 10) : 1;
  const auto start = std::chrono::steady_clock::now();
  const auto elapsed = [&] { return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count(); };
  std::uint64_t round = 0;
  double slowest = 0;
  for (; elapsed() < seconds; ++round) {
    const std::string bytes = chiaro::fuzz::mutated(corpus[round % corpus.size()], seed, round);
    keep("crash-" CHIARO_FUZZ_TARGET, bytes);
    const double before = elapsed();
    run(bytes);
    if (elapsed() - before > slowest) {
      slowest = elapsed() - before;
      if (slowest > 1) keep("slow-" CHIARO_FUZZ_TARGET, bytes);
    }
  }
  fs::remove("crash-" CHIARO_FUZZ_TARGET);
  std::printf("%s: %llu inputs in %.0f s, the slowest %.3f s\n", CHIARO_FUZZ_TARGET, static_cast<unsigned long long>(round), elapsed(), slowest);
}
