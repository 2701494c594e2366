// All that emits: triangles of emissive materials in every instance, punctual lights (point, spot,
// directional; falloff after glTF's KHR_lights_punctual) and the sky; sampled towards a receiver,
// or outward as the start of a light path. Few lights are chosen by power, many by what they can
// send to the receiver, and for a view by what it gets of them, too (light_tracking.h).
#pragma once

#include <memory>
#include <optional>
#include <vector>

#include "worker/lamp_samples.h"
#include "worker/light_tree.h"
#include "worker/sampling.h"
#include "worker/sky.h"
#include "worker/surface.h"

namespace tessera {

/// Light that reaches a receiver from one sampled direction, occlusion aside.
struct LightSample {
    vec3 wi{0};                 ///< unit, from the receiver
    float distance = infinity;  ///< along wi
    vec3 end{0};                ///< beside the point that emits; unused when distance is infinite
    vec3 radiance{0};           ///< punctual lights: irradiance across wi
    float pdf = 0;              ///< per solid angle; punctual lights: probability of the light
    bool punctual = false;
    bool unlikely = false;    ///< one of those of which the view seems to get nothing
    std::uint32_t index = 0;  ///< of the light
};

/// Start of a light path.
struct EmissionSample {
    Ray ray;
    vec3 flux{0};  ///< emitted power over the pdf of this sample, W
};

/// What a view gets of each light, in a unit of its own.
struct LightEstimates {
    std::vector<float> direct;    ///< reflected once
    std::vector<float> indirect;  ///< reflected more than once

    LightEstimates() = default;
    explicit LightEstimates(std::size_t lights) : direct(lights), indirect(lights) {}
};

class Lights {
public:
    /// `bounds`: of everything that directional light shall reach.
    Lights(const Surfaces& surfaces, const Box& bounds);

    /// Whether the scene is black.
    bool empty() const { return choice_.empty(); }
    std::size_t triangle_count() const { return triangles_.size(); }
    const WorldTriangle& triangle(std::size_t index) const { return triangles_[index].shape; }
    /// Triangles, punctual lights and the sky.
    std::size_t size() const {
        return triangles_.size() + punctual_.size() + (sky_->empty() ? 0 : 1);
    }
    const Sky& sky() const { return *sky_; }
    /// The lights as lamps, if that is all they are and sample() chooses them by power; else empty.
    const LampTable& lamps() const { return lamps_; }
    /// Whether lights are chosen by what they can send to the receiver.
    bool has_tree() const { return !tree_.empty(); }

    /// The same lights, chosen by what a view gets of them. Each keeps a chance, so that estimates
    /// need not be true. Call only if there is a tree.
    Lights tracked(const LightEstimates& estimates) const;
    bool is_tracked() const { return !path_order_.empty(); }
    /// Lights that a view gets something of, as far as is known.
    std::size_t active_count() const { return active_.size(); }

    /// Chooses a light with u_light and a point on it with u. Nothing when it does not face `p`.
    std::optional<LightSample> sample(const vec3& p, float u_light, const vec2& u) const;
    /// Density, per solid angle from `from`, with which sample() finds the point that `hit` found.
    float pdf(const vec3& from, const Hit& hit, const SurfacePoint& s) const;

    /// The light that `hit` found, if it is one.
    std::optional<std::uint32_t> light_of(const Hit& hit) const;

    /// Density, per solid angle, with which sample() finds the sky in direction `dir`.
    float sky_pdf(const vec3& dir) const;

    /// The start of a light path. Call only when not empty.
    EmissionSample sample_emission(float u_light, const vec2& u_place, const vec2& u_dir) const;

    /// Light path `number` of light `index`.
    struct PathStart {
        std::uint32_t index = 0;
        std::uint32_t number = 0;
    };
    /// Deals `count` light paths out to the lights, to each as many as it shall have on average or
    /// one more (Wald 2004, 14.4.3); where they are fewer than the lights that matter, one for
    /// neighbours together. `u` shifts who gets one more. Call only when tracked.
    std::vector<PathStart> deal_paths(std::uint32_t count, float u) const;
    /// The start of a light path of light `index` among those dealt out.
    EmissionSample sample_emission_of(std::uint32_t index, float u_side, const vec2& u_place,
                                      const vec2& u_dir) const;

private:
    struct TriangleLight {
        std::uint32_t instance = 0;
        std::uint32_t triangle = 0;
        bool two_sided = false;
        bool textured = false;
        WorldTriangle shape;
        float area = 0;
        vec3 off_front{0};
        vec3 radiance{0};  ///< mean of the emitting side
    };

    void list_lamps();
    void build_tree(std::span<const float> powers);
    bool is_far(std::uint32_t index) const;
    LightEstimates spread(const LightEstimates& estimates) const;
    struct Chosen;
    std::optional<Chosen> choose(const vec3& p, float u) const;
    std::optional<Chosen> choose_near(const vec3& p, float u) const;
    float probability(const vec3& p, std::uint32_t index) const;
    float probability_near(const vec3& p, std::uint32_t index) const;
    EmissionSample emit(std::uint32_t index, float u_side, const vec2& u_place,
                        const vec2& u_dir) const;
    void add_triangles(std::uint32_t instance, std::vector<float>& power);
    std::optional<LightSample> sample_triangle_light(const TriangleLight& light, const vec3& p,
                                                     float probability, const vec2& u) const;
    std::optional<LightSample> sample_punctual(const Light& light, const vec3& p,
                                               float probability) const;
    vec3 radiance(const TriangleLight& light, const vec2& b) const;
    EmissionSample emit_from_triangle(const TriangleLight& light, float u_side, const vec2& u_place,
                                      const vec2& u_dir) const;
    EmissionSample emit_from_punctual(const Light& light, const vec2& u_place,
                                      const vec2& u_dir) const;
    std::optional<LightSample> sample_sky(float probability, const vec2& u) const;
    EmissionSample emit_from_sky(const vec2& u_place, const vec2& u_dir) const;
    EmissionSample emit_from_disc(const vec3& dir, const vec2& u_place) const;
    float power(const Light& light) const;

    const Surfaces* surfaces_;
    vec3 centre_{0};
    float radius_ = 1;
    std::vector<TriangleLight> triangles_;  ///< sorted by instance, then triangle
    std::vector<std::uint32_t> first_of_instance_;
    std::vector<Light> punctual_;
    std::shared_ptr<const Sky> sky_;
    Distribution choice_;  ///< by power, over triangles_, then punctual_, then the sky
    LightTree tree_;       ///< over the same; those that are everywhere have no power there, and
                           ///< active ones neither
    Distribution far_;     ///< over the same; only those that are everywhere
    float far_share_ = 0;  ///< of choices that go to lights which are everywhere
    // When tracked:
    std::vector<std::uint32_t> active_;           ///< near ones that the view gets something of
    std::vector<std::uint32_t> place_in_active_;  ///< of each light; none: not_active
    LightTree active_tree_;                       ///< over active_
    std::vector<std::uint32_t> path_order_;       ///< all lights, each beside its neighbours
    Distribution path_choice_;                    ///< over path_order_
    std::vector<float> path_chance_;              ///< of each light
    LampTable lamps_;
};

/// The shadow ray from `s` to a light sampled from there.
Ray shadow_ray(const SurfacePoint& s, const LightSample& light);

/// Share of a spot light's intensity at the angle of cosine `cosine` from its axis.
float spot_falloff(const Light& light, float cosine);

}  // namespace tessera
