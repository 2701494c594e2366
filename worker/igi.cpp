#include "worker/igi.h"

#include <numeric>

#include "worker/light_paths.h"

namespace tessera {
namespace {

/// Candidates among which one direct light sample is chosen. One lamp needs no choice, the sky
/// does; more than four cost more than they gain, more than two where a tree has chosen well.
std::uint32_t direct_candidates(const World& world) {
    if (world.lights.has_tree()) return 2;
    if (!world.lights.sky().empty()) return 4;
    return std::uint32_t(std::clamp<std::size_t>(world.lights.size() / 2, 1, 4));
}

/// What a pixel shows of irradiance that is added to `sum`.
vec3 shown(const PixelSample& pixel, const vec3& e, const vec3 PixelSample::*sum) {
    return sum == &PixelSample::emitted ? e : pixel.albedo / pi * e;
}

/// Shadow rays under way, and what each adds to its pixel when it is free.
struct ShadowBatch {
    LightTally* tally = nullptr;
    std::vector<Ray> rays{};
    std::vector<std::uint32_t> pixels{};
    std::vector<vec3> irradiance{};
    std::vector<std::uint32_t> lights{};  ///< only with a tally
    std::vector<std::uint8_t> blocked{};

    void reserve(std::size_t count) {
        rays.reserve(count);
        pixels.reserve(count);
        irradiance.reserve(count);
    }
    /// `light`: where it comes from.
    void add(const Ray& ray, std::uint32_t pixel, const vec3& e, std::uint32_t light) {
        rays.push_back(ray);
        pixels.push_back(pixel);
        irradiance.push_back(e);
        if (tally) lights.push_back(light);
    }
    /// Adds what is free to `sum` of its pixel. Returns the number of rays traced.
    std::uint64_t trace(const Tracer& tracer, std::span<PixelSample> samples,
                        vec3 PixelSample::*sum) {
        blocked.resize(rays.size());
        tracer.occluded(rays, blocked);
        for (std::size_t i = 0; i < rays.size(); ++i)
            if (!blocked[i]) samples[pixels[i]].*sum += irradiance[i];
        if (!tally) return rays.size();
        for (std::size_t i = 0; i < rays.size(); ++i)
            if (!blocked[i])
                tally->add(lights[i], pixels[i], shown(samples[pixels[i]], irradiance[i], sum));
        return rays.size();
    }
};

float fraction(float x) { return x - std::floor(x); }

struct DirectSample {
    LightSample light;
    vec3 contribution{0};

