// tessera keys: who may connect to a server that listens beyond loopback.

#include <fmt/format.h>

#include "client/commands.h"
#include "common/keys.h"

namespace tessera {
namespace {

void run(const std::string& folder) {
    make_keys(folder);
    fmt::print(
        "{0}/server     for tessera-server --listen HOST:PORT --keys {0}/server\n"
        "{0}/worker     for tessera-worker --server HOST:PORT --keys {0}/worker\n"
        "{0}/editor     for who may bring and change scenes: tessera ... --keys {0}/editor\n"
        "{0}/viewer     for who may look: tessera ... --keys {0}/viewer\n"
        "{0}/authority  for nobody: whoever has its key can make more keys; put it away\n"
        "Copy to each machine only the folders of its roles.\n",
        folder);
}

}  // namespace

void add_keys_command(CLI::App& app) {
    auto folder = std::make_shared<std::string>();
    CLI::App* command = app.add_subcommand(
        "keys", "Make certificates and tokens for a server that others reach over the network");
    command->add_option("FOLDER", *folder, "folder to make")->required();
    command->callback([folder] { run(*folder); });
}

CLI::Option* add_keys_option(CLI::App* command, std::string& keys) {
    return command->add_option("--keys", keys,
                               "folder that `tessera keys` made, for a server that speaks TLS "
                               "(default: TESSERA_KEYS)");
}

}  // namespace tessera
