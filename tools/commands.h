/// Every command of the executable. One file each: cmd_NAME.cpp defines run_NAME; main.cpp lists them in the order of `chiaro --help`.
#pragma once
#include <span>
#include <string>

#include "tools/command.h"

namespace chiaro::tools {

int run_compare(std::span<const std::string> args, Console&);
int run_export(std::span<const std::string> args, Console&);
int run_render(std::span<const std::string> args, Console&);
int run_run(std::span<const std::string> args, Console&);
int run_info(std::span<const std::string> args, Console&);
int run_ingest(std::span<const std::string> args, Console&);
int run_report(std::span<const std::string> args, Console&);
int run_status(std::span<const std::string> args, Console&);
int run_synth(std::span<const std::string> args, Console&);
int run_verify(std::span<const std::string> args, Console&);

}  // namespace chiaro::tools