    /// What candidates are chosen by: about what they will bring.
    float promise() const {
        constexpr float unlikely = 0.1f;
        return mean_component(contribution) * (light.unlikely ? unlikely : 1.0f);
    }
};

/// How far a surface can be and exceed the bound of the geometry term, along a ray that leaves at
/// an angle of this cosine.
float reach(float cosine, float max_geometry) { return std::sqrt(cosine / max_geometry); }

/// Share of the emission in a direction that is left to direct sampling, where a scattered ray of
/// density `ray_pdf` finds the lamp, too. `light_pdf` is that of one candidate.
float direct_weight(const World& world, float light_pdf, float ray_pdf) {
    return power_heuristic(float(direct_candidates(world)) * light_pdf, ray_pdf);
}

/// A vertex of a path from the eye, and what the light that its lobes reflect brings there.
struct LitVertex {
    SurfacePoint at;
    vec3 broad{1};   ///< from irradiance, weighed as broad lobes do, to the sum
    vec3 narrow{0};  ///< from the radiance that narrow and ideal lobes reflect to the sum
};

/// Light from `light` per irradiance across its direction, but for what scattered rays bring.
vec3 response(const World& world, const IgiConfig& config, const LitVertex& v,
              const LightSample& light, float cosine) {
    const SurfacePoint& s = v.at;
    const bool near = !light.punctual && light.distance < reach(cosine, config.max_geometry);
    vec3 sum =
        v.broad * (near ? direct_weight(world, light.pdf, cosine_hemisphere_pdf(cosine)) : 1.0f);
    if (!s.bsdf.glossy) return sum;
    sum *= shape(s.bsdf, s.n, s.wo, light.wi);
    if (v.narrow == vec3(0) || !s.bsdf.has_narrow()) return sum;
    const float ray_pdf = pdf(s.bsdf, s.n, s.wo, light.wi, Lobes::narrow);
    const float weight = light.punctual ? 1 : direct_weight(world, light.pdf, ray_pdf);
    return sum + v.narrow * eval(s.bsdf, s.n, s.wo, light.wi, Lobes::narrow) * weight;
}

/// What photons bring: the light of lamps through ideal surfaces, as the lobes reflect it; `broad`
/// and `narrow` as in LitVertex. Not filtered: it changes from pixel to pixel, and is smooth
/// already.
vec3 caustic_light(const PhotonMap& photons, const SurfacePoint& s, const vec3& broad,
                   const vec3& narrow) {
    vec3 sum(0);
    photons.find(s, [&](const Photon& photon, float density) {
        if (!(dot(s.n, photon.wi) > 0)) return;
        vec3 share = broad;
        if (s.bsdf.glossy) {
            share *= shape(s.bsdf, s.n, s.wo, photon.wi);
            if (s.bsdf.has_narrow())
                share += narrow * eval(s.bsdf, s.n, s.wo, photon.wi, Lobes::narrow);
        }
        sum += share * photon.flux * (density * photon_correction(s, photon.wi));
    });
    return sum;
}

/// Candidate `i`: a shift of the pixel's own point, so that the candidates spread over the lights.
DirectSample direct_candidate(const World& world, const IgiConfig& config, const LitVertex& v,
                              std::uint32_t i, float u_light, const vec2& u) {
    // Shifts by the plastic number's powers fill the square evenly (Roberts, "The Unreasonable
    // Effectiveness of Quasirandom Sequences", 2018).
    const vec2 place(fraction(u.x + float(i) * 0.75487766f),
                     fraction(u.y + float(i) * 0.56984029f));
    const float stratum =
        std::min((float(i) + u_light) / float(direct_candidates(world)), 0x1.fffffep-1f);
    const auto light = world.lights.sample(v.at.p, stratum, place);
    if (!light) return {};
    const float cosine = dot(v.at.n, light->wi);
    if (!(cosine > 0 && dot(v.at.ng, light->wi) > 0)) return {};
    return {*light,
            light->radiance * (cosine / light->pdf) * response(world, config, v, *light, cosine)};
}

/// Points of a sampler that sample_direct() takes.
constexpr std::uint32_t direct_pairs = 2;

/// Adds the shadow ray to one point on a light.
void sample_direct(const World& world, const IgiConfig& config, const LitVertex& v,
                   std::uint32_t pixel, Sampler& sampler, ShadowBatch& batch) {
    const vec2 u_choice = sampler.next();
    const vec2 u_place = sampler.next();
    const std::uint32_t candidates = direct_candidates(world);
    DirectSample chosen;
    float chosen_weight = 0;
    float total = 0;
    float u = u_choice.y;
    for (std::uint32_t i = 0; i < candidates; ++i) {
        const DirectSample c = direct_candidate(world, config, v, i, u_choice.x, u_place);
        const float weight = c.promise();
        if (!(weight > 0) || !std::isfinite(weight)) continue;
        // Reservoir of one, with the same random number stretched again after each decision.
        total += weight;
        const float p = weight / total;
        if (u < p) {
            u /= p;
            chosen = c;
            chosen_weight = weight;
        } else {
            u = (u - p) / (1 - p);
        }
    }
    if (total <= 0) return;
    batch.add(shadow_ray(v.at, chosen.light), pixel,
              chosen.contribution * (total / (chosen_weight * float(candidates))),
              chosen.light.index);
}

/// Points that want direct light, answered together where all lights are lamps.
class DirectBatch {
public:
    DirectBatch(const World& world, const IgiConfig& config, ShadowBatch& shadows)
        : world_(world), config_(config), shadows_(shadows) {}

