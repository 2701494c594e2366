#include "worker/lights.h"

namespace tessera {
namespace {

vec3 unit_direction(const Light& light) {
    return dot(light.direction, light.direction) > 0 ? normalize(light.direction) : vec3(0, 0, -1);
}

/// Mean radiance of a triangle from a fixed grid of places, never zero where the texture emits
/// anywhere, so that what the grid misses is still found.
vec3 mean_emission(const Surfaces& surfaces, std::uint32_t instance, std::uint32_t triangle) {
    const Material& m = surfaces.material(instance, triangle);
    const vec3 overall = surfaces.mean_emission(m);
    if (m.emission_map.texture < 0) return overall;
    constexpr int n = 4;
    vec3 sum(0);
    for (int i = 0; i < n * n; ++i) {
        const vec2 u((float(i % n) + 0.5f) / n, (float(i / n) + 0.5f) / n);
        sum += surfaces.emission(instance, triangle, sample_triangle(u));
    }
    return 0.9f * sum / float(n * n) + 0.1f * overall;
}

/// More lights than these are chosen by a tree. A choice by power takes half the time, and where
/// there are so few, four candidates find what matters.
constexpr std::size_t most_chosen_by_power = 32;

/// Of choices by the tree, those that go to lights which are everywhere, if there are any and as
/// long as nothing is known about the view.
constexpr float usual_far_share = 0.5f;

/// Of choices among the near lights of a view, those that go to lights of which it seems to get
/// nothing.
constexpr float rest_share = 0.03f;
/// Of light paths, those that are dealt out by power alone.
constexpr float power_share = 0.1f;

/// Side by side in the tree; what is found of one counts for all, to a share.
constexpr std::size_t neighbours = 8;
constexpr float spread_share = 0.5f;
/// Lights that send less of all light are not active.
constexpr float least_active = 1e-5f;

constexpr std::uint32_t not_active = ~0u;

float sum(std::span<const float> values) {
    double total = 0;
    for (const float v : values) total += double(v);
    return float(total);
}

}  // namespace

Ray shadow_ray(const SurfacePoint& s, const LightSample& light) {
    if (light.distance == infinity) return {s.org, 0, light.wi, infinity};
    return {s.org, 0, light.end - s.org, 1};
}

float spot_falloff(const Light& light, float cosine) {
    const float cos_outer = std::cos(light.outer_angle);
    const float scale = 1 / std::max(0.001f, std::cos(light.inner_angle) - cos_outer);
    const float falloff = std::clamp((cosine - cos_outer) * scale, 0.0f, 1.0f);
    return falloff * falloff;
}

Lights::Lights(const Surfaces& surfaces, const Box& bounds)
    : surfaces_(&surfaces), punctual_(surfaces.scene().lights), sky_(surfaces.sky()) {
    if (!bounds.empty()) {
        centre_ = bounds.centre();
        radius_ = std::max(0.5f * length(bounds.extent()), 1e-20f);
    }
    for (Light& light : punctual_) light.direction = unit_direction(light);
    std::vector<float> powers;
    for (std::uint32_t i = 0; i < surfaces.instance_count(); ++i) add_triangles(i, powers);
    first_of_instance_.push_back(std::uint32_t(triangles_.size()));
    for (const Light& light : punctual_) powers.push_back(power(light));
    // All that falls through the surface of the bounding sphere.
    if (!sky_->empty()) powers.push_back(pi * radius_ * radius_ * sky_->mean_irradiance());
    choice_ = Distribution(powers);
    if (powers.size() > most_chosen_by_power)
        build_tree(powers);
    else
        list_lamps();
}

void Lights::list_lamps() {
    const bool all_plain = std::none_of(triangles_.begin(), triangles_.end(),
                                        [](const TriangleLight& l) { return l.textured; });
    if (empty() || !all_plain || triangles_.size() < size()) return;
    lamps_.cumulative.push_back(0);
    for (std::uint32_t i = 0; i < triangles_.size(); ++i) {
        const TriangleLight& l = triangles_[i];
        lamps_.lamps.push_back({l.shape.p0, l.shape.p1, l.shape.p2, l.shape.ng, l.off_front,
                                l.radiance, l.area, l.two_sided ? 1.0f : 0.0f,
                                choice_.probability(i)});
        lamps_.cumulative.push_back(choice_.cumulative()[i + 1]);
    }
}

bool Lights::is_far(std::uint32_t index) const {
    const std::size_t punctual = index - triangles_.size();
    return index >= triangles_.size() &&
           (punctual == punctual_.size() || punctual_[punctual].kind == LightKind::directional);
}

void Lights::build_tree(std::span<const float> powers) {
    const auto usable = [](float w) { return std::isfinite(w) && w > 0 ? w : 0.0f; };
    std::vector<LightBounds> near(powers.size());
    std::vector<float> far(powers.size());
    for (std::uint32_t i = 0; i < powers.size(); ++i) {
        LightBounds& b = near[i];
        if (is_far(i)) {
            far[i] = powers[i];
            b.box.add(centre_);
        } else if (i < triangles_.size()) {
            const TriangleLight& light = triangles_[i];
            for (const vec3& p : {light.shape.p0, light.shape.p1, light.shape.p2}) b.box.add(p);
            b.axis = light.shape.ng;
            b.cos_spread = light.two_sided ? -1.0f : 1.0f;
            b.power = usable(powers[i]);
        } else {
            b.box.add(punctual_[i - triangles_.size()].position);
            b.cos_spread = -1;
            b.power = usable(powers[i]);
        }
    }
    tree_ = LightTree(near);
    far_ = Distribution(far);
    far_share_ = far_.empty() ? 0 : usual_far_share;
}

/// Neighbours stand in for each other where few have been asked.
LightEstimates Lights::spread(const LightEstimates& estimates) const {
    LightEstimates out = estimates;
    const std::vector<std::uint32_t> order = tree_.order();
    for (std::size_t first = 0; first < order.size(); first += neighbours) {
        const std::size_t end = std::min(first + neighbours, order.size());
        float power = 0, direct = 0, indirect = 0;
        for (std::size_t k = first; k < end; ++k) {
            power += tree_.bounds(order[k]).power;
            direct += estimates.direct[order[k]];
            indirect += estimates.indirect[order[k]];
        }
        if (!(power > 0)) continue;
        for (std::size_t k = first; k < end; ++k) {
            const float share = spread_share * tree_.bounds(order[k]).power / power;
            float& d = out.direct[order[k]];
            float& i = out.indirect[order[k]];
            d = (1 - spread_share) * d + share * direct;
            i = (1 - spread_share) * i + share * indirect;
        }
    }
    return out;
}

Lights Lights::tracked(const LightEstimates& found) const {
    const LightEstimates estimates = spread(found);
    const float total = sum(estimates.direct) + sum(estimates.indirect);
    Lights out = *this;
    std::vector<LightBounds> bounds;
    float far = 0;
    out.place_in_active_.assign(size(), not_active);
    for (std::uint32_t i = 0; i < size(); ++i) {
        if (is_far(i)) {
            far += estimates.direct[i];
        } else if (estimates.direct[i] + estimates.indirect[i] > least_active * total) {
            out.place_in_active_[i] = std::uint32_t(bounds.size());
            out.active_.push_back(i);
            bounds.push_back(tree_.bounds(i));
        }
    }
    out.active_tree_ = LightTree(bounds);
    out.tree_ = tree_.without(out.active_);
    const float direct = sum(estimates.direct);
    if (!far_.empty() && direct > 0) out.far_share_ = std::clamp(far / direct, 0.05f, 0.9f);

    // Light paths: most by what comes of them.
    out.path_order_ = tree_.order();
    const float direct_too = 0.1f;
    const float all = sum(estimates.indirect) + direct_too * direct;
    std::vector<float> shares;
    for (const std::uint32_t i : out.path_order_) {
        const float seen = estimates.indirect[i] + direct_too * estimates.direct[i];
        shares.push_back(power_share * choice_.probability(i) +
                         (all > 0 ? (1 - power_share) * seen / all : 0));
    }
    out.path_choice_ = Distribution(shares);
    out.path_chance_.resize(size());
    for (std::uint32_t k = 0; k < size(); ++k)
        out.path_chance_[out.path_order_[k]] = out.path_choice_.probability(k);
    return out;
}

/// A light taken with a probability.
struct Lights::Chosen {
    std::uint32_t index = 0;
    float probability = 0;
    bool unlikely = false;
};

std::optional<Lights::Chosen> Lights::choose_near(const vec3& p, float u) const {
    // A number at the end of the range goes to the rest: candidates begin to share at the front.
    const bool rest = active_.empty() || u >= 1 - rest_share;
    const float share = active_.empty() ? 1 : rest ? rest_share : 1 - rest_share;
    const float again = active_.empty() ? u : rest ? (u - (1 - rest_share)) / share : u / share;
    const auto choice = (rest ? tree_ : active_tree_).sample(p, std::min(again, 0x1.fffffep-1f));
    if (!choice) return {};
    return Chosen{rest ? choice->index : active_[choice->index], share * choice->probability,
                  rest && !active_.empty()};
}

float Lights::probability_near(const vec3& p, std::uint32_t index) const {
    if (active_.empty()) return tree_.probability(p, index);
    const std::uint32_t place = place_in_active_[index];
    return place == not_active ? rest_share * tree_.probability(p, index)
                               : (1 - rest_share) * active_tree_.probability(p, place);
}

std::optional<Lights::Chosen> Lights::choose(const vec3& p, float u) const {
    if (!tree_.empty() && far_share_ == 0) return choose_near(p, u);
    if (!tree_.empty() && u >= far_share_) {
        auto chosen = choose_near(p, (u - far_share_) / (1 - far_share_));
        if (chosen) chosen->probability *= 1 - far_share_;
        return chosen;
    }
    const auto choice = tree_.empty() ? choice_.sample(u) : far_.sample(u / far_share_);
    return Chosen{choice.index, choice.probability * (tree_.empty() ? 1 : far_share_)};
}

float Lights::probability(const vec3& p, std::uint32_t index) const {
    if (tree_.empty()) return choice_.probability(index);
    return is_far(index) ? far_share_ * far_.probability(index)
                         : (1 - far_share_) * probability_near(p, index);
}

void Lights::add_triangles(std::uint32_t instance, std::vector<float>& powers) {
    first_of_instance_.push_back(std::uint32_t(triangles_.size()));
    const auto emits = [&](std::uint32_t t) {
        return surfaces_->material(instance, t).emission != vec3(0);
    };
    if (!surfaces_->emits(instance)) return;
    for (std::uint32_t t = 0; t < surfaces_->triangle_count(instance); ++t) {
        if (!emits(t)) continue;
        const Material& m = surfaces_->material(instance, t);
        TriangleLight light{.instance = instance,
                            .triangle = t,
                            .two_sided = m.two_sided_emission,
                            .textured = m.emission_map.texture >= 0,
                            .shape = surfaces_->triangle(instance, t),
                            .radiance = mean_emission(*surfaces_, instance, t)};
        light.area = light.shape.area();
        light.off_front = light.shape.off_front();
        if (!(light.area > 0) || !std::isfinite(light.area)) continue;
        triangles_.push_back(light);
        powers.push_back(pi * light.area * mean_component(light.radiance) *
                         (light.two_sided ? 2.0f : 1.0f));
    }
}

vec3 Lights::radiance(const TriangleLight& light, const vec2& b) const {
    return light.textured ? surfaces_->emission(light.instance, light.triangle, b) : light.radiance;
}

float Lights::power(const Light& light) const {
    const float intensity = mean_component(light.intensity);
    switch (light.kind) {
        case LightKind::point:
            return 4 * pi * intensity;
        case LightKind::spot:
            return 2 * pi * intensity *
                   (1 - 0.5f * (std::cos(light.inner_angle) + std::cos(light.outer_angle)));
        case LightKind::directional:
            return pi * radius_ * radius_ * intensity;
    }
    return 0;
}

std::optional<LightSample> Lights::sample(const vec3& p, float u_light, const vec2& u) const {
    if (empty()) return {};
    const auto chosen = choose(p, u_light);
    if (!chosen) return {};
    const std::size_t punctual = chosen->index - triangles_.size();
    auto s = chosen->index < triangles_.size()
                 ? sample_triangle_light(triangles_[chosen->index], p, chosen->probability, u)
             : punctual < punctual_.size()
                 ? sample_punctual(punctual_[punctual], p, chosen->probability)
                 : sample_sky(chosen->probability, u);
    if (!s) return {};
    s->index = chosen->index;
    s->unlikely = chosen->unlikely;
    return s;
}

std::optional<LightSample> Lights::sample_sky(float probability, const vec2& u) const {
    const Sky::Direction d = sky_->sample(u);
    LightSample s;
    s.wi = d.dir;
    s.radiance = sky_->radiance(d.dir);
    s.pdf = probability * d.pdf;
    return s;
}

std::optional<LightSample> Lights::sample_triangle_light(const TriangleLight& light, const vec3& p,
                                                         float probability, const vec2& u) const {
    const WorldTriangle& t = light.shape;
    const vec2 b = sample_triangle(u);
    const vec3 point = t.point(b);
    const vec3 to = point - p;
    const float distance_squared = dot(to, to);
    LightSample s;
    s.distance = std::sqrt(distance_squared);
    s.wi = to / s.distance;
    const float front_cosine = -dot(t.ng, s.wi);
    const bool front = front_cosine > 0;
    const float cosine = light.two_sided ? std::abs(front_cosine) : front_cosine;
    if (!(distance_squared > 0 && cosine > 0)) return {};
    s.end = front ? point + light.off_front : point - light.off_front;
    s.radiance = radiance(light, b);
    s.pdf = probability * distance_squared / (light.area * cosine);
    return s;
}

std::optional<LightSample> Lights::sample_punctual(const Light& light, const vec3& p,
                                                   float probability) const {
    LightSample s;
    s.punctual = true;
    s.pdf = probability;
    if (light.kind == LightKind::directional) {
        s.wi = -light.direction;
        s.radiance = light.intensity;
        return s;
    }
    s.end = light.position;
    const vec3 to = light.position - p;
    const float distance_squared = dot(to, to);
    if (!(distance_squared > 0)) return {};
    s.distance = std::sqrt(distance_squared);
    s.wi = to / s.distance;
    const bool spot = light.kind == LightKind::spot;
    const float falloff = spot ? spot_falloff(light, -dot(s.wi, light.direction)) : 1;
    s.radiance = light.intensity * falloff / distance_squared;
    return s;
}

std::optional<std::uint32_t> Lights::light_of(const Hit& hit) const {
    const auto begin = triangles_.begin() + first_of_instance_[hit.instance];
    const auto end = triangles_.begin() + first_of_instance_[hit.instance + 1];
    const auto light = std::lower_bound(
        begin, end, hit.triangle,
        [](const TriangleLight& l, std::uint32_t triangle) { return l.triangle < triangle; });
    if (light == end || light->triangle != hit.triangle) return {};
    return std::uint32_t(light - triangles_.begin());
}

float Lights::pdf(const vec3& from, const Hit& hit, const SurfacePoint& s) const {
    const auto light = light_of(hit);
    if (empty() || !light) return 0;
    const vec3 to = s.p - from;
    const float cosine = std::abs(dot(s.ng, s.wo));
    return probability(from, *light) * dot(to, to) / (triangles_[*light].area * cosine);
}

float Lights::sky_pdf(const vec3& dir) const {
    return sky_->empty() ? 0 : probability(centre_, std::uint32_t(size() - 1)) * sky_->pdf(dir);
}

EmissionSample Lights::sample_emission(float u_light, const vec2& u_place,
                                       const vec2& u_dir) const {
    const auto chosen = choice_.sample(u_light);
    EmissionSample s = emit(chosen.index, chosen.u, u_place, u_dir);
    s.flux /= chosen.probability;
    return s;
}

EmissionSample Lights::sample_emission_of(std::uint32_t index, float u_side, const vec2& u_place,
                                          const vec2& u_dir) const {
    EmissionSample s = emit(index, u_side, u_place, u_dir);
    s.flux /= path_chance_[index];
    return s;
}

EmissionSample Lights::emit(std::uint32_t index, float u_side, const vec2& u_place,
                            const vec2& u_dir) const {
    const std::size_t punctual = index - triangles_.size();
    if (index < triangles_.size())
        return emit_from_triangle(triangles_[index], u_side, u_place, u_dir);
    return punctual < punctual_.size() ? emit_from_punctual(punctual_[punctual], u_place, u_dir)
                                       : emit_from_sky(u_place, u_dir);
}

std::vector<Lights::PathStart> Lights::deal_paths(std::uint32_t count, float u) const {
    std::vector<PathStart> starts;
    starts.reserve(count);
    for (std::uint32_t i = 0; i < count; ++i) {
        const float at = std::min((float(i) + u) / float(count), 0x1.fffffep-1f);
        const std::uint32_t index = path_order_[path_choice_.sample(at).index];
        const bool again = !starts.empty() && starts.back().index == index;
        starts.push_back({index, again ? starts.back().number + 1 : 0});
    }
    return starts;
}

EmissionSample Lights::emit_from_triangle(const TriangleLight& light, float u_side,
                                          const vec2& u_place, const vec2& u_dir) const {
    const WorldTriangle& t = light.shape;
    const vec2 b = sample_triangle(u_place);
    EmissionSample s;
    const float side = light.two_sided && u_side >= 0.5f ? -1 : 1;
    s.ray.org = t.point(b) + side * light.off_front;
    s.ray.dir = Frame(side * t.ng).world_from_local(sample_cosine_hemisphere(u_dir));
    s.flux = radiance(light, b) * pi * light.area * (light.two_sided ? 2.0f : 1.0f);
    return s;
}

EmissionSample Lights::emit_from_punctual(const Light& light, const vec2& u_place,
                                          const vec2& u_dir) const {
    EmissionSample s;
    s.ray.org = light.position;
    if (light.kind == LightKind::point) {
        s.ray.dir = sample_sphere(u_dir);
        s.flux = light.intensity / sphere_pdf;
    } else if (light.kind == LightKind::spot) {
        const float cos_outer = std::cos(light.outer_angle);
        const vec3 local = sample_cone(u_dir, cos_outer);
        s.ray.dir = Frame(light.direction).world_from_local(local);
        s.flux = light.intensity * spot_falloff(light, local.z) / cone_pdf(cos_outer);
    } else {
        s = emit_from_disc(light.direction, u_place);
        s.flux *= light.intensity;
    }
    return s;
}

EmissionSample Lights::emit_from_sky(const vec2& u_place, const vec2& u_dir) const {
    const Sky::Direction d = sky_->sample(u_dir);
    EmissionSample s = emit_from_disc(-d.dir, u_place);
    s.flux *= sky_->radiance(d.dir) / d.pdf;
    return s;
}

/// Light from far away leaves a disc that covers the scene's bounding sphere.
EmissionSample Lights::emit_from_disc(const vec3& dir, const vec2& u_place) const {
    const vec2 d = radius_ * sample_disc(u_place);
    const Frame frame(dir);
    EmissionSample s;
    s.ray.dir = dir;
    s.ray.org = centre_ + d.x * frame.s + d.y * frame.t - 2 * radius_ * dir;
    s.flux = vec3(pi * radius_ * radius_);
    return s;
}

}  // namespace tessera
