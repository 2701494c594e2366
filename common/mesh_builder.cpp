#include "common/mesh_builder.h"

#include <array>
#include <utility>

#include "common/clean_mesh.h"

namespace tessera {
namespace {

/// (cos, sin) of step `i` of `steps` around the circle; the last step meets the first exactly.
vec2 on_circle(int i, int steps) {
    const float angle = 2 * pi * float(i % steps) / float(steps);
    return {std::cos(angle), std::sin(angle)};
}

/// Unit normal of a profile's step, on its right hand side.
vec2 right_of(const vec2& from, const vec2& to) {
    return normalize(vec2(to.y - from.y, from.x - to.x));
}

/// The normal of profile point `i`: between its two steps, or of its one step at ends and edges.
vec2 profile_normal(std::span<const vec2> profile, std::size_t i) {
    vec2 sum{0};
    if (i > 0 && profile[i - 1] != profile[i]) sum += right_of(profile[i - 1], profile[i]);
    if (i + 1 < profile.size() && profile[i + 1] != profile[i])
        sum += right_of(profile[i], profile[i + 1]);
    return sum;
}

/// Where the `i`-th line of a rounded box's face lies along an axis, as a point of the inner box
/// (which end) and the direction in which it is pushed outwards, both in [-1, 1].
struct RoundedCoordinate {
    float end;
    float push;
};

RoundedCoordinate rounded_coordinate(int i, int steps) {
    const bool upper = i > steps;
    const float end = upper ? 1.0f : -1.0f;
    const int step = upper ? i - steps - 1 : i - steps;
    // Exact where faces meet, so that they share the points of their edge.
    if (std::abs(step) == steps) return {end, end};
    return {end, std::tan(float(step) / float(steps) * pi / 4)};
}

/// A direction across a path, nowhere along it: normal to the plane in which it bends.
vec3 across_path(std::span<const vec3> path) {
    vec3 sum{0};
    for (std::size_t i = 2; i < path.size(); ++i)
        sum += cross(path[i - 1] - path[i - 2], path[i] - path[i - 1]);
    return length(sum) > 0 ? normalize(sum) : Frame(normalize(path[1] - path[0])).s;
}

}  // namespace

MeshBuilder& MeshBuilder::slot(std::uint16_t index) {
    slot_ = index;
    return *this;
}

void MeshBuilder::triangle(std::uint32_t a, std::uint32_t b, std::uint32_t c) {
    const auto& p = mesh_.positions;
    const vec3 facing = cross(p[b] - p[a], p[c] - p[a]);
    if (p[a] == p[b] || p[b] == p[c] || p[c] == p[a] || facing == vec3(0)) return;
    const vec3 normal = mesh_.normals[a] + mesh_.normals[b] + mesh_.normals[c];
    if (dot(facing, normal) < 0) std::swap(b, c);
    mesh_.triangles.push_back({a, b, c});
    mesh_.slots.push_back(slot_);
}

void MeshBuilder::grid(int columns, int rows, const std::function<Vertex(int, int)>& vertex) {
    const auto first = std::uint32_t(mesh_.positions.size());
    for (int j = 0; j < rows; ++j)
        for (int i = 0; i < columns; ++i) {
            const Vertex v = vertex(i, j);
            mesh_.positions.push_back(v.position);
            mesh_.normals.push_back(normalize(v.normal));
            mesh_.texcoords.push_back(v.texcoord);
        }
    for (int j = 0; j + 1 < rows; ++j)
        for (int i = 0; i + 1 < columns; ++i) {
            const std::uint32_t a = first + std::uint32_t(j * columns + i);
            const std::uint32_t above = a + std::uint32_t(columns);
            triangle(a, a + 1, above + 1);
            triangle(a, above + 1, above);
        }
}

void MeshBuilder::quad(const vec3& a, const vec3& b, const vec3& c, const vec3& d) {
    const vec3 normal = cross(b - a, d - a);
    const vec3 corners[2][2] = {{a, b}, {d, c}};
    grid(2, 2, [&](int i, int j) {
        return Vertex{corners[j][i], normal, vec2(float(i), float(1 - j))};
    });
}

void MeshBuilder::box(const vec3& lo, const vec3& hi) {
    const auto p = [&](int x, int y, int z) {
        return vec3(x ? hi.x : lo.x, y ? hi.y : lo.y, z ? hi.z : lo.z);
    };
    quad(p(0, 0, 1), p(1, 0, 1), p(1, 1, 1), p(0, 1, 1));
    quad(p(1, 0, 0), p(0, 0, 0), p(0, 1, 0), p(1, 1, 0));
    quad(p(1, 0, 1), p(1, 0, 0), p(1, 1, 0), p(1, 1, 1));
    quad(p(0, 0, 0), p(0, 0, 1), p(0, 1, 1), p(0, 1, 0));
    quad(p(0, 1, 1), p(1, 1, 1), p(1, 1, 0), p(0, 1, 0));
    quad(p(0, 0, 0), p(1, 0, 0), p(1, 0, 1), p(0, 0, 1));
}

void MeshBuilder::rounded_box(const vec3& lo, const vec3& hi, float radius, int steps) {
    const vec3 centre = 0.5f * (lo + hi);
    const vec3 inner = 0.5f * (hi - lo) - radius;
    const int lines = 2 * (steps + 1);
    for (int axis = 0; axis < 3; ++axis)
        for (const float side : {-1.0f, 1.0f})
            grid(lines, lines, [&](int i, int j) {
                const RoundedCoordinate u = rounded_coordinate(i, steps);
                const RoundedCoordinate v = rounded_coordinate(j, steps);
                vec3 end(0), push(0);
                end[axis] = push[axis] = side;
                end[(axis + 1) % 3] = u.end;
                push[(axis + 1) % 3] = u.push;
                end[(axis + 2) % 3] = v.end;
                push[(axis + 2) % 3] = v.push;
                push = normalize(push);
                return Vertex{centre + end * inner + radius * push, push};
            });
}

void MeshBuilder::lathe(const vec3& base, std::span<const vec2> profile, int sides) {
    grid(sides + 1, int(profile.size()), [&](int i, int j) {
        const vec2 around = on_circle(i, sides);
        const vec2 point = profile[std::size_t(j)];
        const vec2 normal = profile_normal(profile, std::size_t(j));
        return Vertex{base + vec3(around.x * point.x, point.y, around.y * point.x),
                      vec3(around.x * normal.x, normal.y, around.y * normal.x),
                      vec2(float(i) / float(sides), float(j) / float(profile.size() - 1))};
    });
}

void MeshBuilder::cylinder(const vec3& base, float radius, float height, int sides) {
    const std::array<vec2, 6> profile{
        {{0, 0}, {radius, 0}, {radius, 0}, {radius, height}, {radius, height}, {0, height}}};
    lathe(base, profile, sides);
}

void MeshBuilder::ball(const vec3& centre, float radius, int sides) {
    const int rings = sides / 2;
    std::vector<vec2> profile;
    for (int j = 0; j <= rings; ++j) {
        const float angle = pi * float(j) / float(rings);
        const bool pole = j == 0 || j == rings;
        profile.push_back({pole ? 0 : radius * std::sin(angle), -radius * std::cos(angle)});
    }
    lathe(centre, profile, sides);
}

void MeshBuilder::tube(std::span<const vec3> path, float radius, int sides, bool closed) {
    const int count = int(path.size());
    const auto point = [&](int j) { return path[std::size_t((j + count) % count)]; };
    const vec3 s = across_path(path);
    grid(sides + 1, closed ? count + 1 : count, [&](int i, int j) {
        const vec3 ahead = closed || j + 1 < count ? point(j + 1) : point(j);
        const vec3 behind = closed || j > 0 ? point(j - 1) : point(j);
        const vec3 along = normalize(ahead - behind);
        const vec3 t = cross(along, s);
        const vec2 around = on_circle(i, sides);
        const vec3 normal = s * around.x + t * around.y;
        return Vertex{point(j) + radius * normal, normal};
    });
}

Mesh MeshBuilder::take() {
    mesh_.texcoords.clear();
    return take_textured();
}

Mesh MeshBuilder::take_textured() {
    slot_ = 0;
    clean_mesh(mesh_);
    return std::exchange(mesh_, {});
}

}  // namespace tessera