    /// What sample_direct() does, at the latest in finish().
    void add(const LitVertex& v, std::uint32_t pixel, Sampler& sampler) {
        if (v.at.bsdf.glossy || world_.lights.lamps().lamps.empty())
            return sample_direct(world_, config_, v, pixel, sampler, shadows_);
        if (orgs_.size() == LampRequests::capacity) finish();
        const std::size_t i = orgs_.size();
        const vec2 u_choice = sampler.next();
        const vec2 u_place = sampler.next();
        for (int k = 0; k < 3; ++k) {
            requests_.p[k][i] = v.at.p[k];
            requests_.n[k][i] = v.at.n[k];
            requests_.ng[k][i] = v.at.ng[k];
            requests_.throughput[k][i] = v.broad[k];
        }
        for (int k = 0; k < 2; ++k) {
            requests_.u_choice[k][i] = u_choice[k];
            requests_.u_place[k][i] = u_place[k];
        }
        orgs_.push_back(v.at.org);
        pixels_.push_back(pixel);
    }

    void finish() {
        const LampSampling sampling{direct_candidates(world_), config_.max_geometry};
        sample_lamps(world_.lights.lamps(), sampling, orgs_.size(), requests_);
        for (std::size_t i = 0; i < orgs_.size(); ++i) {
            const vec3 e = of(requests_.e, i);
            if (e != vec3(0))
                shadows_.add({orgs_[i], 0, of(requests_.end, i) - orgs_[i], 1}, pixels_[i], e, 0);
        }
        orgs_.clear();
        pixels_.clear();
    }

private:
    static vec3 of(const LampRequests::Column (&columns)[3], std::size_t i) {
        return {columns[0][i], columns[1][i], columns[2][i]};
    }

