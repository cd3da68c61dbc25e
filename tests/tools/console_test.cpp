#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <csignal>
#include <cstdlib>
#include <new>
#include <nlohmann/json.hpp>
#include <sstream>
#include <thread>

#include "stream/base/error.h"
#include "tools/args.h"
#include "tools/command.h"
#include "tools/console_report.h"

namespace chiaro::tools {
namespace {

using testing::HasSubstr;
using Words = std::vector<std::string>;

struct Report {
  double now = 100;
  std::ostringstream talk, events;
  ConsoleReportOptions options;
  Report() {
    options.now_s = [this] { return now; };
  }
};

TEST(ConsoleReport, PrintsPlainLinesAtStartAndEndAndEveryTenSeconds) {
  Report r;
  ConsoleReport report(r.talk, r.events, r.options);
  report.begin("raycast photo_03", 307200, "pixels");
  for (int i = 1; i <= 12; ++i) {
    r.now += 1;
    report.progress(static_cast<std::uint64_t>(i) * 10000);
  }
  report.note("3 masks are missing");
  report.end();
  EXPECT_EQ(r.talk.str(),
            "raycast photo_03: 307 200 pixels\n"
            "raycast photo_03  32 %  100 k of 307 k pixels  10 k pixels/s  ETA 21 s\n"
            "note: 3 masks are missing\n"
            "raycast photo_03: 12 s (10 k pixels/s)\n");
  EXPECT_EQ(r.events.str(), "");
}

TEST(ConsoleReport, RewritesOneLineOnATerminal) {
  Report r;
  r.options.is_terminal = true;
  r.options.columns = 30;
  ConsoleReport report(r.talk, r.events, r.options);
  report.begin("ingest", 1000000, "points");
  r.now += 2;
  report.progress(500000);
  report.end();
  const std::string text = r.talk.str();
  EXPECT_THAT(text, HasSubstr("\r\033[Kingest  50 %"));
  EXPECT_THAT(text, testing::EndsWith("\r\033[Kingest: 2.0 s (250 k points/s)\n"));
  EXPECT_EQ(std::count(text.begin(), text.end(), '\n'), 1);
  std::size_t start = 0;
  for (std::size_t at = text.find("\033[K"); at != std::string::npos; at = text.find("\033[K", start)) {
    start = at + 3;
    EXPECT_LE(std::min(text.find_first_of("\r\n", start), text.size()) - start, 33u) << "no live line wraps";
  }
}

TEST(ConsoleReport, WritesOneJsonEventALine) {
  Report r;
  r.options.json = true;
  ConsoleReport report(r.talk, r.events, r.options);
  report.begin("light \"day1\"", 0, "");
  report.begin("raycast", 10, "rows");
  r.now += 1.5;
  report.progress(5);
  report.end();
  report.note("bad \xff byte");
  report.end();
  std::istringstream lines(r.events.str());
  std::vector<nlohmann::json> events;
  for (std::string line; std::getline(lines, line);) events.push_back(nlohmann::json::parse(line));
  ASSERT_EQ(events.size(), 6u);
  EXPECT_EQ(events[0]["stage"], "light \"day1\"");
  EXPECT_EQ(events[0]["total"], nullptr);
  EXPECT_EQ(events[2]["event"], "progress");
  EXPECT_EQ(events[2]["done"], 5);
  EXPECT_DOUBLE_EQ(events[2]["eta_s"], 1.5);
  EXPECT_EQ(events[3]["event"], "end");
  EXPECT_EQ(events[3]["stage"], "raycast");
  EXPECT_EQ(events[4]["event"], "note");
  EXPECT_EQ(events[5]["stage"], "light \"day1\"");
  EXPECT_EQ(r.talk.str(), "");
}

TEST(ConsoleReport, IsSilentButForNotesWhenQuiet) {
  Report r;
  r.options.quiet = true;
  ConsoleReport report(r.talk, r.events, r.options);
  report.begin("ingest", 10, "points");
  r.now += 60;
  report.progress(5);
  report.note("look here");
  report.end();
  report.end();  // one too many does no harm
  EXPECT_EQ(r.talk.str(), "note: look here\n");
}

TEST(ConsoleReport, TakesProgressFromManyThreads) {
  std::ostringstream talk, events;
  ConsoleReportOptions options;
  options.plain_interval_s = 0;
  ConsoleReport report(talk, events, options);
  report.begin("work", 4000, "items");
  std::vector<std::thread> threads;
  for (int t = 0; t < 4; ++t)
    threads.emplace_back([&report, t] {
      for (int i = 0; i < 1000; ++i) report.progress(static_cast<std::uint64_t>(i * 4 + t + 1));
    });
  for (auto& thread : threads) thread.join();
  report.end();
  EXPECT_THAT(talk.str(), HasSubstr("100 %"));
}

TEST(StopSignals, TheFirstAsksAndTheSecondEnds) {
  GTEST_FLAG_SET(death_test_style, "threadsafe");
  EXPECT_FALSE(stop_requested());
  EXPECT_EXIT(
      {
        install_stop_signals();
        std::raise(SIGINT);
        if (!stop_requested()) std::exit(1);
        std::raise(SIGTERM);
        std::exit(2);
      },
      testing::KilledBySignal(SIGTERM), "");
}

struct Ran {
  int code;
  std::string out, err;
};

template <std::size_t N>
Ran run(const Words& words, const Command (&commands)[N]) {
  std::ostringstream out, err;
  Console console(out, err);
  const int code = run_app(words, commands, console);
  return {code, out.str(), err.str()};
}

template <class E>
int fail_with(std::span<const std::string>, Console&) {
  if constexpr (std::is_constructible_v<E, const char*>) throw E("cloud.ply: ends early");
  else throw E();
}

const Command kCommands[] = {{"ingest", "makes a store", [](std::span<const std::string>, Console&) { return 0; }},
                             {"partial", "leaves something out", [](std::span<const std::string>, Console&) { return 3; }},
                             {"usage", "", fail_with<UsageError>},
                             {"error", "", fail_with<Error>},
                             {"cancel", "", fail_with<Cancelled>},
                             {"memory", "", fail_with<std::bad_alloc>},
                             {"caller", "", fail_with<std::invalid_argument>}};

TEST(App, TurnsFailuresIntoExitCodes) {
  EXPECT_EQ(run({"ingest"}, kCommands).code, 0);
  EXPECT_EQ(run({"partial"}, kCommands).code, 3);
  EXPECT_EQ(run({"usage"}, kCommands).code, 2);
  EXPECT_EQ(run({"error"}, kCommands).code, 1);
  EXPECT_EQ(run({"error"}, kCommands).err, "error: cloud.ply: ends early\n");
  EXPECT_EQ(run({"cancel"}, kCommands).code, 130);
  EXPECT_EQ(run({"memory"}, kCommands).code, 1);
  EXPECT_THAT(run({"memory"}, kCommands).err, HasSubstr("out of memory"));
  EXPECT_EQ(run({"caller"}, kCommands).code, 1);
}

TEST(App, ListsCommandsAndSuggestsTheNearest) {
  EXPECT_EQ(run({}, kCommands).code, 2);
  EXPECT_EQ(run({"--help"}, kCommands).code, 0);
  EXPECT_THAT(run({"help"}, kCommands).out, HasSubstr("makes a store"));
  EXPECT_THAT(run({"--version"}, kCommands).out, testing::StartsWith("chiaro "));
  const Ran ran = run({"ignest"}, kCommands);
  EXPECT_EQ(ran.code, 2);
  EXPECT_EQ(ran.err, "error: unknown command \"ignest\"; did you mean \"ingest\"?\n");
}

TEST(Console, WritesResultsAsOneEvent) {
  std::ostringstream out, err;
  Console console(out, err);
  console.json = true;
  console.result(R"({"psnr": 31.5,
    "ssim": null})");
  EXPECT_EQ(out.str(), "{\"event\":\"result\",\"psnr\":31.5,\"ssim\":null}\n");
  EXPECT_THROW(console.result("[1]"), std::invalid_argument);
}

struct Options {
  std::string file, out = "x.out", mode = "auto";
  std::vector<std::string> sets;
  double radius = 3.5;
  int threads = 0;
  std::uint64_t memory = std::uint64_t{2} << 30;
  bool fill = false, parsed = false;
};

Options parse(const Words& words, std::string* help = nullptr) {
  std::ostringstream out, err;
  Console console(out, err);
  Options o;
  Args args("demo", "Shows how.");
  args.positional("FILE", o.file, "what to read");
  args.option("-o,--out", o.out, "where to write", "DIR");
  args.option("--radius", o.radius, "of the search", "METRES", 0.1, 10);
  args.choice("--normals", o.mode, {"auto", "file", "estimate"}, "where they come from");
  args.list("--set", o.sets, "overrides a key", "KEY=VALUE");
  args.flag("--fill", o.fill, "fills");
  args.resources(o.memory, o.threads);
  args.common(console);
  o.parsed = args.parse(words, console);
  if (help) *help = out.str();
  return o;
}

std::string complaint(const Words& words) {
  try {
    parse(words);
  } catch (const UsageError& e) {
    return e.what();
  }
  return "none";
}

TEST(Args, ReadsOptionsInAnyOrder) {
  const Options o = parse({"--set", "a=1", "f.toml", "--set", "b=-2", "-o", "dir", "--radius=2.5", "--memory", "512MiB", "--fill", "--threads", "3", "--normals", "file"});
  EXPECT_EQ(o.file, "f.toml");
  EXPECT_EQ(o.sets, (Words{"a=1", "b=-2"}));
  EXPECT_EQ(o.out, "dir");
  EXPECT_EQ(o.radius, 2.5);
  EXPECT_EQ(o.memory, 512u << 20);
  EXPECT_EQ(o.threads, 3);
  EXPECT_EQ(o.mode, "file");
  EXPECT_TRUE(o.fill);
  EXPECT_EQ(parse({"f"}).memory, std::uint64_t{2} << 30);
}

TEST(Args, HelpShowsDefaultsAndUnits) {
  std::string help;
  EXPECT_FALSE(parse({"--help"}, &help).parsed);
  for (const char* part : {"Shows how.", "chiaro demo", "METRES", "3.5", "2.00 GiB", "auto|file|estimate", "x.out", "--json", "0 = all cores"}) EXPECT_THAT(help, HasSubstr(part));
}

TEST(Args, SuggestTheNearestOptionAndNameBadValues) {
  EXPECT_EQ(complaint({"f", "--raduis", "3"}), "chiaro demo: unknown option \"--raduis\"; did you mean \"--radius\"?");
  EXPECT_EQ(complaint({"--hlep"}), "chiaro demo: unknown option \"--hlep\"; did you mean \"--help\"?");
  EXPECT_THAT(complaint({"f", "--normals", "flie"}), HasSubstr("did you mean \"file\"?"));
  EXPECT_THAT(complaint({"f", "--radius", "nan"}), HasSubstr("outside"));
  EXPECT_THAT(complaint({"f", "--radius", "11"}), HasSubstr("outside"));
  EXPECT_THAT(complaint({"f", "--radius", "x"}), HasSubstr("--radius"));
  EXPECT_THAT(complaint({"f", "--threads", "-1"}), HasSubstr("outside"));
  EXPECT_THAT(complaint({"f", "--memory", "lots"}), HasSubstr("--memory"));
  EXPECT_THAT(complaint({}), HasSubstr("FILE"));
  EXPECT_NE(complaint({"f", "g"}), "none");
  EXPECT_NE(complaint({"f", "-x"}), "none");
}

}  // namespace
}  // namespace chiaro::tools
