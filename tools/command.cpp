#include "tools/command.h"

#include <algorithm>
#include <exception>
#include <new>
#include <nlohmann/json.hpp>
#include <ostream>
#include <stdexcept>
#include <vector>

#include "stream/base/error.h"
#include "tools/console_report.h"
#include "tools/suggest.h"
#include "tools/table.h"

#ifndef CHIARO_VERSION
#define CHIARO_VERSION "0"
#endif

namespace chiaro::tools {
namespace {

std::string overview(std::span<const Command> commands) {
  Table table({"", ""}, {Table::Align::kLeft, Table::Align::kLeft});
  for (const Command& command : commands) table.row({std::string("  ") + command.name, command.summary});
  return concat(
      "chiaro ", version(), ": albedo of massive scans from flash photographs\n\n"
      "usage: chiaro COMMAND [OPTIONS]\n\ncommands\n", table.text(),
      "\n`chiaro COMMAND --help` explains a command. Exit codes: 0 all well, 1 failed, 2 wrong command line or project file,\n"
      "3 finished, but something had to be left out, 130 interrupted (resumable).\n");
}

int dispatch(std::span<const std::string> args, std::span<const Command> commands, Console& console) {
  if (args.empty()) {
    console.err() << overview(commands);
    return 2;
  }
  std::string name = args[0];
  std::vector<std::string> rest(args.begin() + 1, args.end());
  if (name == "--version" || name == "-V") return console.out() << "chiaro " << version() << '\n', 0;
  if (name == "--help" || name == "-h" || name == "help") {
    if (rest.empty()) return console.out() << overview(commands), 0;
    name = rest[0];
    rest = {"--help"};
  }
  std::vector<std::string> names;
  for (const Command& command : commands) {
    if (name == command.name) return command.run(rest, console);
    names.push_back(command.name);
  }
  throw UsageError(concat(name.starts_with("-") ? "unknown option \"" : "unknown command \"", name, "\"", suggestion(name, names)));
}

int fail(Console& console, const std::string& message, int code) {
  console.clear_line();
  if (console.json)
    console.out() << "{\"event\":\"error\",\"text\":" << json_quote(message) << ",\"exit\":" << code << "}\n" << std::flush;
  console.err() << "error: " << message << '\n' << std::flush;
  return code;
}

}  // namespace

std::string version() { return CHIARO_VERSION; }

Console::Console(std::ostream& out, std::ostream& err, bool is_terminal, int columns)
    : out_(out), err_(err), is_terminal_(is_terminal), columns_(columns) {}
Console::~Console() = default;

Reporter& Console::report() {
  if (!report_) {
    ConsoleReportOptions options;
    options.is_terminal = is_terminal_;
    options.columns = columns_;
    options.json = json;
    options.quiet = quiet;
    report_ = std::make_unique<ConsoleReport>(err_, out_, options);
  }
  return *report_;
}

void Console::clear_line() {
  if (report_) static_cast<ConsoleReport&>(*report_).clear();
}

void Console::result(const std::string& json_object) {
  const auto members = nlohmann::ordered_json::parse(json_object, nullptr, false);
  if (!members.is_object()) throw std::invalid_argument("Console::result: not a JSON object");
  nlohmann::ordered_json event;
  event["event"] = "result";
  for (const auto& [key, value] : members.items()) event[key] = value;
  clear_line();
  out_ << event.dump(-1, ' ', false, nlohmann::ordered_json::error_handler_t::replace) << '\n' << std::flush;
}

int exit_code_of_exception() {
  try {
    throw;
  } catch (const UsageError&) {
    return 2;
  } catch (const Cancelled&) {
    return 130;
  } catch (...) {
    return 1;
  }
}

int run_app(std::span<const std::string> args, std::span<const Command> commands, Console& console) {
  console.json = std::find(args.begin(), args.end(), "--json") != args.end();   // before anything can be wrong with the command line
  try {
    const int code = dispatch(args, commands, console);
    console.clear_line();
    console.out() << std::flush;
    if (!console.out()) return fail(console, "the result could not be written to the standard output", 1);
    return code;
  } catch (const Cancelled&) {
    return fail(console, "interrupted; the same command goes on from here", exit_code_of_exception());
  } catch (const std::bad_alloc&) {
    return fail(console, "out of memory: the system gave no more; try a smaller --memory, or end other programs", exit_code_of_exception());
  } catch (const std::exception& e) {
    return fail(console, e.what(), exit_code_of_exception());
  }
}

}  // namespace chiaro::tools
