#include "common/log.h"

#include <spdlog/sinks/stdout_color_sinks.h>

namespace tessera {

void start_log(const std::string& program, const std::string& level) {
    auto logger = spdlog::stderr_color_mt(program);
    logger->set_pattern("%H:%M:%S.%e %^%l%$ %n: %v");
    logger->set_level(spdlog::level::from_str(level));
    spdlog::set_default_logger(logger);
}

}  // namespace tessera
