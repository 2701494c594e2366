// The log: one line is one event, on standard error. The only global.
#pragma once

#include <spdlog/spdlog.h>

#include <string>

namespace tessera {

/// Sends log lines to standard error as `time level program: text`. Call once in main.
/// `level` is one of trace, debug, info, warning, error, off.
void start_log(const std::string& program, const std::string& level);

}  // namespace tessera
