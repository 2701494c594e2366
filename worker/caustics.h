// Caustics by photons: light that goes from a lamp through or off ideal surfaces (mirrors, smooth
// glass) to the first one that scatters, where a photon is left; what is seen sums those nearby
// (Jensen, "Global Illumination Using Photon Maps", 1996). Photons lie in a hashed grid whose cells
// are as wide as the search, so that a lookup opens at most eight (Wald, "Realtime Ray Tracing and
// Interactive Global Illumination", 2004, 13.1.3).
//
// A mean over passes converges: the radius of pass i is a function of i alone, and shrinks so
// slowly that the variance of the mean vanishes with its bias (Hachisuka and Jensen, "Stochastic
// Progressive Photon Mapping", 2009; as Knaus and Zwicker, "Progressive Photon Mapping: A
// Probabilistic Approach", 2011, who keep no state). So passes are independent, and every worker
// makes the same photons of a pass by itself.
//
// What goes by photons is left out elsewhere, so nothing counts twice. All paths are sorted by
// their end at the lamp: lamp, one or more ideal surfaces, a surface X that scatters, anything,
// eye. For lights without size, which no ray can hit, such paths are found by photons at X alone.
// For lamps that are small against the ideal surfaces igi leaves them to photons, too, and rays
// from X that find such a lamp after ideal surfaces alone count for nothing; for all others, for
// the sky, and in the path tracer those rays find them. Virtual point lights stand for light that
// leaves X towards other surfaces, so they know nothing of the difference.
//
// Photons are aimed at spheres around the ideal surfaces. A direction in several of them is as much
// likelier, and weighed for it.
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>
#include <vector>

#include "worker/eye.h"

namespace tessera {

struct Photon {
    vec3 p{0};     ///< on the surface
    vec3 ng{0};    ///< of the lit side, unit
    vec3 wi{0};    ///< where it came from, unit
    vec3 flux{0};  ///< W
};

/// The photons of one pass.
class PhotonMap {
public:
    PhotonMap() = default;
    /// `radius`: of the search, positive.
    PhotonMap(std::vector<Photon> photons, float radius);

    bool empty() const { return photons_.empty(); }
    std::size_t size() const { return photons_.size(); }

    /// Calls `add(photon, density)` for all photons near `s`: density times its flux is its share
    /// of the irradiance there.
    template <class Add>
    void find(const SurfacePoint& s, Add add) const;

private:
    using Cell = glm::ivec3;

    std::uint32_t bucket_of(const Cell& cell) const;
    Cell cell_of(const vec3& p) const;

    std::vector<Photon> photons_;       ///< by bucket
    std::vector<std::uint32_t> first_;  ///< of each bucket, and the end of the last
    float radius_ = 1;
    float cell_ = 2;  ///< width of a cell: the search's diameter
};

/// What goes by photons in a scene, and how they are sent. Immutable.
class Caustics {
public:
    explicit Caustics(const Surfaces& surfaces);

    /// Whether photons are of use to an integrator.
    bool wanted(Integrator integrator) const { return sources_of(integrator).size() > 0; }
    /// Whether lamps of that instance shine through ideal surfaces by photons alone, in igi.
    bool by_photons(std::uint32_t instance) const { return by_photons_[instance] != 0; }
    std::size_t punctual_count() const { return punctual_count_; }
    std::size_t lamp_count() const { return lamp_count_; }
    std::size_t target_count() const { return targets_.size(); }

    /// Sends photons first .. first + count - 1 of the sequence `seed` through the scene. Their
    /// flux is that of a single one: divide by their number. Adds the rays traced to `rays`.
    std::vector<Photon> trace(const World& world, Integrator integrator, std::uint32_t first,
                              std::uint32_t count, std::uint32_t seed, std::uint64_t& rays) const;

private:
    struct Sphere {
        vec3 centre{0};
        float radius = 0;
    };
    /// A punctual light, or a triangle that emits.
    struct Source {
        std::int32_t light = -1;  ///< index into Scene::lights; -1: a triangle
        std::uint32_t instance = 0;
        std::uint32_t triangle = 0;
        bool two_sided = false;
        WorldTriangle shape;
        float area = 0;
    };
    struct Sources {
        std::vector<Source> list;
        Distribution choice;

        std::size_t size() const { return list.size(); }
    };

    const Sources& sources_of(Integrator integrator) const {
        return integrator == Integrator::igi ? all_ : punctual_;
    }
    void find_targets();
    void add_targets(std::uint32_t instance);
    void add_punctual();
    void add_lamps();
    void weigh(Sources& sources) const;
    float power_towards_targets(const Source& source) const;
    std::optional<EmissionSample> emit(const Source& source, const vec2& u_place, float u_target,
                                       const vec2& u_dir) const;
    std::optional<EmissionSample> emit_directional(const Light& light, float u_target,
                                                   const vec2& u) const;
    struct Aimed {
        vec3 dir{0};
        float pdf = 0;  ///< per solid angle
    };
    Aimed aim(const vec3& from, float u_target, const vec2& u) const;

    const Surfaces* surfaces_;
    std::vector<Sphere> targets_;
    Sources punctual_;
    Sources all_;
    std::size_t punctual_count_ = 0;
    std::size_t lamp_count_ = 0;
    std::vector<std::uint8_t> by_photons_;  ///< per instance
};

/// How many photons a pass sends, and the radius of its search.
struct PhotonConfig {
    Integrator integrator = Integrator::igi;
    std::uint32_t count = 0;  ///< 0: no photons
    float radius = 1;         ///< in the first pass
    std::uint32_t seed = 0;
};

/// Sends some photons to see how dense they lie. Their count is 0 when none arrives.
PhotonConfig plan_photons(const World& world, const Caustics& caustics, Integrator integrator,
                          ImageSize size, std::uint32_t seed);

/// Radius of pass `pass` over that of the first.
float radius_share(std::uint32_t pass);

PhotonMap make_photon_map(const World& world, const Caustics& caustics, const PhotonConfig& config,
                          std::uint32_t pass, std::uint64_t& rays);

/// Shading normals make the irradiance that photons tell differ from what bsdfs expect (Veach 1997,
/// 5.3); bounded.
float photon_correction(const SurfacePoint& s, const vec3& wi);

// ---- inline -------------------------------------------------------------------------------------

template <class Add>
void PhotonMap::find(const SurfacePoint& s, Add add) const {
    if (photons_.empty()) return;
    const Cell low = cell_of(s.p - radius_);
    const float r2 = radius_ * radius_;
    std::uint32_t seen[8];
    for (std::uint32_t i = 0; i < 8; ++i) {
        const std::uint32_t bucket = bucket_of(low + Cell(i & 1, i >> 1 & 1, i >> 2));
        seen[i] = bucket;
        // Two cells may share a bucket.
        if (std::find(seen, seen + i, bucket) != seen + i) continue;
        for (std::uint32_t k = first_[bucket]; k < first_[bucket + 1]; ++k) {
            const Photon& photon = photons_[k];
            const vec3 d = photon.p - s.p;
            const float d2 = dot(d, d);
            // Light on the other side, or around a corner, is not light here.
            if (!(d2 < r2 && dot(photon.ng, s.ng) > 0.7f && dot(photon.wi, s.ng) > 0)) continue;
            add(photon, 2 / (pi * r2) * (1 - d2 / r2));
        }
    }
}

}  // namespace tessera
