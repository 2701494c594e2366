#include "common/generator.h"

#include <fmt/format.h>

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
constexpr std::int64_t most_storeys = 30;

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
    {"building",
     "thirty furnished rooms around an atrium, each different: a million triangles; building:N: N "
     "storeys of closed rooms along corridors, a view sees few of their lights (7: 20,000 lights, "
     "2.5 million triangles)",
     generate_building},
    {"shading", "wood, marble and brick under a lamp: what material shaders do, 3,000 triangles",
     generate_shading},
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

/// The number in names that begin with `prefix`. Throws UserError when it is not from 1 to `most`.
std::optional<std::int64_t> number_after(std::string_view prefix, const std::string& name,
                                         std::int64_t most) {
    if (!name.starts_with(prefix)) return std::nullopt;
    std::int64_t number = 0;
    if (!parse_number(name.substr(prefix.size()), number) || number < 1 || number > most)
        throw UserError(
            fmt::format("{}: after `{}` a number is wanted, 1 to {}", name, prefix, most));
    return number;
}

}  // namespace

std::vector<GeneratedScene> generated_scenes() {
    std::vector<GeneratedScene> scenes;
    for (const Generator& g : generators) scenes.push_back({g.name, g.description});
    return scenes;
}

std::optional<SceneBundle> generate_scene(const std::string& name) {
    if (const auto triangles = number_after("museum:", name, most_museum_triangles))
        return generate_museum(std::uint32_t(*triangles));
    if (const auto storeys = number_after("building:", name, most_storeys))
        return generate_storeys(int(*storeys));
    for (const Generator& g : generators)
        if (g.name == name) return g.generate();
    return std::nullopt;
}

}  // namespace tessera
