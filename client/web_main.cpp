// tessera-web: a server's scenes in browsers.

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <cstdio>

#include "client/web_gateway.h"
#include "common/check.h"
#include "common/log.h"
#include "common/scene_io.h"

int main(int argc, char** argv) {
    using namespace tessera;
    WebGatewayConfig config;
    std::string keys, motion, log_level = "info";
    CLI::App app(
        "Tessera in a browser: a gateway between a server and web pages, each with its own view.\n"
        "Whoever reaches its address looks and edits with the gateway's keys or, on loopback, with "
        "the\n"
        "token in the environment variable TESSERA_TOKEN.",
        "tessera-web");
    app.set_version_flag("--version", TESSERA_VERSION);
    app.add_option("--server", config.viewer.server.address, "HOST:PORT of the server")->required();
    app.add_option("--keys", keys,
                   "folder that `tessera keys` made, for a server that speaks TLS: `viewer` lets "
                   "browsers look, `editor` also edit (default: TESSERA_KEYS)");
    app.add_option("--scene", config.viewer.scene, "a scene of the server (default: its first)");
    app.add_option(
        "--motion", motion,
        "the scene that the server holds, a file or a generated one, for what moves in it: "
        "pages can play it");
    app.add_option("--passes", config.viewer.passes, "passes until a picture has settled")
        ->check(CLI::Range(1u, 1u << 20))
        ->capture_default_str();
    app.add_option("--listen", config.listen, "address for browsers; port 0: any free one")
        ->type_name("HOST:PORT")
        ->capture_default_str();
    app.add_flag("--public", config.beyond_loopback,
                 "may listen beyond loopback, without encryption and passwords");
    app.add_option("--host", config.hosts,
                   "a name by which browsers may call this gateway, as that of a proxy before it; "
                   "addresses and localhost always work");
    app.add_option("--browsers", config.browsers, "views at most")
        ->check(CLI::Range(1, 1024))
        ->capture_default_str();
    app.add_option("--log", log_level, "how much to log")
        ->check(CLI::IsMember({"trace", "debug", "info", "warning", "error", "off"}))
        ->capture_default_str();
    CLI11_PARSE(app, argc, argv);
    start_log("web", log_level);
    try {
        config.viewer.server.credentials = load_credentials(keys);
        config.viewer.server.reconnects = true;
        if (!motion.empty()) config.viewer.motion = load_scene(motion).bundle.motion;
        run_web_gateway(config, [&](const std::string& url) {
            if (config.beyond_loopback)
                spdlog::warn(
                    "--public: whoever can reach {} sees the scene and, with an editor's keys, "
                    "changes it; nothing is encrypted. For strangers' networks put a proxy with "
                    "TLS and passwords before it and listen on loopback",
                    url);
            // The one line on standard output: scripts read it to learn the port.
            fmt::print("listening on {}\n", url);
            std::fflush(stdout);
        });
        return 0;
    } catch (const std::exception& error) {
        fmt::print(stderr, "tessera-web: {}\n", error.what());
        return 1;
    }
}