    const World& world_;
    const IgiConfig& config_;
    ShadowBatch& shadows_;
    LampRequests requests_{};
    std::vector<vec3> orgs_;
    std::vector<std::uint32_t> pixels_;
};

/// Adds the shadow ray to one VPL of all sets, in place of a whole set; `throughput` scales what it
/// brings, `bounces` counts the reflections there were already.
void sample_vpl(const VplSets& sets, const IgiConfig& config, const SurfacePoint& s,
                std::uint32_t pixel, const vec3& throughput, std::uint32_t bounces,
                Sampler& sampler, ShadowBatch& batch) {
    if (sets.vpls.empty()) return;
    const auto count = std::uint32_t(sets.vpls.size());
    const auto chosen = std::min(std::uint32_t(sampler.next().x * float(count)), count - 1);
    const std::uint32_t per_set = count / (config.interleave * config.interleave);
    const Vpl& vpl = sets.vpls[chosen];
    if (bounces + vpl.bounces > config.bounces) return;
    const vec3 e = throughput * float(per_set) * irradiance(s, vpl, config.max_geometry);
    if (max_component(e) > 0) batch.add({vpl.org, 0, s.org - vpl.org, 1}, pixel, e, vpl.light);
}

std::vector<std::uint32_t> pixels_of(std::span<const Receiver> receivers) {
    std::vector<std::uint32_t> pixels;
    pixels.reserve(receivers.size());
    for (const Receiver& r : receivers) pixels.push_back(r.pixel);
    return pixels;
}

/// The kind of lobe that sent a ray.
enum class Via : std::uint8_t { broad, narrow, ideal };

/// A path of scattered rays: picks up what VPLs leave out.
struct RestPath {
    std::uint32_t pixel = 0;
    std::uint32_t bounces = 0;  ///< reflections between the receiver and its vertex, but for ideal
    std::uint32_t mirrors = 0;  ///< ideal reflections and refractions in a row
    Sampler sampler;
    LitVertex vertex;
    float whole = pi;  ///< throughput of a path that has lost nothing
    // Of the ray under way:
    Via via = Via::broad;
    vec3 throughput{0};  ///< from the radiance that it finds to the sum
    float pdf = 0;       ///< unless by an ideal lobe
    float reach = 0;     ///< by a broad lobe: how far it finds what the bound takes away
};

/// Russian roulette by what the path carries, once it has left its first ray's end.
bool survives(RestPath& path) {
    if (path.bounces < 2) return true;
    const float survival = std::min(max_component(path.throughput) / path.whole, 0.95f);
    if (!(path.sampler.next().x < survival)) return false;
    path.throughput /= survival;
    return true;
}

/// Sends the ray of a broad lobe; it need go no farther than the bound can be exceeded where
/// nothing but broad lobes can be found. False when the path ends.
bool aim_broad(const IgiConfig& config, RestPath& path, Ray& ray) {
    const SurfacePoint& s = path.vertex.at;
    const vec3 local = sample_cosine_hemisphere(path.sampler.next());
    const vec3 dir = Frame(s.n).world_from_local(local);
    if (!(dot(dir, s.ng) > 0)) return false;
    path.via = Via::broad;
    path.throughput = path.vertex.broad * pi;
    if (s.bsdf.glossy) path.throughput *= shape(s.bsdf, s.n, s.wo, dir);
    path.pdf = cosine_hemisphere_pdf(local.z);
    path.reach = reach(local.z, config.max_geometry);
    ray = {s.org, 0, dir, config.has_rest ? infinity : path.reach};
    return true;
}

bool aim_narrow(RestPath& path, Ray& ray) {
    const SurfacePoint& s = path.vertex.at;
    const auto scattered = sample(s.bsdf, s.n, s.wo, 0, path.sampler.next(), Lobes::narrow);
    if (!scattered || !(dot(scattered->wi, s.ng) > 0)) return false;
    path.throughput = path.vertex.narrow * scattered->weight;
    path.via = Via::narrow;
    path.pdf = scattered->pdf;
    ray = {s.org, 0, scattered->wi, infinity};
    return true;
}

bool aim_ideal(RestPath& path, Ray& ray) {
    path.throughput = path.vertex.narrow;
    path.via = Via::ideal;
    return ++path.mirrors <= max_mirrors &&
           pass_delta(path.vertex.at, Carries::radiance, path.sampler, path.throughput, ray);
}

/// Chooses one kind of lobe by what the path carries through each, and sends the ray.
bool aim(const IgiConfig& config, RestPath& path, Ray& ray) {
    LitVertex& v = path.vertex;
    const Bsdf& bsdf = v.at.bsdf;
    const vec3 narrow = bsdf.has_narrow() ? bsdf.reflectance(Lobes::narrow) : vec3(0);
    const float chances[3] = {max_component(v.broad), max_component(v.narrow * narrow),
                              max_component(v.narrow) * bsdf.delta_share};
    const float total = chances[0] + chances[1] + chances[2];
    if (!(total > 0)) return false;
    if (chances[0] == total) return aim_broad(config, path, ray);
    const float u = path.sampler.next().x * total;
    const int kind = u < chances[0] ? 0 : u < chances[0] + chances[1] ? 1 : 2;
    const float made_up = total / chances[kind];
    v.broad *= made_up;
    v.narrow *= made_up;
    if (kind == 0) return aim_broad(config, path, ray);
    return kind == 1 ? aim_narrow(path, ray) : aim_ideal(path, ray);
}

/// Moves what is kept to the front of its list; mostly it is there.
template <class T>
void keep(const T& value, T& to) {
    if (&value != &to) to = value;
}

/// Sends each path's next ray; paths that end leave the list.
void aim_all(const IgiConfig& config, std::vector<RestPath>& paths, std::vector<Ray>& rays) {
    std::size_t kept = 0;
    rays.resize(paths.size());
    for (RestPath& path : paths)
        if (aim(config, path, rays[kept]) && survives(path)) keep(path, paths[kept++]);
    paths.erase(paths.begin() + std::ptrdiff_t(kept), paths.end());
    rays.resize(kept);
}

/// Takes in the emission that `ray` found, against the chance that direct sampling finds it. Beside
/// a lamp its light changes from pixel to pixel: there it stays unfiltered.
void add_emission(const World& world, const IgiConfig& config, const RestPath& path, const Hit& hit,
                  const SurfacePoint& s, vec3 PixelSample::*sum, PixelSample& pixel) {
    if (s.emission == vec3(0)) return;
    float weight = 1;
    if (path.via == Via::broad && !(hit.t < path.reach)) return;
    if (path.via == Via::ideal && config.photons && config.caustics->by_photons(hit.instance))
        return;
    if (path.via != Via::ideal)
        weight = 1 - direct_weight(world, world.lights.pdf(path.vertex.at.p, hit, s), path.pdf);
    const vec3 e = path.throughput * s.emission * weight;
    if (const auto light = config.tally ? world.lights.light_of(hit) : std::nullopt)
        config.tally->add(*light, path.pixel, shown(pixel, e, sum));
    if (path.bounces > 0 || path.via != Via::broad || sum == &PixelSample::emitted)
        pixel.*sum += e;
    else if (hit.t > config.filter_angle * pixel.depth)
        pixel.direct += e;
    else
        pixel.emitted += pixel.albedo / pi * e;
}

/// Takes in the sky where `ray` left for it; direct sampling has all that broad lobes get.
void add_sky(const World& world, const RestPath& path, const vec3& dir, vec3& sum) {
    if (path.via == Via::broad) return;
    const vec3 radiance = world.lights.sky().radiance(dir);
    if (radiance == vec3(0)) return;
    const float weight =
        path.via == Via::ideal ? 1 : 1 - direct_weight(world, world.lights.sky_pdf(dir), path.pdf);
    sum += path.throughput * radiance * weight;
}

/// Moves `path` on to `s`, where `ray` ended; false when it carries nothing any more.
bool advance(RestPath& path, const IgiConfig& config, const Ray& ray, float t,
             const SurfacePoint& s) {
    LitVertex& v = path.vertex;
    v.narrow = s.bsdf.has_rest() ? path.throughput : vec3(0);
    v.broad = path.throughput * s.bsdf.reflectance() / pi;
    if (path.via == Via::broad) {
        const float geometry = dot(ray.dir, v.at.n) * dot(s.ng, s.wo) / (t * t);
        v.broad *= t < path.reach ? std::max(1 - config.max_geometry / geometry, 0.0f) : 0.0f;
    }
    if (path.via != Via::ideal) {
        ++path.bounces;
        path.mirrors = 0;
    }
    v.at = s;
    return (max_component(v.broad) > 0 || max_component(v.narrow) > 0) &&
           path.bounces <= config.bounces;
}

/// A set's receivers, where they are so many that shadow rays from a VPL pay as one packet: the
/// whole tile, when nothing is interleaved. Those of interleaved sets lie too far apart.
class ReceiverPacket {
public:
    static constexpr std::size_t least = 128;

