#include "worker/light_paths.h"

namespace tessera {
namespace {

/// Shading normals make the light that a particle carries differ from what it carries along the
/// geometry (Veach 1997, 5.3); the correction is bounded because it grows without limit where light
/// grazes the triangle.
constexpr float most_correction = 4;

float shading_correction(const SurfacePoint& s) {
    return std::min(dot(s.n, s.wo) / dot(s.ng, s.wo), most_correction);
}

/// Position on a Morton curve through the cube `bounds`.
std::uint32_t morton(const vec3& p, const Box& bounds) {
    const vec3 extent = glm::max(bounds.extent(), vec3(1e-20f));
    const vec3 unit = glm::clamp((p - bounds.lo) / extent, 0.0f, 1.0f);
    std::uint32_t code = 0;
    for (int axis = 0; axis < 3; ++axis) {
        const auto cell = std::uint32_t(unit[axis] * 1023);
        for (int bit = 0; bit < 10; ++bit) code |= (cell >> bit & 1) << (3 * bit + axis);
    }
    return code;
}

void sort_along_curve(std::vector<Vpl>& vpls, const Box& bounds) {
    std::vector<std::pair<std::uint32_t, std::uint32_t>> order;
    for (std::uint32_t i = 0; i < vpls.size(); ++i)
        order.emplace_back(morton(vpls[i].org, bounds), i);
    std::sort(order.begin(), order.end());
    std::vector<Vpl> sorted;
    for (const auto& [code, i] : order) sorted.push_back(vpls[i]);
    vpls = std::move(sorted);
}

/// Unoccluded contribution of each VPL to what the eye sees, by tracing it to all pilots.
std::vector<float> contributions(const World& world, std::span<const Vpl> vpls,
                                 std::span<const Receiver> pilots, float max_geometry) {
    std::vector<float> sums(vpls.size());
    std::vector<Ray> rays;
    std::vector<float> weights;
    std::vector<std::uint8_t> blocked;
    for (std::size_t v = 0; v < vpls.size(); ++v) {
        rays.clear();
        weights.clear();
        for (const Receiver& r : pilots) {
            const vec3 e = irradiance(r.surface, vpls[v], max_geometry);
            const float weight = mean_component(e * r.surface.bsdf.reflectance());
            if (!(weight > 0)) continue;
            rays.push_back({vpls[v].org, 0, r.surface.org - vpls[v].org, 1});
            weights.push_back(weight);
        }
        blocked.resize(rays.size());
        world.tracer.occluded(rays, blocked);
        for (std::size_t i = 0; i < rays.size(); ++i)
            if (!blocked[i]) sums[v] += weights[i];
    }
    return sums;
}

float sum(std::span<const float> values) {
    float total = 0;
    for (const float v : values) total += v;
    return total;
}

/// Chances of being taken: by contribution, and for a share by power, so that no light is lost that
/// the pilots happen to miss.
Distribution choice_among(std::span<const Vpl> vpls, std::span<const float> contribution) {
    constexpr float defensive = 0.1f;
    std::vector<float> power;
    for (const Vpl& vpl : vpls) power.push_back(mean_component(vpl.intensity));
    const float all_power = std::max(sum(power), 1e-30f);
    const float all_contribution = sum(contribution);
    std::vector<float> chance;
    for (std::size_t i = 0; i < vpls.size(); ++i)
        chance.push_back(
            defensive * power[i] / all_power +
            (all_contribution > 0 ? (1 - defensive) * contribution[i] / all_contribution : 0));
    return Distribution(chance);
}

/// A light path under way.
struct Walk {
    Sampler sampler;
    Ray ray;
    vec3 flux{0};
    std::uint32_t bounces = 0;
    std::uint32_t mirrors = 0;
    std::uint32_t light = 0;  ///< where it began, where lights are tracked
};

Walk start_walk(const World& world, Sampler sampler) {
    const float u_light = sampler.next().x;
    const vec2 u_place = sampler.next();
    const EmissionSample e = world.lights.sample_emission(u_light, u_place, sampler.next());
    return {sampler, e.ray, e.flux};
}

/// Each light's paths are points of a sequence of its own, so that they stay where they are when
/// others get more or fewer.
Walk start_walk_of(const World& world, const Lights::PathStart& start, std::uint32_t seed,
                   std::uint32_t round) {
    Sampler sampler(start.number, hash(seed, start.index), round);
    const float u_side = sampler.next().x;
    const vec2 u_place = sampler.next();
    const EmissionSample e =
        world.lights.sample_emission_of(start.index, u_side, u_place, sampler.next());
    return {.sampler = sampler, .ray = e.ray, .flux = e.flux, .light = start.index};
}

std::vector<Walk> start_walks(const World& world, const LightPaths& paths) {
    std::vector<Walk> walks;
    walks.reserve(paths.count);
    if (!world.lights.is_tracked()) {
        for (std::uint32_t i = 0; i < paths.count; ++i)
            walks.push_back(start_walk(world, Sampler(paths.round * paths.count + i, paths.seed)));
        return walks;
    }
    const float u = sobol_point(paths.round, 0, hash(paths.seed, 0xd3)).x;
    for (const Lights::PathStart& start : world.lights.deal_paths(paths.count, u))
        walks.push_back(start_walk_of(world, start, paths.seed, paths.round));
    return walks;
}

/// Where a walk goes on by all but ideal lobes, and with what flux.
struct Leaving {
    vec3 dir{0};
    vec3 flux{0};
};

std::optional<Leaving> next_direction(const SurfacePoint& s, Walk& walk) {
    const vec2 u_dir = walk.sampler.next();
    const float correction = shading_correction(s);
    if (s.bsdf.is_lambert())
        return Leaving{Frame(s.ng).world_from_local(sample_cosine_hemisphere(u_dir)),
                       walk.flux * s.bsdf.diffuse * correction};
    const auto scattered = sample(s.bsdf, s.n, s.wo, walk.sampler.next().x, u_dir);
    if (!scattered || !(dot(scattered->wi, s.ng) > 0)) return {};
    // sample() weighs by the cosine to the shading normal, flux goes by the triangle's.
    const float cosines = dot(scattered->wi, s.ng) / dot(scattered->wi, s.n);
    return Leaving{scattered->wi,
                   walk.flux * scattered->weight * std::min(correction * cosines, most_correction)};
}

/// Leaves a VPL at a surface that scatters and sends the walk on; false when it ends.
bool scatter(const SurfacePoint& s, std::uint32_t bounces, Walk& walk, std::vector<Vpl>& vpls) {
    if (walk.bounces++ >= bounces) return false;
    const vec3 leaving = walk.flux * s.bsdf.reflectance() * shading_correction(s);
    if (max_component(leaving) > 0 && is_finite(leaving)) {
        vpls.push_back({s.org, s.ng, leaving / pi, walk.bounces, s.n, s.wo, s.bsdf, walk.light});
    } else if (!s.bsdf.has_narrow()) {
        return false;
    }
    const auto next = next_direction(s, walk);
    if (!next || !(max_component(next->flux) > 0) || !is_finite(next->flux)) return false;
    const float survival = std::min(max_component(next->flux) / max_component(walk.flux), 1.0f);
    if (!(walk.sampler.next().x < survival)) return false;
    walk.flux = next->flux / survival;
    walk.mirrors = 0;
    walk.ray = {s.org, 0, next->dir, infinity};
    return true;
}

}  // namespace

std::vector<Vpl> walk_light_paths(const World& world, const LightPaths& paths,
                                  std::uint64_t& rays_traced) {
    std::vector<Vpl> vpls;
    if (world.lights.empty() || paths.bounces == 0) return vpls;
    std::vector<Walk> walks = start_walks(world, paths);

    // All walks take one step at a time, so that rays are traced in batches.
    std::vector<Ray> rays;
    std::vector<Hit> hits;
    while (!walks.empty()) {
        rays.clear();
        for (const Walk& walk : walks) rays.push_back(walk.ray);
        hits.resize(rays.size());
        world.tracer.closest_hits(rays, hits);
        rays_traced += rays.size();
        std::size_t kept = 0;
        for (std::size_t i = 0; i < rays.size(); ++i) {
            if (!hits[i].valid()) continue;
            Walk walk = walks[i];
            const SurfacePoint s = world.surfaces.at(rays[i], hits[i]);
            const bool goes_on =
                meets_delta(s.bsdf, walk.sampler, walk.flux)
                    ? pass_delta(s, Carries::flux, walk.sampler, walk.flux, walk.ray) &&
                          ++walk.mirrors <= max_mirrors
                    : scatter(s, paths.bounces, walk, vpls);
            if (goes_on) walks[kept++] = walk;
        }
        walks.erase(walks.begin() + std::ptrdiff_t(kept), walks.end());
    }
    return vpls;
}

vec3 irradiance(const SurfacePoint& s, const Vpl& vpl, float max_geometry) {
    const vec3 to = vpl.org - s.org;
    const float cos_vpl = -dot(vpl.ng, to);
    const float cos_surface = dot(s.n, to);
    if (!(cos_vpl > 0 && cos_surface > 0 && dot(s.ng, to) > 0)) return vec3(0);
    const float d2 = dot(to, to);
    const vec3 e = vpl.intensity * std::min(cos_vpl * cos_surface / (d2 * d2), max_geometry);
    if (!s.bsdf.glossy && !vpl.bsdf.glossy) return e;
    const vec3 wi = to / std::sqrt(d2);
    return e * shape(s.bsdf, s.n, s.wo, wi) * shape(vpl.bsdf, vpl.n, vpl.wo, -wi);
}

std::uint32_t count_light_paths(const World& world, const VplConfig& config) {
    constexpr std::uint32_t tried = 256;
    std::uint64_t rays = 0;
    const std::size_t made =
        walk_light_paths(
            world, {.count = tried, .bounces = config.bounces, .seed = hash(config.seed, 0xc0)},
            rays)
            .size();
    const std::uint64_t wanted =
        std::uint64_t(candidates_per_vpl) * config.interleave * config.interleave * config.vpls;
    return std::uint32_t(std::clamp<std::uint64_t>(wanted * tried / std::max<std::size_t>(made, 1),
                                                   1, 8 * wanted + 1));
}

VplSets make_vpl_sets(const World& world, const VplConfig& config, std::uint32_t pass,
                      std::span<const Receiver> pilots) {
    const std::uint32_t n = config.interleave;
    const std::uint32_t set_count = n * n;
    // Passes spread evenly over the shifts of the grid and of the choice.
    Sampler sampler(pass, hash(config.seed, 0xd1));
    VplSets sets;
    sets.offset = ivec2(sampler.next() * float(n));
    sets.first.assign(set_count + 1, 0);

    // Walk more paths than needed; passes continue one sequence.
    std::vector<Vpl> all = walk_light_paths(world,
                                            {.round = pass,
                                             .count = config.paths,
                                             .bounces = config.bounces,
                                             .seed = hash(config.seed, 0xd2)},
                                            sets.rays);
    sort_along_curve(all, world.tracer.bounds());
    const auto contribution = contributions(world, all, pilots, config.max_geometry);
    sets.rays += all.size() * pilots.size();
    const Distribution choice = choice_among(all, contribution);
    if (choice.empty()) return sets;

    // Take VPLs at equal steps along the curve and deal them out to the sets in turn.
    const std::uint32_t total = set_count * config.vpls;
    const float u = sampler.next().x;
    std::vector<Vpl> taken;
    for (std::uint32_t i = 0; i < total; ++i) {
        const auto chosen = choice.sample((float(i) + u) / float(total));
        taken.push_back(all[chosen.index]);
        taken.back().intensity /= chosen.probability * float(config.paths) * float(config.vpls);
    }
    for (std::uint32_t set = 0; set < set_count; ++set) {
        for (std::uint32_t i = set; i < total; i += set_count) sets.vpls.push_back(taken[i]);
        sets.first[set + 1] = std::uint32_t(sets.vpls.size());
    }
    return sets;
}

}  // namespace tessera
