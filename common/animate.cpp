#include "common/animate.h"

#include <algorithm>
#include <glm/gtc/matrix_transform.hpp>
#include <unordered_set>

#include "common/check.h"

namespace tessera {
namespace {

/// The keys around a time, and how far it is from the first to the second.
struct Between {
    std::size_t first = 0, second = 0;
    float part = 0;
    float seconds = 0;  ///< from one to the other
};

Between keys_around(const Track& track, double seconds) {
    const std::vector<float>& times = track.times;
    CHECK(!times.empty());
    const auto next = std::upper_bound(times.begin(), times.end(), seconds,
                                       [](double t, float key) { return t < double(key); });
    if (next == times.begin()) return {};
    const auto first = std::size_t(next - times.begin()) - 1;
    if (next == times.end()) return {first, first, 0, 0};
    const double length = double(*next) - double(times[first]);
    return {first, first + 1, float((seconds - double(times[first])) / length), float(length)};
}

/// Component `c` of key `key`; `which` counts tangent before, value, tangent after.
float value_of(const Track& track, std::size_t key, std::size_t c, std::size_t which = 1) {
    const std::size_t n = track.components;
    return track.interpolation == Interpolation::cubic_spline
               ? track.values[(3 * key + which) * n + c]
               : track.values[key * n + c];
}

/// The Hermite spline through both keys.
float spline(const Track& track, const Between& at, std::size_t c) {
    const float t = at.part, t2 = t * t, t3 = t2 * t;
    return (2 * t3 - 3 * t2 + 1) * value_of(track, at.first, c) +
           (t3 - 2 * t2 + t) * at.seconds * value_of(track, at.first, c, 2) +
           (3 * t2 - 2 * t3) * value_of(track, at.second, c) +
           (t3 - t2) * at.seconds * value_of(track, at.second, c, 0);
}

glm::quat rotation_of(const Track& track, std::size_t key) {
    return {value_of(track, key, 3), value_of(track, key, 0), value_of(track, key, 1),
            value_of(track, key, 2)};
}

const Track* track_at(const Motion& motion, std::int32_t index) {
    return index == MotionNode::none ? nullptr : &motion.tracks[std::size_t(index)];
}

vec3 vector_at(const Motion& motion, std::int32_t track, const vec3& fallback, double seconds) {
    const Track* found = track_at(motion, track);
    if (!found) return fallback;
    const std::vector<float> v = sample(*found, seconds);
    return {v[0], v[1], v[2]};
}

glm::dmat4 local_transform(const Motion& motion, const MotionNode& node, double seconds) {
    if (node.is_fixed) return node.fixed;
    const Track* turning = track_at(motion, node.rotation_track);
    const glm::dquat rotation =
        glm::normalize(glm::dquat(turning ? sample_rotation(*turning, seconds) : node.rotation));
    const glm::dvec3 moved(vector_at(motion, node.translation_track, node.translation, seconds));
    const glm::dvec3 scaled(vector_at(motion, node.scale_track, node.scale, seconds));
    return glm::scale(glm::translate(glm::dmat4(1), moved) * glm::mat4_cast(rotation), scaled);
}

/// The rest shape with each morph target added as its weight says.
Shape morphed(const SoftMesh& mesh, std::span<const float> weights) {
    Shape shape = mesh.rest;
    for (std::size_t k = 0; k < std::min(mesh.targets.size(), weights.size()); ++k) {
        const Shape& target = mesh.targets[k];
        if (weights[k] == 0) continue;
        for (std::size_t i = 0; i < target.positions.size(); ++i)
            shape.positions[i] += weights[k] * target.positions[i];
        for (std::size_t i = 0; i < std::min(target.normals.size(), shape.normals.size()); ++i)
            shape.normals[i] += weights[k] * target.normals[i];
    }
    return shape;
}

void bend(const SoftMesh& mesh, const Skin& skin, std::span<const glm::dmat4> world_from_node,
          Shape& shape) {
    std::vector<mat4> world_from_mesh;
    for (std::size_t j = 0; j < skin.joints.size(); ++j)
        world_from_mesh.emplace_back(world_from_node[skin.joints[j]] * skin.joint_from_mesh[j]);
    for (std::size_t i = 0; i < shape.positions.size(); ++i) {
        mat4 m(0);
        for (int k = 0; k < 4; ++k)
            m += mesh.joint_weights[i][k] * world_from_mesh[mesh.joints[i][std::size_t(k)]];
        shape.positions[i] = vec3(m * vec4(shape.positions[i], 1));
        if (!shape.normals.empty())
            shape.normals[i] = transpose(inverse(mat3(m))) * shape.normals[i];
    }
}

template <class T>
std::unordered_set<std::string> names_of(const std::vector<T>& table) {
    std::unordered_set<std::string> names;
    for (const T& entry : table) names.insert(entry.name);
    return names;
}

vec3 direction_of(const glm::dmat4& world_from_node, int axis) {
    return vec3(normalize(glm::dvec3(world_from_node[axis])));
}

/// The matrix without the fourth row's rounding.
mat4 affine(const glm::dmat4& m) {
    mat4 out(m);
    for (int column = 0; column < 4; ++column) out[column].w = column == 3 ? 1.0f : 0.0f;
    return out;
}

}  // namespace

double Motion::duration() const {
    double seconds = 0;
    for (const Track& track : tracks) seconds = std::max(seconds, double(track.times.back()));
    return seconds;
}

std::vector<float> sample(const Track& track, double seconds) {
    const Between at = keys_around(track, seconds);
    std::vector<float> out(track.components);
    for (std::size_t c = 0; c < out.size(); ++c) {
        const float first = value_of(track, at.first, c);
        if (at.first == at.second || track.interpolation == Interpolation::step)
            out[c] = first;
        else if (track.interpolation == Interpolation::linear)
            out[c] = first + at.part * (value_of(track, at.second, c) - first);
        else
            out[c] = spline(track, at, c);
    }
    return out;
}

glm::quat sample_rotation(const Track& track, double seconds) {
    if (track.interpolation == Interpolation::linear) {
        const Between at = keys_around(track, seconds);
        return glm::normalize(
            glm::slerp(rotation_of(track, at.first), rotation_of(track, at.second), at.part));
    }
    const std::vector<float> v = sample(track, seconds);
    return glm::normalize(glm::quat(v[3], v[0], v[1], v[2]));
}

std::vector<glm::dmat4> node_transforms(const Motion& motion, double seconds) {
    std::vector<glm::dmat4> world;
    world.reserve(motion.nodes.size());
    for (const MotionNode& node : motion.nodes) {
        const glm::dmat4 local = local_transform(motion, node, seconds);
        world.push_back(node.parent < 0 ? local : world[std::size_t(node.parent)] * local);
    }
    return world;
}

Shape deformed_shape(const Motion& motion, const Motion::Deformed& object, double seconds,
                     std::span<const glm::dmat4> world_from_node) {
    const SoftMesh& mesh = motion.soft_meshes[object.mesh];
    const MotionNode& node = motion.nodes[object.node];
    const Track* weights = track_at(motion, node.weights_track);
    Shape shape = morphed(mesh, weights ? sample(*weights, seconds) : node.weights);
    if (object.skin >= 0)
        bend(mesh, motion.skins[std::size_t(object.skin)], world_from_node, shape);
    return shape;
}

MotionEdits edits_at(const Scene& scene, const Motion& motion, double seconds, float shape_error) {
    MotionEdits out;
    const std::vector<glm::dmat4> world = node_transforms(motion, seconds);
    const auto instances = names_of(scene.instances), lights = names_of(scene.lights),
               objects = names_of(scene.objects);
    for (const Motion::Carried& c : motion.instances)
        if (instances.contains(c.name))
            out.operations.push_back(
                SetTransform{c.name, affine(world[c.node] * c.node_from_instance)});
    for (const Motion::Carried& c : motion.lights)
        if (lights.contains(c.name))
            out.operations.push_back(SetLight{.light = c.name,
                                              .position = vec3(world[c.node][3]),
                                              .direction = -direction_of(world[c.node], 2)});
    for (const Motion::Carried& c : motion.cameras) {
        const auto held = std::ranges::find(scene.cameras, c.name, &Camera::name);
        if (held == scene.cameras.end()) continue;
        Camera camera = *held;
        camera.eye = vec3(world[c.node][3]);
        camera.at = camera.eye - length(held->at - held->eye) * direction_of(world[c.node], 2);
        camera.up = direction_of(world[c.node], 1);
        out.operations.push_back(SetCamera{camera});
    }
    for (const Motion::Deformed& d : motion.objects) {
        if (!objects.contains(d.object)) continue;
        const Shape shape = deformed_shape(motion, d, seconds, world);
        out.operations.push_back(SetShape{
            d.object,
            out.blobs.insert(shape_error > 0 ? encode_within(shape, shape_error) : encode(shape))});
    }
    return out;
}

SceneBundle bundle_at(const SceneBundle& bundle, double seconds) {
    const MotionEdits edits = edits_at(bundle.scene, bundle.motion, seconds);
    SceneBundle out{.scene = apply_edits(bundle.scene, edits.operations).scene,
                    .blobs = bundle.blobs};
    out.blobs.merge(edits.blobs);
    out.blobs.keep_only(blobs_of(out.scene));
    return out;
}

}  // namespace tessera
