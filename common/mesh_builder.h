// Shapes for generated scenes. Everything is a grid of points bent into a surface; flat shapes are
// grids of one cell, so there is one way in which triangles are made.
#pragma once

#include <functional>
#include <span>
#include <vector>

#include "common/mesh.h"

namespace tessera {

/// Gathers shapes in object space into one mesh with normals. Outsides are counter-clockwise.
/// Lengths in metres, y up.
class MeshBuilder {
public:
    struct Vertex {
        vec3 position{0};
        vec3 normal{0, 1, 0};  ///< points outside; need not be unit
        vec2 texcoord{0};
    };

    /// The slot of the shapes that follow.
    MeshBuilder& slot(std::uint16_t index);

    /// The surface through `vertex(i, j)` for i < columns, j < rows. Cells wind as the normals say;
    /// triangles without area (at poles) are left out.
    void grid(int columns, int rows, const std::function<Vertex(int, int)>& vertex);

    /// Corners counter-clockwise from the front; texture upright when `a` is the lower left one.
    void quad(const vec3& a, const vec3& b, const vec3& c, const vec3& d);
    void box(const vec3& lo, const vec3& hi);
    /// A box whose edges and corners are rounded with `steps` cells a quarter circle.
    void rounded_box(const vec3& lo, const vec3& hi, float radius, int steps = 2);
    /// The (radius, height) profile, walked so that the outside is on the right, turned around
    /// the vertical through `base`. A repeated point is a sharp edge.
    void lathe(const vec3& base, std::span<const vec2> profile, int sides);
    void cylinder(const vec3& base, float radius, float height, int sides);
    void ball(const vec3& centre, float radius, int sides);
    /// A round bar along `path`; open ends unless `closed` joins them.
    void tube(std::span<const vec3> path, float radius, int sides, bool closed = false);

    /// Hands the mesh over. Texture coordinates only where a texture will be seen: they cost
    /// memory.
    Mesh take();
    Mesh take_textured();

private:
    void triangle(std::uint32_t a, std::uint32_t b, std::uint32_t c);

    Mesh mesh_;
    std::uint16_t slot_ = 0;
};

}  // namespace tessera
