/// The executable: the table of its commands, the terminal, and the stop signals. Everything else is in tools_core, where tests reach it.
#include <sys/ioctl.h>
#include <unistd.h>

#include <csignal>
#include <iostream>
#include <string>
#include <vector>

#include "tools/command.h"
#include "tools/commands.h"
#include "tools/console_report.h"

namespace {

using chiaro::tools::Command;

// In the order of `chiaro --help`.
const Command kCommands[] = {
    {"run", "the whole way: cloud and flash photographs in, albedo per point out", chiaro::tools::run_run},
    {"ingest", "point files to a store", chiaro::tools::run_ingest},
    {"info", "what a store holds", chiaro::tools::run_info},
    {"verify", "checks every byte of a store, repairs what can be", chiaro::tools::run_verify},
    {"export", "a layer of a store to a point file", chiaro::tools::run_export},
    {"render", "predicted photographs from a finished run", chiaro::tools::run_render},
    {"compare", "two pictures, or the colours of two clouds: how alike they are", chiaro::tools::run_compare},
    {"report", "HTML report of a finished run, and its numbers as JSON", chiaro::tools::run_report},
    {"status", "what a run has done and has still to do, times and sizes", chiaro::tools::run_status},
    {"synth", "synthetic clouds of any size", chiaro::tools::run_synth},
};

int terminal_columns() {
  winsize size = {};
  return ioctl(STDERR_FILENO, TIOCGWINSZ, &size) == 0 && size.ws_col > 0 ? size.ws_col : 80;
}

}  // namespace

int main(int argc, char** argv) {
  // A closed pipe, and a limit on the size of files, show up as a failed write with a message instead of a silent death.
  std::signal(SIGPIPE, SIG_IGN);
  std::signal(SIGXFSZ, SIG_IGN);
  chiaro::tools::install_stop_signals();
  chiaro::tools::Console console(std::cout, std::cerr, isatty(STDERR_FILENO) == 1, terminal_columns());
  const std::vector<std::string> args(argv + (argc > 0 ? 1 : 0), argv + argc);
  return chiaro::tools::run_app(args, kCommands, console);
}
