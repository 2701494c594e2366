// The subcommands of `tessera`. Each function adds one to the parser; its work runs as the parser's
// callback and ends in UserError or Interrupted when it cannot be done.
#pragma once

#include <CLI/CLI.hpp>
#include <string>
#include <vector>

namespace tessera {

void add_render_command(CLI::App& app);
void add_status_command(CLI::App& app);
void add_compare_command(CLI::App& app);
void add_scene_command(CLI::App& app);
void add_edit_command(CLI::App& app);
/// `record` and `replay`.
void add_record_commands(CLI::App& app);
void add_view_command(CLI::App& app);
void add_bench_command(CLI::App& app);
/// To the command `bench`.
void add_cluster_command(CLI::App* bench);

/// Becomes the program `name`, which lies beside this one.
[[noreturn]] void become(const std::string& name, const std::vector<std::string>& arguments);
void add_quality_command(CLI::App* bench);
void add_view_bench_command(CLI::App* bench);
void add_keys_command(CLI::App& app);

/// `--keys`, for commands that talk to a server.
CLI::Option* add_keys_option(CLI::App* command, std::string& keys);

}  // namespace tessera