    explicit ReceiverPacket(std::span<const Receiver* const> receivers)
        : receivers_(receivers), targets_(points_of(receivers)) {}

    /// Adds the VPL's light; returns the number of rays traced.
    std::uint64_t gather(const Tracer& tracer, const Vpl& vpl, const IgiConfig& config,
                         std::span<PixelSample> pixels) const {
        vec3 e[Targets::max_count];
        RayMask facing{};
        std::uint64_t rays = 0;
        for (std::size_t i = 0; i < receivers_.size(); ++i) {
            e[i] = irradiance(receivers_[i]->surface, vpl, config.max_geometry);
            if (!(max_component(e[i]) > 0)) continue;
            set(facing, i);
            ++rays;
        }
        const RayMask blocked = tracer.occluded_from(vpl.org, targets_, facing, nullptr);
        for (std::size_t i = 0; i < receivers_.size(); ++i) {
            if (!has(facing, i) || has(blocked, i)) continue;
            PixelSample& pixel = pixels[receivers_[i]->pixel];
            pixel.indirect += e[i];
            if (config.tally)
                config.tally->add(vpl.light, receivers_[i]->pixel,
                                  shown(pixel, e[i], &PixelSample::indirect));
        }
        return rays;
    }

private:
    static std::vector<vec3> points_of(std::span<const Receiver* const> receivers) {
        std::vector<vec3> points;
        for (const Receiver* r : receivers) points.push_back(r->surface.org);
        return points;
    }

