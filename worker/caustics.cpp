#include "worker/caustics.h"

#include <algorithm>
#include <cmath>

namespace tessera {
namespace {

/// Photons are aimed at so many spheres at most; where there are more surfaces, at one around all.
constexpr std::size_t most_targets = 16;

/// Of the radius' decrease (Knaus and Zwicker 2011): 2/3 makes the mean squared error shrink
/// fastest.
constexpr double alpha = 2.0 / 3;

/// Photons of a plan, and the neighbours that a search shall find in the first pass.
constexpr std::uint32_t tried = 4096;
constexpr std::size_t wanted_neighbours = 16;

/// Bound of corrections for shading normals, which grow without limit where light grazes.
constexpr float most_correction = 4;

float solid_angle(const vec3& from, const vec3& centre, float radius) {
    const vec3 to = centre - from;
    const float d2 = dot(to, to), r2 = radius * radius;
    if (!(d2 > r2)) return 4 * pi;
    // 1 - cos without losing digits.
    return 2 * pi * (r2 / d2) / (1 + std::sqrt(1 - r2 / d2));
}

float spot_share(const Light& light, const vec3& dir) {
    return light.kind == LightKind::spot ? spot_falloff(light, dot(dir, light.direction)) : 1;
}

/// A photon under way.
struct Flight {
    Sampler sampler;
    Ray ray;
    vec3 flux{0};
    std::uint32_t mirrors = 0;
};

/// What an ideal surface does to a photon's flux where its normal is not the triangle's (Veach
/// 1997, 5.3.2).
float ideal_correction(const SurfacePoint& s, const vec3& out) {
    const float in = dot(s.n, s.wo) / dot(s.ng, s.wo);
    const float from = std::abs(dot(s.ng, out) / dot(s.n, out));
    return std::min(in * from, most_correction);
}

}  // namespace

float photon_correction(const SurfacePoint& s, const vec3& wi) {
    return std::min(dot(s.n, wi) / dot(s.ng, wi), most_correction);
}

// ---- PhotonMap ----------------------------------------------------------------------------------

PhotonMap::PhotonMap(std::vector<Photon> photons, float radius)
    : radius_(radius), cell_(2 * radius) {
    // About as many buckets as photons, a power of two.
    std::uint32_t buckets = 1;
    while (buckets < photons.size()) buckets *= 2;
    first_.assign(buckets + 1, 0);
    std::vector<std::uint32_t> bucket;
    for (const Photon& photon : photons) {
        bucket.push_back(bucket_of(cell_of(photon.p)));
        ++first_[bucket.back()];
    }
    std::uint32_t end = 0;
    for (std::uint32_t& first : first_) first = end += first;
    photons_.resize(photons.size());
    for (std::size_t i = photons.size(); i-- > 0;) photons_[--first_[bucket[i]]] = photons[i];
}

PhotonMap::Cell PhotonMap::cell_of(const vec3& p) const {
    constexpr float limit = 0x1p30f;
    return Cell(glm::clamp(glm::floor(p / cell_), -limit, limit));
}

std::uint32_t PhotonMap::bucket_of(const Cell& cell) const {
    const auto buckets = std::uint32_t(first_.size() - 1);
    return hash(hash(std::uint32_t(cell.x), std::uint32_t(cell.y)), std::uint32_t(cell.z)) &
           (buckets - 1);
}

// ---- Caustics -----------------------------------------------------------------------------------

Caustics::Caustics(const Surfaces& surfaces)
    : surfaces_(&surfaces), by_photons_(surfaces.instance_count(), 0) {
    find_targets();
    if (targets_.empty()) return;
    add_punctual();
    punctual_count_ = all_.size();
    punctual_ = all_;
    add_lamps();
    weigh(punctual_);
    weigh(all_);
}

void Caustics::find_targets() {
    const std::vector<Material>& materials = surfaces_->scene().materials;
    if (std::ranges::none_of(materials,
                             [&](const Material& m) { return surfaces_->may_be_ideal(m); }))
        return;
    for (std::uint32_t i = 0; i < surfaces_->instance_count(); ++i) add_targets(i);
    if (targets_.size() <= most_targets) return;
    Box all;
    for (const Sphere& s : targets_) {
        all.add(s.centre - s.radius);
        all.add(s.centre + s.radius);
    }
    targets_ = {{0.5f * (all.lo + all.hi), 0.5f * length(all.extent())}};
}

/// A sphere around the ideal surfaces of each material of the instance.
void Caustics::add_targets(std::uint32_t instance) {
    std::vector<std::pair<const Material*, Box>> boxes;
    const Object& object = surfaces_->scene().objects[surfaces_->object_of(instance)];
    for (const std::uint32_t m : object.materials) {
        const Material& material = surfaces_->scene().materials[m];
        if (surfaces_->may_be_ideal(material)) boxes.push_back({&material, {}});
    }
    if (boxes.empty()) return;
    for (std::uint32_t t = 0; t < surfaces_->triangle_count(instance); ++t) {
        const auto found = std::ranges::find(boxes, &surfaces_->material(instance, t),
                                             [](const auto& entry) { return entry.first; });
        if (found == boxes.end()) continue;
        const WorldTriangle shape = surfaces_->triangle(instance, t);
        for (const vec3& p : {shape.p0, shape.p1, shape.p2})
            if (is_finite(p)) found->second.add(p);
    }
    for (const auto& [material, box] : boxes)
        if (!box.empty() && length(box.extent()) > 0)
            targets_.push_back({0.5f * (box.lo + box.hi), 0.5001f * length(box.extent())});
}

void Caustics::add_punctual() {
    const std::vector<Light>& lights = surfaces_->scene().lights;
    for (std::size_t i = 0; i < lights.size(); ++i)
        if (max_component(lights[i].intensity) > 0)
            all_.list.push_back({.light = std::int32_t(i), .shape = {}});
}

/// Rays from a surface find large lamps well and give no blur; photons want them small. As large as
/// the ideal surfaces' shadow is where they take turns.
void Caustics::add_lamps() {
    float shadow = 0;
    for (const Sphere& s : targets_) shadow += pi * s.radius * s.radius;
    for (std::uint32_t i = 0; i < surfaces_->instance_count(); ++i) {
        if (!surfaces_->emits(i)) continue;
        std::vector<Source> triangles;
        float area = 0;
        for (std::uint32_t t = 0; t < surfaces_->triangle_count(i); ++t) {
            const Material& m = surfaces_->material(i, t);
            if (!(max_component(m.emission) > 0)) continue;
            Source source{.instance = i,
                          .triangle = t,
                          .two_sided = m.two_sided_emission,
                          .shape = surfaces_->triangle(i, t)};
            source.area = source.shape.area();
            if (!(source.area > 0) || !std::isfinite(source.area)) continue;
            area += source.area;
            triangles.push_back(source);
        }
        if (triangles.empty() || area > shadow) continue;
        by_photons_[i] = 1;
        lamp_count_ += triangles.size();
        all_.list.insert(all_.list.end(), triangles.begin(), triangles.end());
    }
}

void Caustics::weigh(Sources& sources) const {
    std::vector<float> powers;
    for (const Source& source : sources.list) powers.push_back(power_towards_targets(source));
    sources.choice = Distribution(powers);
}

float Caustics::power_towards_targets(const Source& source) const {
    const auto angle_from = [&](const vec3& p) {
        float sum = 0;
        for (const Sphere& s : targets_) sum += solid_angle(p, s.centre, s.radius);
        return sum;
    };
    if (source.light < 0) {
        const Material& m = surfaces_->material(source.instance, source.triangle);
        // Never nothing, for textures that are dark in the mean.
        const float radiance =
            mean_component(surfaces_->mean_emission(m)) + 1e-3f * mean_component(m.emission);
        return radiance * source.area * angle_from(source.shape.point(vec2(1.0f / 3)));
    }
    const Light& light = surfaces_->scene().lights[std::size_t(source.light)];
    const float intensity = mean_component(light.intensity);
    if (light.kind != LightKind::directional) return intensity * angle_from(light.position);
    float area = 0;
    for (const Sphere& s : targets_) area += pi * s.radius * s.radius;
    return intensity * area;
}

/// A target by its solid angle, a direction in its cone; the density is that of all cones.
Caustics::Aimed Caustics::aim(const vec3& from, float u_target, const vec2& u) const {
    float angles[most_targets];
    float sum = 0;
    for (std::size_t i = 0; i < targets_.size(); ++i)
        sum += angles[i] = solid_angle(from, targets_[i].centre, targets_[i].radius);
    std::size_t chosen = 0;
    float at = u_target * sum;
    while (chosen + 1 < targets_.size() && at >= angles[chosen]) at -= angles[chosen++];
    const auto cos_of = [&](std::size_t i) { return 1 - angles[i] / (2 * pi); };
    const auto axis_of = [&](std::size_t i) {
        const vec3 to = targets_[i].centre - from;
        return dot(to, to) > 0 ? normalize(to) : vec3(0, 0, 1);
    };
    Aimed aimed;
    aimed.dir = Frame(axis_of(chosen)).world_from_local(sample_cone(u, cos_of(chosen)));
    int hits = 1;
    for (std::size_t i = 0; i < targets_.size(); ++i)
        if (i != chosen && dot(aimed.dir, axis_of(i)) >= cos_of(i)) ++hits;
    aimed.pdf = float(hits) / sum;
    return aimed;
}

std::optional<EmissionSample> Caustics::emit_directional(const Light& light, float u_target,
                                                         const vec2& u) const {
    float sum = 0;
    for (const Sphere& s : targets_) sum += s.radius * s.radius;
    std::size_t chosen = 0;
    float at = u_target * sum;
    const auto square = [&](std::size_t i) { return targets_[i].radius * targets_[i].radius; };
    while (chosen + 1 < targets_.size() && at >= square(chosen)) at -= square(chosen++);
    const Frame frame(light.direction);
    const vec2 d = targets_[chosen].radius * sample_disc(u);
    const vec3 through = targets_[chosen].centre + d.x * frame.s + d.y * frame.t;
    int hits = 1;
    for (std::size_t i = 0; i < targets_.size(); ++i) {
        const vec3 off = cross(through - targets_[i].centre, light.direction);
        if (i != chosen && dot(off, off) < square(i)) ++hits;
    }
    const float back = 2 * length(surfaces_->bounds().extent());
    return EmissionSample{{through - back * light.direction, 0, light.direction, infinity},
                          light.intensity * (pi * sum / float(hits))};
}

std::optional<EmissionSample> Caustics::emit(const Source& source, const vec2& u_place,
                                             float u_target, const vec2& u_dir) const {
    if (source.light < 0) {
        const vec2 b = sample_triangle(u_place);
        const vec3 p = source.shape.point(b);
        const Aimed aimed = aim(p, u_target, u_dir);
        const float cosine = dot(aimed.dir, source.shape.ng);
        if (!(cosine > 0 || (source.two_sided && cosine < 0))) return {};
        const vec3 off = source.shape.off_front();
        const vec3 radiance = surfaces_->emission(source.instance, source.triangle, b);
        return EmissionSample{{cosine > 0 ? p + off : p - off, 0, aimed.dir, infinity},
                              radiance * (std::abs(cosine) * source.area / aimed.pdf)};
    }
    const Light& light = surfaces_->scene().lights[std::size_t(source.light)];
    if (light.kind == LightKind::directional) return emit_directional(light, u_target, u_dir);
    const Aimed aimed = aim(light.position, u_target, u_dir);
    return EmissionSample{{light.position, 0, aimed.dir, infinity},
                          light.intensity * (spot_share(light, aimed.dir) / aimed.pdf)};
}

std::vector<Photon> Caustics::trace(const World& world, Integrator integrator, std::uint32_t first,
                                    std::uint32_t count, std::uint32_t seed,
                                    std::uint64_t& rays_traced) const {
    std::vector<Photon> photons;
    const Sources& sources = sources_of(integrator);
    if (sources.choice.empty()) return photons;
    std::vector<Flight> flights;
    for (std::uint32_t i = 0; i < count; ++i) {
        Flight flight{.sampler = Sampler(first + i, seed), .ray = {}};
        const vec2 u_choice = flight.sampler.next();
        const vec2 u_place = flight.sampler.next();
        const auto chosen = sources.choice.sample(u_choice.x);
        const auto e = emit(sources.list[chosen.index], u_place, u_choice.y, flight.sampler.next());
        if (!e || !(max_component(e->flux) > 0)) continue;
        flight.ray = e->ray;
        flight.flux = e->flux / chosen.probability;
        flights.push_back(flight);
    }

    // All photons take one step at a time, so that rays are traced in batches.
    std::vector<Ray> rays;
    std::vector<Hit> hits;
    TriangleCache cache;
    while (!flights.empty()) {
        rays.clear();
        for (const Flight& flight : flights) rays.push_back(flight.ray);
        hits.resize(rays.size());
        world.tracer.closest_hits(rays, hits);
        rays_traced += rays.size();
        std::size_t kept = 0;
        for (std::size_t i = 0; i < rays.size(); ++i) {
            if (!hits[i].valid()) continue;
            Flight flight = flights[i];
            SurfacePoint s;
            world.surfaces.find(rays[i], hits[i], cache, s);
            if (!meets_delta(s.bsdf, flight.sampler, flight.flux)) {
                if (flight.mirrors > 0 && is_finite(flight.flux))
                    photons.push_back({s.p, s.ng, s.wo, flight.flux});
                continue;
            }
            if (++flight.mirrors > max_mirrors ||
                !pass_delta(s, Carries::flux, flight.sampler, flight.flux, flight.ray))
                continue;
            flight.flux *= ideal_correction(s, flight.ray.dir);
            if (max_component(flight.flux) > 0) flights[kept++] = flight;
        }
        flights.erase(flights.begin() + std::ptrdiff_t(kept), flights.end());
    }
    return photons;
}

// ---- passes -------------------------------------------------------------------------------------

float radius_share(std::uint32_t pass) {
    double square = 1;
    for (std::uint32_t k = 1; k <= pass; ++k) square *= (k + alpha) / (k + 1.0);
    return float(std::sqrt(square));
}

PhotonConfig plan_photons(const World& world, const Caustics& caustics, Integrator integrator,
                          ImageSize size, std::uint32_t seed) {
    if (!caustics.wanted(integrator)) return {};
    PhotonConfig config{.integrator = integrator,
                        .count = std::clamp(std::uint32_t(size.pixels() / 8), 4096u, 65536u),
                        .seed = hash(seed, 0xe1)};
    std::uint64_t rays = 0;
    const std::vector<Photon> photons =
        caustics.trace(world, integrator, 0, tried, config.seed, rays);
    if (photons.empty()) return {};

    // The median, over some photons, of the distance within which a pass has so many of them.
    std::vector<float> distances;
    std::vector<float> squares(photons.size());
    const std::size_t step = std::max<std::size_t>(photons.size() / 64, 1);
    const std::size_t rank = std::min(photons.size() - 1, wanted_neighbours);
    for (std::size_t i = 0; i < photons.size(); i += step) {
        for (std::size_t k = 0; k < photons.size(); ++k) {
            const vec3 d = photons[k].p - photons[i].p;
            squares[k] = dot(d, d);
        }
        std::ranges::nth_element(squares, squares.begin() + std::ptrdiff_t(rank));
        distances.push_back(std::sqrt(squares[rank] * float(tried) / float(config.count)));
    }
    std::ranges::nth_element(distances, distances.begin() + std::ptrdiff_t(distances.size() / 2));
    const float whole = length(world.surfaces.bounds().extent());
    config.radius = std::clamp(distances[distances.size() / 2], 1e-4f * whole, 0.02f * whole);
    return config;
}

PhotonMap make_photon_map(const World& world, const Caustics& caustics, const PhotonConfig& config,
                          std::uint32_t pass, std::uint64_t& rays) {
    std::vector<Photon> photons = caustics.trace(world, config.integrator, pass * config.count,
                                                 config.count, config.seed, rays);
    for (Photon& photon : photons) photon.flux /= float(config.count);
    return {std::move(photons), config.radius * radius_share(pass)};
}

}  // namespace tessera
