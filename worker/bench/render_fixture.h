// Small scenes and whole pictures for benchmarks and tests of light transport.
#pragma once

#include <string>
#include <vector>

#include "common/mesh_builder.h"
#include "common/scene_builder.h"
#include "worker/renderer.h"

namespace tessera {

/// Adds `mesh` with one material, unmoved.
inline void add_shape(SceneBundle& bundle, const Mesh& mesh, const Material& material,
                      const mat4& world_from_object = mat4(1)) {
    const std::uint32_t m = add_material(bundle, material);
    add_instance(bundle, "", add_object(bundle, "", mesh, {m}), world_from_object);
}

inline Material lambert(const vec3& albedo) {
    Material m;
    m.base_color = albedo;
    return m;
}

inline Material emitter(const vec3& radiance) {
    Material m = lambert(vec3(0));
    m.emission = radiance;
    return m;
}

/// A horizontal square of side 2 * half at height y; faces up, or down.
inline Mesh square(float half, float y, bool up = true) {
    const vec3 a(-half, y, half), b(half, y, half), c(half, y, -half), d(-half, y, -half);
    MeshBuilder builder;
    if (up)
        builder.quad(a, b, c, d);
    else
        builder.quad(d, c, b, a);
    return builder.take_textured();
}

/// A box seen from inside: its front sides face inward.
inline Mesh room(const vec3& lo, const vec3& hi) {
    MeshBuilder builder;
    builder.box(lo, hi);
    Mesh mesh = builder.take();
    for (uvec3& t : mesh.triangles) std::swap(t.y, t.z);
    mesh.normals.clear();
    return mesh;
}

/// A lit room with a coat on its walls and a ball of `ball` in the middle of the picture.
inline SceneBundle room_with_ball(const Material& walls, const Material& ball) {
    SceneBundle bundle;
    add_shape(bundle, room(vec3(-1), vec3(1)), walls);
    add_shape(bundle, square(0.5f, 0.99f, false), emitter(vec3(5)));
    MeshBuilder builder;
    builder.ball({-0.4f, -0.4f, -0.4f}, 0.4f, 32);
    add_shape(bundle, builder.take(), ball);
    return bundle;
}

inline Camera at_ball() {
    Camera camera;
    camera.eye = {0.5f, 0.3f, 0.6f};
    camera.at = {-0.4f, -0.4f, -0.4f};
    camera.fov_y = 60;
    return camera;
}

/// Two rooms of 2 m with 40 lamps each under their ceilings, and a slit of that width between them.
inline SceneBundle two_rooms(float slit, bool lit_here = true) {
    SceneBundle bundle;
    MeshBuilder walls;
    walls.box({-1.05f, -1, -1}, {-0.95f, 1, -0.5f * slit});
    walls.box({-1.05f, -1, 0.5f * slit}, {-0.95f, 1, 1});
    add_shape(bundle, walls.take(), lambert(vec3(0.6f)));
    add_shape(bundle, room({-3.05f, -1, -1}, {1.05f, 1, 1}), lambert(vec3(0.6f, 0.5f, 0.4f)));
    for (int i = 0; i < 40; ++i) {
        mat4 place(1);
        place[3] = vec4(-0.8f + 0.2f * float(i % 8), 0.9f, -0.8f + 0.4f * float(i / 8), 1);
        const Material glow = emitter(vec3(1 + float(i % 3), 2, 3));
        if (lit_here) add_shape(bundle, square(0.05f, 0, false), glow, place);
        place[3].x -= 2.1f;
        add_shape(bundle, square(0.05f, 0, false), glow, place);
    }
    return bundle;
}

/// In the room to the right: of its floor and walls, none of its lamps.
inline Camera in_right_room() {
    Camera camera;
    camera.eye = {0.9f, 0.2f, 0.9f};
    camera.at = {-0.3f, -0.9f, -0.4f};
    camera.fov_y = 70;
    return camera;
}

inline FrameSpec frame_of(Integrator integrator, ImageSize size, const Camera& camera,
                          std::uint32_t passes) {
    FrameSpec spec;
    spec.frame = 1;
    spec.size = size;
    spec.camera = camera;
    spec.settings.integrator = integrator;
    spec.settings.tracer = TracerKind::embree;
    spec.settings.passes = passes;
    // Many sets for a few pixels would take most of the time.
    spec.settings.interleave = 3;
    spec.settings.vpls = 4;
    return spec;
}

/// All tasks of a frame, pass by pass.
inline std::vector<TileTask> tasks_of(const FrameSpec& spec) {
    std::vector<TileTask> tasks;
    const std::uint32_t step = passes_per_task(spec.settings);
    for (std::uint32_t pass = 0; pass < spec.settings.passes; pass += step)
        for (std::uint32_t tile = 0; tile < tile_count(spec.size); ++tile)
            tasks.push_back({spec.frame, tile, pass, std::min(step, spec.settings.passes - pass)});
    return tasks;
}

/// Where a channel starts in the data of a result with `pixels` pixels.
inline std::size_t channel_offset(const FrameSpec& spec, Channel channel, std::size_t pixels) {
    std::size_t offset = 0;
    for (int c = 0; c < int(channel); ++c)
        if (tile_channels(spec).has(Channel(c))) offset += pixels * floats_per_pixel(Channel(c));
    return offset;
}

/// Mean over all pixels and passes of radiance + albedo / pi * irradiance, unfiltered.
inline vec3 mean_radiance(const FrameSpec& spec, const std::vector<TileResult>& results) {
    double sum[3] = {0, 0, 0};
    for (const TileResult& r : results) {
        const std::size_t pixels = tile_rect(spec.size, r.task.tile).pixels();
        const auto at = [&](Channel channel, std::size_t i) {
            return double(r.data[channel_offset(spec, channel, pixels) + i]);
        };
        for (std::size_t i = 0; i < 3 * pixels; ++i) {
            sum[i % 3] += at(Channel::radiance, i);
            if (spec.settings.integrator == Integrator::igi)
                sum[i % 3] += at(Channel::albedo, i) / double(pi) * at(Channel::irradiance, i);
        }
    }
    const double samples = double(spec.size.pixels()) * spec.settings.passes;
    return vec3(sum[0] / samples, sum[1] / samples, sum[2] / samples);
}

inline std::vector<TileResult> render_all(Renderer& renderer, const FrameSpec& spec) {
    renderer.begin_frame(spec);
    std::vector<TileResult> results;
    for (const TileTask& task : tasks_of(spec)) results.push_back(*renderer.render(task));
    return results;
}

inline vec3 mean_radiance(const SceneBundle& bundle, const FrameSpec& spec) {
    Renderer renderer(bundle.scene, bundle.blobs, {});
    return mean_radiance(spec, render_all(renderer, spec));
}

}  // namespace tessera
