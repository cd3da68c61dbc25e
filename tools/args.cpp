#include "tools/args.h"

#include <algorithm>
#include <CLI/CLI.hpp>
#include <cmath>
#include <functional>
#include <ostream>

#include "stream/base/budget.h"
#include "stream/base/error.h"
#include "tools/suggest.h"
#include "tools/table.h"

namespace chiaro::tools {

struct Args::Impl {
  CLI::App app;
  std::string command;
  std::vector<std::function<void()>> after;  ///< checks and conversions once the words are read
  std::vector<std::unique_ptr<std::string>> texts;

  Impl(const std::string& name, const std::string& description) : app(description, "chiaro " + name), command(name) {}

  std::vector<std::string> long_names() const {
    std::vector<std::string> names;
    for (const CLI::Option* option : app.get_options())
      for (const std::string& name : option->get_lnames()) names.push_back("--" + name);
    return names;
  }

  /// Mistyped options are found before anything else: what they would swallow or lack only confuses the message.
  void check_names(std::span<const std::string> words) const {
    const std::vector<std::string> known = long_names();
    for (const std::string& word : words) {
      if (word == "--") return;
      if (!word.starts_with("--")) continue;
      const std::string name = word.substr(0, word.find('='));
      if (std::find(known.begin(), known.end(), name) == known.end())
        throw UsageError(concat("chiaro ", command, ": unknown option \"", name, "\"", suggestion(name, known)));
    }
  }
};

Args::Args(const std::string& command, const std::string& description) : impl_(std::make_unique<Impl>(command, description)) {
  impl_->app.set_help_flag("-h,--help", "this text");
  impl_->app.get_formatter()->column_width(34);
}
Args::~Args() = default;

void Args::positional(const std::string& name, std::string& value, const std::string& help) {
  impl_->app.add_option(name, value, help)->required()->type_name("");
}

void Args::positionals(const std::string& name, std::vector<std::string>& values, const std::string& help) {
  impl_->app.add_option(name, values, help)->required()->type_name("");
}

void Args::option(const std::string& flags, std::string& value, const std::string& help, const std::string& unit) {
  auto* option = impl_->app.add_option(flags, value, help)->type_name(unit);
  if (!value.empty()) option->default_str(value);
}

void Args::option(const std::string& flags, double& value, const std::string& help, const std::string& unit, double min, double max) {
  impl_->app.add_option(flags, value, help)->type_name(unit)->default_str(format_number(value, 6));
  impl_->after.push_back([&value, flags, unit, min, max] {
    // Written so that NaN fails.
    if (!(value >= min && value <= max)) throw UsageError(concat(flags, ": ", value, " ", unit, " is outside ", min, " .. ", max));
  });
}

void Args::option(const std::string& flags, int& value, const std::string& help, const std::string& unit, int min, int max) {
  impl_->app.add_option(flags, value, help)->type_name(unit)->default_str(std::to_string(value));
  impl_->after.push_back([&value, flags, min, max] {
    if (value < min || value > max) throw UsageError(concat(flags, ": ", value, " is outside ", min, " .. ", max));
  });
}

void Args::option(const std::string& flags, std::uint64_t& value, const std::string& help, const std::string& unit) {
  impl_->app.add_option(flags, value, help)->type_name(unit)->default_str(std::to_string(value));
}

void Args::list(const std::string& flags, std::vector<std::string>& values, const std::string& help, const std::string& unit) {
  // One value an occurrence: `--set a=1 project.toml` must leave the file alone.
  impl_->app.add_option(flags, values, help)->type_name(unit)->type_size(1)->expected(1)->multi_option_policy(CLI::MultiOptionPolicy::TakeAll)->allow_extra_args(false);
}

void Args::flag(const std::string& flags, bool& value, const std::string& help) { impl_->app.add_flag(flags, value, help); }

void Args::choice(const std::string& flags, std::string& value, const std::vector<std::string>& choices, const std::string& help) {
  std::string names;
  for (const std::string& name : choices) names += (names.empty() ? "" : "|") + name;
  impl_->app.add_option(flags, value, help)->type_name(names)->default_str(value);
  impl_->after.push_back([&value, flags, choices] {
    if (std::find(choices.begin(), choices.end(), value) == choices.end())
      throw UsageError(concat(flags, ": unknown value \"", value, "\"", suggestion(value, choices)));
  });
}

void Args::bytes(const std::string& flags, std::uint64_t& value, const std::string& help) {
  std::string& text = *impl_->texts.emplace_back(std::make_unique<std::string>(value > 0 ? format_bytes(value) : std::string()));
  const std::string before = text;
  impl_->app.add_option(flags, text, help)->type_name("SIZE")->default_str(text);
  impl_->after.push_back([&value, &text, before, flags] {
    if (text == before) return;
    try {
      value = parse_bytes(text);
    } catch (const UsageError& e) {
      throw UsageError(concat(flags, ": ", e.what()));
    }
  });
}

void Args::require(const std::string& flag) { impl_->app.get_option(flag)->required(); }

void Args::common(Console& console) {
  flag("--json", console.json, "results and progress as JSON, one event per line, on the standard output");
  flag("--quiet", console.quiet, "no progress; results, notes and errors only");
}

void Args::resources(std::uint64_t& memory_bytes, int& threads) {
  bytes("--memory", memory_bytes, memory_bytes > 0 ? "memory that the process may use" : "memory that the process may use; default: run.memory of the project file");
  option("--threads", threads, "threads; 0 = all cores", "N", 0, 4096);
}

bool Args::parse(std::span<const std::string> words, Console& console) {
  impl_->check_names(words);
  std::vector<std::string> reversed(words.rbegin(), words.rend());
  try {
    impl_->app.parse(reversed);
  } catch (const CLI::CallForHelp&) {
    console.out() << impl_->app.help();
    return false;
  } catch (const CLI::ParseError& e) {
    throw UsageError(concat("chiaro ", impl_->command, ": ", e.what(), " (see chiaro ", impl_->command, " --help)"));
  }
  for (const auto& check : impl_->after) {
    try {
      check();
    } catch (const UsageError& e) {
      throw UsageError(concat("chiaro ", impl_->command, ": ", e.what()));
    }
  }
  return true;
}

std::size_t Args::count(const std::string& flag) const { return impl_->app.get_option(flag)->count(); }

}  // namespace chiaro::tools
