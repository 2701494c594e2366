// All that emits: triangles of emissive materials in every instance, punctual lights (point, spot,
// directional; falloff after glTF's KHR_lights_punctual) and the sky. Few lights are chosen by
// power, many by what they can send to the receiver. Chosen by power; sampled towards a
// receiver, or outward as the start of a light path.
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
};

/// Start of a light path.
struct EmissionSample {
    Ray ray;
    vec3 flux{0};  ///< emitted power over the pdf of this sample, W
};

class Lights {
public:
    /// `bounds`: of everything that directional light shall reach.
    Lights(const Surfaces& surfaces, const Box& bounds);

    /// Whether the scene is black.
    bool empty() const { return choice_.empty(); }
    std::size_t triangle_count() const { return triangles_.size(); }
    /// Triangles, punctual lights and the sky.
    std::size_t size() const {
        return triangles_.size() + punctual_.size() + (sky_->empty() ? 0 : 1);
    }
    const Sky& sky() const { return *sky_; }
    /// The lights as lamps, if that is all they are and sample() chooses them by power; else empty.
    const LampTable& lamps() const { return lamps_; }
    /// Whether lights are chosen by what they can send to the receiver.
    bool has_tree() const { return !tree_.empty(); }

    /// Chooses a light with u_light and a point on it with u. Nothing when it does not face `p`.
    std::optional<LightSample> sample(const vec3& p, float u_light, const vec2& u) const;
    /// Density, per solid angle from `from`, with which sample() finds the point that `hit` found.
    float pdf(const vec3& from, const Hit& hit, const SurfacePoint& s) const;

    /// Density, per solid angle, with which sample() finds the sky in direction `dir`.
    float sky_pdf(const vec3& dir) const;

    /// The start of a light path. Call only when not empty.
    EmissionSample sample_emission(float u_light, const vec2& u_place, const vec2& u_dir) const;

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
    std::optional<Distribution::Choice> choose(const vec3& p, float u) const;
    float probability(const vec3& p, std::uint32_t index) const;
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
    LightTree tree_;       ///< over the same; those that are everywhere have no power there
    Distribution far_;     ///< over the same; only those that are everywhere
    LampTable lamps_;
};

/// The shadow ray from `s` to a light sampled from there.
Ray shadow_ray(const SurfacePoint& s, const LightSample& light);

/// Share of a spot light's intensity at the angle of cosine `cosine` from its axis.
float spot_falloff(const Light& light, float cosine);

}  // namespace tessera
