// tessera: all clients in one command.

#include <fmt/format.h>

#include <cstdio>

#include "client/commands.h"
#include "client/interrupt.h"
#include "common/check.h"
#include "common/contained_load.h"
#include "common/log.h"

int main(int argc, char** argv) {
    using namespace tessera;
    if (const std::optional<int> status = load_for_parent(argc, argv)) return *status;
    CLI::App app("Tessera renders scenes with global illumination on a cluster.", "tessera");
    app.set_version_flag("--version", TESSERA_VERSION);
    app.require_subcommand(1);
    app.option_defaults()->always_capture_default();
    add_render_command(app);
    add_status_command(app);
    add_compare_command(app);
    add_scene_command(app);
    add_view_command(app);
    add_edit_command(app);
    add_record_commands(app);
    add_bench_command(app);
    add_keys_command(app);
    start_log("tessera", "warning");
    try {
        app.parse(argc, argv);
        return 0;
    } catch (const CLI::ParseError& error) {
        return app.exit(error) == 0 ? 0 : 2;
    } catch (const UserError& error) {
        fmt::print(stderr, "tessera: {}\n", error.what());
    } catch (const Interrupted& interrupted) {
        fmt::print(stderr, "tessera: interrupted\n");
        return 128 + interrupted.signal;
    } catch (const std::exception& error) {
        fmt::print(stderr, "tessera: unexpected: {}\n", error.what());
    }
    return 1;
}
