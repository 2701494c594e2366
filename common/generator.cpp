#include "common/generator.h"

#include <algorithm>

#include "common/check.h"
#include "common/generators.h"
#include "common/text_reader.h"

namespace tessera {
namespace {

struct Generator {
    const char* name;
    const char* description;
    SceneBundle (*generate)();
};

constexpr std::uint32_t museum_triangles = 4096;
constexpr std::int64_t most_museum_triangles = 1 << 20;

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
    {"robots",
     "sixteen robots that walk through a town: 161 instances, a hundred thousand triangles",
     generate_robots},
    {"kitchen",
     "mirrors under six point lights, and a toy train that goes round: 110,000 triangles",
     generate_kitchen},
    {"terrain", "hills with 660 trees that sway in the wind: 661 instances, ten million triangles",
     generate_terrain},
    {"museum",
     "a hall where 4096 mirroring triangles fly about, each its own way; museum:N: N of them",
     [] { return generate_museum(museum_triangles); }},
};

}  // namespace

std::vector<GeneratedScene> generated_scenes() {
    std::vector<GeneratedScene> scenes;
    for (const Generator& g : generators) scenes.push_back({g.name, g.description});
    return scenes;
}

std::optional<SceneBundle> generate_scene(const std::string& name) {
    constexpr std::string_view museum = "museum:";
    if (name.starts_with(museum)) {
        std::int64_t triangles = 0;
        if (!parse_number(name.substr(museum.size()), triangles) || triangles < 1 ||
            triangles > most_museum_triangles)
            throw UserError(name +
                            ": after `museum:` a number of triangles is wanted, 1 to 1048576");
        return generate_museum(std::uint32_t(triangles));
    }
    for (const Generator& g : generators)
        if (g.name == name) return g.generate();
    return std::nullopt;
}

}  // namespace tessera