    std::span<const Receiver* const> receivers_;
    Targets targets_;
};

template <class Gather>
void for_each_packet(std::span<const Receiver* const> receivers, Gather gather) {
    for (std::size_t first = 0; first < receivers.size(); first += Targets::max_count)
        gather(ReceiverPacket(receivers.subspan(
            first, std::min<std::size_t>(Targets::max_count, receivers.size() - first))));
}

/// Compensation costs as much as all else that a pixel does, and makes less of the noise. Of so
/// many pixels side by side one has its turn in each pass, and counts for all. Measured on a
/// Cornell box and a conference room, four are no better in one pass, and in four passes take a
/// tenth more time to the same error.
constexpr std::uint32_t compensation_period = 2;

bool has_turn(const TilePass& tile, std::uint32_t pixel, std::uint32_t period) {
    const ivec2 at = tile.raster(pixel);
    const auto x = std::uint32_t(at.x), y = std::uint32_t(at.y);
    return (hash(hash(tile.seed, x / period), y) + tile.pass) % period == x % period;
}

/// Follows `paths` to their ends and adds what they find to `sum` of their pixels. Returns the
/// number of rays traced.
std::uint64_t follow_rest(const World& world, const IgiConfig& config, const VplSets& sets,
                          std::vector<RestPath>& paths, std::span<PixelSample> pixels,
                          vec3 PixelSample::*sum) {
    std::vector<Ray> rays;
    std::vector<Hit> hits;
    ShadowBatch batch{.tally = config.tally};
    batch.reserve(2 * paths.size());
    DirectBatch direct(world, config, batch);
    TriangleCache cache;
    std::uint64_t traced = 0;
    while (!paths.empty()) {
        aim_all(config, paths, rays);
        hits.resize(rays.size());
        world.tracer.closest_hits(rays, hits);
        traced += rays.size();

        // Light what they found: it emits, and reflects light from one lamp and one VPL.
        std::size_t kept = 0;
        for (std::size_t i = 0; i < rays.size(); ++i) {
            RestPath& path = paths[i];
            if (!hits[i].valid()) {
                add_sky(world, path, rays[i].dir, pixels[path.pixel].*sum);
                continue;
            }
            SurfacePoint s;
            world.surfaces.find(rays[i], hits[i], cache, s);
            add_emission(world, config, path, hits[i], s, sum, pixels[path.pixel]);
            if (!advance(path, config, rays[i], hits[i].t, s)) continue;
            if (!s.bsdf.is_delta()) {
                if (config.photons)
                    pixels[path.pixel].*sum +=
                        caustic_light(*config.photons, s, path.vertex.broad, path.vertex.narrow);
                direct.add(path.vertex, path.pixel, path.sampler);
                sample_vpl(sets, config, s, path.pixel, path.vertex.broad, path.bounces,
                           path.sampler, batch);
            }
            keep(path, paths[kept++]);
        }
        paths.erase(paths.begin() + std::ptrdiff_t(kept), paths.end());
        // Now, so that what a pixel gets is added up in an order that others have no part in.
        direct.finish();
    }
    return traced + batch.trace(world.tracer, pixels, sum);
}

}  // namespace

std::vector<LightEstimate> LightTally::estimates() const {
    std::vector<LightEstimate> out, part;
    for (std::size_t begin = 0; begin < radiance_.size(); begin += lights_) {
        part.clear();
        for (std::uint32_t i = 0; i < lights_; ++i) {
            const float radiance = radiance_[begin + i];
            if (radiance > 0 && std::isfinite(radiance)) part.push_back({i, radiance});
        }
        add_estimates(part, out);
    }
    return out;
}

std::uint64_t gather_direct(const World& world, const TilePass& tile, const IgiConfig& config,
                            std::span<const Receiver> receivers, std::span<PixelSample> pixels) {
    ShadowBatch batch{.tally = config.tally};
    batch.reserve(receivers.size());
    DirectBatch direct(world, config, batch);
    const SampleTable samplers = tile.samplers(pixels_of(receivers), 1, direct_pairs, tile.pass);
    for (std::size_t i = 0; i < receivers.size(); ++i) {
        const Receiver& r = receivers[i];
        Sampler sampler = samplers[i];
        direct.add({.at = r.surface}, r.pixel, sampler);
    }
    direct.finish();
    if (config.photons)
        for (const Receiver& r : receivers)
            pixels[r.pixel].emitted +=
                caustic_light(*config.photons, r.surface,
                              r.throughput * r.surface.bsdf.reflectance() / pi, r.throughput);
    return batch.trace(world.tracer, pixels, &PixelSample::direct);
}

std::uint64_t gather_indirect(const World& world, const TilePass& tile, const IgiConfig& config,
                              const VplSets& sets, std::span<const Receiver> receivers,
                              std::span<PixelSample> pixels) {
    // Sort the receivers by set: rays from one VPL then follow each other.
    const std::uint32_t set_count = config.interleave * config.interleave;
    std::vector<std::uint32_t> ends(set_count);
    const auto set_of = [&](const Receiver& r) {
        return set_index(tile.raster(r.pixel), sets.offset, config.interleave);
    };
    for (const Receiver& r : receivers) ++ends[set_of(r)];
    std::partial_sum(ends.begin(), ends.end(), ends.begin());
    std::vector<const Receiver*> sorted(receivers.size());
    for (auto r = receivers.rbegin(); r != receivers.rend(); ++r) sorted[--ends[set_of(*r)]] = &*r;
    ends.push_back(std::uint32_t(receivers.size()));  // now the beginnings
    const auto of_set = [&](std::uint32_t set) {
        return std::span<const Receiver* const>(sorted).subspan(ends[set],
                                                                ends[set + 1] - ends[set]);
    };

    ShadowBatch batch{.tally = config.tally};
    batch.reserve(receivers.size());
    std::uint64_t traced = 0;
    for (std::uint32_t set = 0; set < set_count; ++set) {
        if (of_set(set).size() >= ReceiverPacket::least) {
            for_each_packet(of_set(set), [&](const ReceiverPacket& packet) {
                for (const Vpl& vpl : sets.set(set))
                    traced += packet.gather(world.tracer, vpl, config, pixels);
            });
            continue;
        }
        for (const Vpl& vpl : sets.set(set)) {
            for (const Receiver* r : of_set(set)) {
                const vec3 e = irradiance(r->surface, vpl, config.max_geometry);
                if (max_component(e) > 0)
                    batch.add({vpl.org, 0, r->surface.org - vpl.org, 1}, r->pixel, e, vpl.light);
            }
        }
    }
    return traced + batch.trace(world.tracer, pixels, &PixelSample::indirect);
}

std::uint64_t gather_rest(const World& world, const TilePass& tile, const IgiConfig& config,
                          const VplSets& sets, std::span<const Receiver> receivers,
                          std::span<PixelSample> pixels) {
    // Caustics are noise enough.
    const std::uint32_t period = config.has_rest ? 1 : compensation_period;
    std::vector<const Receiver*> chosen;
    std::vector<std::uint32_t> chosen_pixels;
    for (const Receiver& r : receivers) {
        if (!has_turn(tile, r.pixel, period)) continue;
        chosen.push_back(&r);
        chosen_pixels.push_back(r.pixel);
    }
    // The points for a broad ray, and for a lamp and a VPL where it ends.
    const SampleTable samplers =
        tile.samplers(chosen_pixels, 2, 1 + direct_pairs + 1, tile.pass / period);
    std::vector<RestPath> paths;
    paths.reserve(chosen.size());
    for (std::size_t i = 0; i < chosen.size(); ++i)
        paths.push_back({.pixel = chosen[i]->pixel,
                         .sampler = samplers[i],
                         .vertex = {.at = chosen[i]->surface, .broad = vec3(float(period))},
                         .whole = pi * float(period)});
    std::uint64_t traced = follow_rest(world, config, sets, paths, pixels, &PixelSample::indirect);
    if (!config.has_rest) return traced;

    // What the receivers' own narrow lobes reflect; ideal ones the eye rays have followed.
    paths.clear();
    ShadowBatch batch{.tally = config.tally};
    for (const Receiver& r : receivers) {
        if (!r.surface.bsdf.has_narrow()) continue;
        RestPath path{
            .pixel = r.pixel, .sampler = tile.sampler(r.pixel, 3), .vertex = {}, .whole = 1};
        const float share = 1 - r.surface.bsdf.delta_share;
        path.vertex = {.at = r.surface, .broad = vec3(0), .narrow = r.throughput * share};
        path.vertex.at.bsdf.delta_share = 0;
        sample_direct(world, config, path.vertex, r.pixel, path.sampler, batch);
        paths.push_back(path);
    }
    traced += batch.trace(world.tracer, pixels, &PixelSample::emitted);
    return traced + follow_rest(world, config, sets, paths, pixels, &PixelSample::emitted);
}

}  // namespace tessera
