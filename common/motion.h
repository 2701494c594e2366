// How the things of a scene move by themselves: a tree of nodes whose places change over time, and
// what they carry. After glTF 2.0's animations, skins and morph targets; plain data, evaluated by
// common/animate.h. It stays with who plays it: what travels is the edits.
#pragma once

#include <array>
#include <cstdint>
#include <glm/gtc/quaternion.hpp>
#include <string>
#include <vector>

#include "common/mesh.h"

namespace tessera {

enum class Interpolation : std::uint8_t { step, linear, cubic_spline };

/// Values over time: before the first key and after the last they stay as they are there.
struct Track {
    Interpolation interpolation = Interpolation::linear;
    std::uint32_t components = 3;  ///< numbers of a value
    std::vector<float> times;      ///< of the keys, seconds, increasing; at least one
    /// One value a key; cubic_spline: its tangent before, the value, its tangent after.
    std::vector<float> values;
};

/// A place relative to its parent's: moved by `translation`, turned by `rotation`, scaled.
struct MotionNode {
    static constexpr std::int32_t none = -1;

    std::int32_t parent = none;  ///< comes earlier
    glm::dmat4 fixed{1};         ///< instead of the next three, unless a track changes them
    bool is_fixed = false;
    vec3 translation{0};
    glm::quat rotation{1, 0, 0, 0};
    vec3 scale{1};
    std::vector<float> weights;  ///< of the morph targets of its mesh

    // Tracks, or none.
    std::int32_t translation_track = none;
    std::int32_t rotation_track = none;
    std::int32_t scale_track = none;
    std::int32_t weights_track = none;
};

/// Vertices of a mesh that can be put elsewhere.
struct SoftMesh {
    Shape rest;
    std::vector<Shape> targets;  ///< morph targets: what each adds; normals may be empty
    // Skin: none, or four joints a vertex and how much each counts.
    std::vector<std::array<std::uint16_t, 4>> joints;
    std::vector<vec4> joint_weights;
};

struct Skin {
    std::vector<std::uint32_t> joints;        ///< nodes
    std::vector<glm::dmat4> joint_from_mesh;  ///< one for each, at rest
};

struct Motion {
    /// What a node carries, by its name in the scene.
    struct Carried {
        std::string name;
        std::uint32_t node = 0;
        glm::dmat4 node_from_instance{1};
    };
    /// An object whose vertices move.
    struct Deformed {
        std::string object;
        std::uint32_t mesh = 0;                ///< of soft_meshes
        std::uint32_t node = 0;                ///< with the weights of its morph targets
        std::int32_t skin = MotionNode::none;  ///< its vertices are then in world space
    };

    std::vector<Track> tracks;
    std::vector<MotionNode> nodes;
    std::vector<SoftMesh> soft_meshes;
    std::vector<Skin> skins;
    std::vector<Carried> instances, lights, cameras;
    std::vector<Deformed> objects;

    bool empty() const { return tracks.empty(); }
    /// Until the last key of all, seconds.
    double duration() const;
};

}  // namespace tessera
