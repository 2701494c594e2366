#include "common/generator.h"

#include "common/generators.h"

namespace tessera {
namespace {

struct Generator {
    const char* name;
    const char* description;
    SceneBundle (*generate)();
};

constexpr Generator generators[] = {
    {"cornell", "the Cornell box as measured: two blocks, one area light, 32 triangles",
     generate_cornell},
    {"office",
     "a furnished office like the one of Wald's thesis: five area lights, 38,000 triangles",
     generate_office},
    {"rooms",
     "ten rooms behind open doors with ten lamps each, of which a view sees few: 80,000 triangles",
     generate_rooms},
    {"foliage", "leaves in sun and sky, nothing smooth anywhere: 120,000 leaves", generate_foliage},
    {"building", "thirty furnished rooms around an atrium, each different: a million triangles",
     generate_building},
    {"sunflowers", "a field of 28,000 instances of ten sunflowers: a billion triangles",
     generate_sunflowers},
};

}  // namespace

std::vector<GeneratedScene> generated_scenes() {
    std::vector<GeneratedScene> scenes;
    for (const Generator& g : generators) scenes.push_back({g.name, g.description});
    return scenes;
}

std::optional<SceneBundle> generate_scene(const std::string& name) {
    for (const Generator& g : generators)
        if (g.name == name) return g.generate();
    return std::nullopt;
}

}  // namespace tessera
