// tessera scene: writes generated benchmark scenes to files.

#include <fmt/format.h>

#include "client/commands.h"
#include "common/check.h"
#include "common/generator.h"
#include "common/scene_io.h"

namespace tessera {
namespace {

struct SceneOptions {
    std::string name;
    std::string output;
    int storeys = 0;
    bool list = false;
};

std::string known_names() {
    std::string names;
    for (const GeneratedScene& scene : generated_scenes())
        names += (names.empty() ? "" : ", ") + scene.name;
    return names;
}

void run(const SceneOptions& options) {
    if (options.list) {
        for (const GeneratedScene& scene : generated_scenes())
            fmt::print("{:<12} {}\n", scene.name, scene.description);
        return;
    }
    if (options.name.empty() || options.output.empty())
        throw UserError(
            "scene needs a NAME and -o FILE.glb; `tessera scene --list` tells the names");
    const auto bundle = generate_scene(
        options.storeys > 0 ? fmt::format("{}:{}", options.name, options.storeys) : options.name);
    if (!bundle)
        throw UserError(fmt::format("there is no generated scene `{}`; there are: {}", options.name,
                                    known_names()));
    save_glb(*bundle, options.output);
}

}  // namespace

void add_scene_command(CLI::App& app) {
    auto options = std::make_shared<SceneOptions>();
    CLI::App* command = app.add_subcommand("scene", "Generate a benchmark scene as a .glb file");
    command->add_option("NAME", options->name, "which scene");
    command->add_option("-o,--output", options->output, "the .glb file to write");
    command
        ->add_option("--storeys", options->storeys,
                     "building: so many storeys of closed rooms along corridors, as building:N")
        ->check(CLI::Range(1, 30));
    command->add_flag("--list", options->list, "list the scenes");
    command->callback([options] { run(*options); });
}

}  // namespace tessera
