#include "worker/plan.h"

#include <fmt/format.h>

#include <algorithm>

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

bool is_glossy(const Material& m) {
    return !is_mirror(m.metallic, m.roughness) && (m.metallic > 0 || m.specular > 0);
}

void note_gloss(ScenePlan& plan, const Scene& scene, const Surfaces& surfaces) {
    const auto glossy = count_materials(scene, is_glossy);
    const auto narrow = count_materials(
        scene, [&](const Material& m) { return is_glossy(m) && surfaces.has_rest(m); });
    note(plan, glossy, "glossy reflection",
         fmt::format(" materials (GGX), {} of them narrow enough to be traced by rays of their own",
                     narrow));
    if (glossy > 0)
        plan.left_out.push_back(
            "light reflected more than once between microfacets: rough metal is a little dark");
}

void note_glass(ScenePlan& plan, const Scene& scene) {
    const auto glass = count_materials(scene, [](const Material& m) { return m.transmission > 0; });
    note(plan, glass, "glass", " materials");
    const auto frosted = count_materials(
        scene, [](const Material& m) { return m.transmission > 0 && m.roughness > 0; });
    note(plan, frosted, "rough glass", " materials (GGX); light between their microfacets is lost");
    if (glass > 0)
        plan.left_out.push_back(
            "shadow rays through glass: it blocks them; light that passes comes by photons, and by "
            "scattered rays that hit lamps");
}

void note_photons(ScenePlan& plan, const Caustics& caustics) {
    if (caustics.wanted(Integrator::igi))
        plan.modelled.push_back(fmt::format(
            "photons: aimed at mirrors and glass in {} places, from {} lights without size, and in "
            "igi from {} triangles of small lamps",
            caustics.target_count(), caustics.punctual_count(), caustics.lamp_count()));
    else
        plan.left_out.push_back(caustics.target_count() == 0
                                    ? "photons: the scene has neither mirrors nor glass"
                                    : "photons: all lamps are large beside the mirrors and glass");
}

void note_alpha(ScenePlan& plan, const Scene& scene) {
    const auto holes =
        count_materials(scene, [](const Material& m) { return m.alpha_mode != AlphaMode::opaque; });
    const auto blended =
        count_materials(scene, [](const Material& m) { return m.alpha_mode == AlphaMode::blend; });
    note(plan, holes, "surfaces with holes",
         fmt::format(" materials, past which rays are traced again; of {} each ray meets a share",
                     blended));
}

/// Values beyond what surfaces can do are clamped: say so.
void note_clamped(ScenePlan& plan, const Scene& scene) {
    const auto bright = count_materials(scene, [](const Material& m) {
        return max_component(m.base_color) > 1 || m.base_color != glm::max(m.base_color, vec3(0));
    });
    if (bright > 0)
        plan.left_out.push_back(fmt::format(
            "reflectance below 0 or above 1: {} materials, clamped to that range", bright));
}

}  // namespace

ScenePlan make_plan(const Scene& scene, const Surfaces& surfaces, const Lights& lights,
                    const Caustics& caustics) {
    ScenePlan plan;
    note(plan, scene.instances.size(), "instances",
         fmt::format(" of {} objects", scene.objects.size()));
    note(plan, lights.triangle_count(), "area lights", " triangles");
    note(plan, count_lights(scene, LightKind::point), "point lights", "");
    note(plan, count_lights(scene, LightKind::spot), "spot lights", "");
    note(plan, count_lights(scene, LightKind::directional), "directional lights", "");
    note(plan, scene.textures.size(), "textures", "");
    if (surfaces.sanitised_texels() > 0)
        plan.left_out.push_back(fmt::format("{} texels that were negative or not finite: black",
                                            surfaces.sanitised_texels()));
    if (lights.has_tree())
        plan.modelled.push_back(
            fmt::format("many lights: {}, chosen from by a tree, and in igi by what the view gets "
                        "of each (light source tracking)",
                        lights.size()));
    else if (!lights.empty())
        plan.left_out.push_back(
            fmt::format("light source tracking: {} lights are few enough to be chosen by power",
                        lights.size()));
    note(plan, lights.sky().empty() ? 0 : 1, "environment",
         scene.environment.texture < 0 ? " colour" : " map");
    note(plan, count_materials(scene, [](const Material& m) { return m.normal_map.texture >= 0; }),
         "normal maps", " materials");
    note(plan, count_materials(scene, [](const Material& m) { return !m.shader.empty(); }),
         "material shaders", " materials, computed where the eye's rays and others hit");
    for (const std::string& complaint : surfaces.shader_complaints())
        plan.left_out.push_back(complaint);
    note_alpha(plan, scene);
    note(plan,
         count_materials(scene,
                         [](const Material& m) { return is_mirror(m.metallic, m.roughness); }),
         "mirrors", " materials");
    note_gloss(plan, scene, surfaces);
    note_glass(plan, scene);
    if (std::any_of(scene.materials.begin(), scene.materials.end(),
                    [&](const Material& m) { return surfaces.has_rest(m); }))
        plan.modelled.push_back(
            "caustics: by scattered rays that find mirrors, glass and narrow gloss, in igi as in "
            "path");
    note_photons(plan, caustics);
    note_clamped(plan, scene);
    if (lights.empty()) plan.left_out.push_back("light: nothing emits, the picture will be black");
    return plan;
}

}  // namespace tessera
