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
#ifdef CHIARO_COMPARE
    {"compare", "two pictures or two coloured clouds: how alike they are", chiaro::tools::run_compare},
#endif
};

int terminal_columns() {
  winsize size = {};
  return ioctl(STDERR_FILENO, TIOCGWINSZ, &size) == 0 && size.ws_col > 0 ? size.ws_col : 80;
}

}  // namespace

int main(int argc, char** argv) {
  // A closed pipe shows up as a failed write with a message instead of a silent death.
  std::signal(SIGPIPE, SIG_IGN);
  chiaro::tools::install_stop_signals();
  chiaro::tools::Console console(std::cout, std::cerr, isatty(STDERR_FILENO) == 1, terminal_columns());
  const std::vector<std::string> args(argv + (argc > 0 ? 1 : 0), argv + argc);
  return chiaro::tools::run_app(args, kCommands, console);
}
