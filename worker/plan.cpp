#include "worker/plan.h"

#include <fmt/format.h>

namespace tessera {
namespace {

std::size_t count_lights(const Scene& scene, LightKind kind) {
    return std::size_t(std::count_if(scene.lights.begin(), scene.lights.end(),
                                     [&](const Light& l) { return l.kind == kind; }));
}

template <class Predicate>
std::size_t count_materials(const Scene& scene, Predicate predicate) {
    return std::size_t(std::count_if(scene.materials.begin(), scene.materials.end(), predicate));
}

void note(ScenePlan& plan, std::size_t count, const std::string& what, const std::string& how) {
    if (count > 0)
        plan.modelled.push_back(fmt::format("{}: {}{}", what, count, how));
    else
        plan.left_out.push_back(fmt::format("{}: the scene has none", what));
}

}  // namespace

ScenePlan make_plan(const Scene& scene, const Lights& lights) {
    ScenePlan plan;
    note(plan, scene.instances.size(), "instances",
         fmt::format(" of {} objects", scene.objects.size()));
    note(plan, lights.triangle_count(), "area lights", " triangles");
    note(plan, count_lights(scene, LightKind::point), "point lights", "");
    note(plan, count_lights(scene, LightKind::spot), "spot lights", "");
    note(plan, count_lights(scene, LightKind::directional), "directional lights", "");
    note(plan, scene.textures.size(), "textures", "");
    const auto mirrors = count_materials(
        scene, [](const Material& m) { return is_mirror(m.metallic, m.roughness); });
    note(plan, mirrors, "mirrors", " materials");

    const auto glossy = count_materials(scene, [](const Material& m) {
        return !is_mirror(m.metallic, m.roughness) && (m.metallic > 0 || m.roughness < 1);
    });
    if (glossy > 0)
        plan.left_out.push_back(
            fmt::format("glossy reflection: {} materials modelled as Lambert", glossy));
    if (mirrors > 0)
        plan.left_out.push_back(
            "caustics: light that mirrors throw on surfaces is missing from igi; path has it");
    if (lights.empty()) plan.left_out.push_back("light: nothing emits, the picture will be black");
    return plan;
}

}  // namespace tessera
