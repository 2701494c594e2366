// tessera bench: measures the quality of pictures and the latency of views itself, and hands over
// to tessera-bench, which measures the worker's insides.

#include <fmt/format.h>
#include <unistd.h>

#include <cstring>
#include <filesystem>

#include "client/commands.h"
#include "common/check.h"

namespace tessera {
void become(const std::string& name, const std::vector<std::string>& arguments) {
    const auto folder = std::filesystem::read_symlink("/proc/self/exe").parent_path();
    const std::string program = folder / name;
    std::vector<std::string> strings{program};
    strings.insert(strings.end(), arguments.begin(), arguments.end());
    std::vector<char*> argv;
    for (std::string& s : strings) argv.push_back(s.data());
    argv.push_back(nullptr);
    execv(program.c_str(), argv.data());
    throw UserError(fmt::format("cannot start {}: {}; it belongs beside tessera", program,
                                std::strerror(errno)));
}

void add_bench_command(CLI::App& app) {
    CLI::App* command = app.add_subcommand(
        "bench",
        "Measure quality, latency (view), a cluster, or the tracer: trace, build or stability; "
        "`tessera bench --help` tells more");
    add_quality_command(command);
    add_view_bench_command(command);
    add_cluster_command(command);
    // Everything else behind `bench` is tessera-bench's to understand, its --help too.
    command->prefix_command();
    command->set_help_flag();
    command->callback([command] {
        if (command->get_subcommands().empty()) become("tessera-bench", command->remaining());
    });
}

}  // namespace tessera
