#include "worker/surface.h"

#include <fmt/format.h>

#include <stdexcept>

#include "worker/ray_offset.h"
#include "worker/texture.h"

namespace tessera {
namespace {

template <class Decode>
auto decode_blob(const BlobStore& blobs, const BlobId& id, const char* kind, Decode decode) {
    const auto bytes = blobs.find(id);
    if (!bytes)
        throw std::runtime_error(fmt::format("{} {}: blob is missing", kind, short_name(id)));
    try {
        return decode(std::span<const std::byte>(*bytes));
    } catch (const std::runtime_error& e) {
        throw std::runtime_error(fmt::format("{} {}: {}", kind, short_name(id), e.what()));
    }
}

Box bounds_of(const Mesh& mesh) {
    Box box;
    for (const vec3& p : mesh.positions)
        if (is_finite(p)) box.add(p);
    return box;
}

template <class T>
T interpolate(const std::vector<T>& values, const uvec3& corners, const vec2& b) {
    return (1 - b.x - b.y) * values[corners.x] + b.x * values[corners.y] + b.y * values[corners.z];
}

/// `v` as a unit vector, or `fallback` where it has no direction.
vec3 unit_or(const vec3& v, const vec3& fallback) {
    const float length_squared = dot(v, v);
    return length_squared > 0 && std::isfinite(length_squared) ? v / std::sqrt(length_squared)
                                                               : fallback;
}

/// A unit normal in world space; scaled first, because edges may be tiny or huge.
vec3 world_normal(const mat3& normal_from_object, const vec3& n) {
    const float scale = std::max({std::abs(n.x), std::abs(n.y), std::abs(n.z)});
    const vec3 v = normal_from_object * (n / scale);
    const float largest = std::max({std::abs(v.x), std::abs(v.y), std::abs(v.z)});
    return unit_or(v / largest, vec3(0, 0, 1));
}

/// Sets texels that no light has to zero; returns how many.
std::uint64_t sanitise(Texture& texture) {
    std::uint64_t count = 0;
    for (vec3& texel : texture.radiance) {
        if (is_finite(texel) && texel == glm::max(texel, vec3(0))) continue;
        texel = vec3(0);
        ++count;
    }
    return count;
}

bool is_lambert(const Material& m) {
    return m.metallic == 0 && m.specular == 0 && m.transmission == 0;
}

/// Throws std::runtime_error when a triangle has no material.
void check_slots(const Object& object, const Mesh& mesh) {
    for (const std::uint16_t slot : mesh.slots)
        if (slot >= std::max<std::size_t>(object.materials.size(), 1))
            throw std::runtime_error(
                fmt::format("object {}: no material for slot {}", object.name, slot));
}

}  // namespace

Surfaces::Surfaces(const Scene& scene, const BlobStore& blobs, const Surfaces* before,
                   std::shared_ptr<const ShaderTable> shaders)
    : scene_(scene), shader_table_(std::move(shaders)) {
    validate(scene);
    decode_meshes(blobs, before);
    decode_textures(blobs, before);
    place_objects(blobs, before);
    sky_ = make_sky(before);
    if (std::ranges::any_of(scene.materials, [](const Material& m) { return !m.shader.empty(); }))
        for (const Material& m : scene.materials)
            shaders_.push_back(bind_shader(*shader_table_, m, shader_complaints_));
    for (const Instance& instance : scene.instances) {
        normal_from_object_.push_back(transpose(inverse(mat3(instance.world_from_object))));
        bounds_.add(transformed(geometry_[instance.object]->bounds, instance.world_from_object));
    }
}

void Surfaces::decode_meshes(const BlobStore& blobs, const Surfaces* before) {
    const auto decode = [&](const BlobId& id) {
        Mesh mesh = decode_blob(blobs, id, "mesh", decode_mesh);
        const Box box = bounds_of(mesh);
        return std::make_shared<const Geometry>(Geometry{std::move(mesh), box});
    };
    for (const BlobId& id : scene_.meshes) {
        const bool known = before && before->meshes_.contains(id);
        meshes_[id] = known ? before->meshes_.at(id) : decode(id);
        rest_.push_back(&meshes_[id]->mesh);
    }
}

void Surfaces::decode_textures(const BlobStore& blobs, const Surfaces* before) {
    const auto decode = [&](const BlobId& id) {
        Picture picture{.texture = decode_blob(blobs, id, "texture", decode_texture)};
        picture.sanitised = sanitise(picture.texture);
        picture.mean = mean_color(picture.texture);
        return std::make_shared<const Picture>(std::move(picture));
    };
    for (std::size_t i = 0; i < scene_.textures.size(); ++i) {
        const BlobId& id = scene_.textures[i];
        const bool known =
            before && i < before->textures_.size() && before->scene_.textures[i] == id;
        textures_.push_back(known ? before->textures_[i] : decode(id));
    }
}

void Surfaces::place_objects(const BlobStore& blobs, const Surfaces* before) {
    const auto blobs_of = [](const Surfaces& surfaces, const Object& object) {
        const Scene& scene = surfaces.scene_;
        return std::pair(scene.meshes[object.mesh],
                         object.shape < 0 ? BlobId{} : scene.shapes[std::size_t(object.shape)]);
    };
    for (std::size_t i = 0; i < scene_.objects.size(); ++i) {
        const Object& object = scene_.objects[i];
        const auto& rest = meshes_.at(scene_.meshes[object.mesh]);
        const Object* earlier =
            before && i < before->geometry_.size() ? &before->scene_.objects[i] : nullptr;
        const bool known = earlier && blobs_of(*before, *earlier) == blobs_of(*this, object);
        if (!known || earlier->materials.size() != object.materials.size())
            check_slots(object, rest->mesh);
        if (object.shape < 0 || known) {
            geometry_.push_back(object.shape < 0 ? rest : before->geometry_[i]);
            continue;
        }
        const BlobId& id = scene_.shapes[std::size_t(object.shape)];
        Mesh mesh = decode_blob(blobs, id, "shape", [&](std::span<const std::byte> bytes) {
            return reshaped(rest->mesh, decode_shape(bytes));
        });
        const Box box = bounds_of(mesh);
        geometry_.push_back(std::make_shared<const Geometry>(Geometry{std::move(mesh), box}));
    }
}

std::shared_ptr<const Sky> Surfaces::make_sky(const Surfaces* before) const {
    const Environment& environment = scene_.environment;
    const auto picture_of = [](const Surfaces& surfaces) -> const Picture* {
        const std::int32_t texture = surfaces.scene_.environment.texture;
        return texture < 0 ? nullptr : surfaces.textures_[std::size_t(texture)].get();
    };
    const Picture* picture = picture_of(*this);
    if (before && before->scene_.environment == environment && picture_of(*before) == picture)
        return before->sky_;
    return std::make_shared<const Sky>(environment, picture ? &picture->texture : nullptr);
}

std::vector<TracerObject> Surfaces::tracer_objects() const {
    std::vector<TracerObject> out;
    for (std::size_t i = 0; i < geometry_.size(); ++i)
        out.push_back({geometry_[i]->mesh.positions, geometry_[i]->mesh.triangles,
                       scene_.objects[i].shape >= 0});
    return out;
}

std::vector<TracerInstance> Surfaces::tracer_instances() const {
    std::vector<TracerInstance> out;
    for (const Instance& instance : scene_.instances)
        out.push_back({instance.object, instance.world_from_object, instance.moves});
    return out;
}

const Mesh& Surfaces::mesh_of(std::uint32_t instance) const {
    return geometry_[object_of(instance)]->mesh;
}

std::uint64_t Surfaces::sanitised_texels() const {
    std::uint64_t sum = 0;
    for (const auto& picture : textures_) sum += picture->sanitised;
    return sum;
}

bool Surfaces::emits(std::uint32_t instance) const {
    return std::ranges::any_of(scene_.objects[object_of(instance)].materials, [&](std::uint32_t m) {
        return scene_.materials[m].emission != vec3(0);
    });
}

std::uint32_t Surfaces::triangle_count(std::uint32_t instance) const {
    return std::uint32_t(mesh_of(instance).triangles.size());
}

const Material& Surfaces::material(std::uint32_t instance, std::uint32_t triangle) const {
    static const Material plain;
    const Object& object = scene_.objects[object_of(instance)];
    if (object.materials.empty()) return plain;
    const Mesh& mesh = mesh_of(instance);
    return scene_.materials[object.materials[mesh.slots.empty() ? 0 : mesh.slots[triangle]]];
}

WorldTriangle Surfaces::triangle(std::uint32_t instance, std::uint32_t index) const {
    const Mesh& mesh = mesh_of(instance);
    const uvec3 corners = mesh.triangles[index];
    const auto world = [&](std::uint32_t i) {
        return vec3(scene_.instances[instance].world_from_object * vec4(mesh.positions[i], 1));
    };
    const vec3 p0 = mesh.positions[corners.x];
    const vec3 n = cross(mesh.positions[corners.y] - p0, mesh.positions[corners.z] - p0);
    WorldTriangle t{world(corners.x), world(corners.y), world(corners.z),
                    world_normal(normal_from_object_[instance], n)};
    return t;
}

float WorldTriangle::area() const { return 0.5f * length(cross(p1 - p0, p2 - p0)); }

vec3 WorldTriangle::off_front() const {
    // Measured from the origin the offset depends on the triangle's largest coordinate alone.
    return offset_point(vec3(0), ng, ng, std::max({magnitude(p0), magnitude(p1), magnitude(p2)}));
}

vec2 Surfaces::texcoord(const Mesh& mesh, const uvec3& corners, const vec2& b) const {
    return mesh.texcoords.empty() ? vec2(0) : interpolate(mesh.texcoords, corners, b);
}

vec4 Surfaces::color(const TextureMap& map, const vec2& uv) const {
    return map.texture < 0 ? vec4(1) : lookup(textures_[map.texture]->texture, apply(map, uv));
}

vec3 Surfaces::emission(std::uint32_t instance, std::uint32_t triangle, const vec2& b) const {
    const Material& m = material(instance, triangle);
    const Mesh& mesh = mesh_of(instance);
    const vec2 uv = texcoord(mesh, mesh.triangles[triangle], b);
    const vec3 emission = m.emission * vec3(color(m.emission_map, uv));
    return m.alpha_mode == AlphaMode::opaque ? emission : emission * coverage(m, uv);
}

float Surfaces::coverage(const Material& m, const vec2& uv) const {
    const float alpha = m.alpha * color(m.base_color_map, uv).a;
    if (m.alpha_mode == AlphaMode::blend) return alpha;
    return m.alpha_mode == AlphaMode::opaque || alpha >= m.alpha_cutoff ? 1 : 0;
}

float Surfaces::coverage(std::uint32_t instance, std::uint32_t triangle, const vec2& b) const {
    const Material& m = material(instance, triangle);
    if (m.alpha_mode == AlphaMode::opaque) return 1;
    const Mesh& mesh = mesh_of(instance);
    return coverage(m, texcoord(mesh, mesh.triangles[triangle], b));
}

vec3 Surfaces::mean_emission(const Material& m) const {
    return m.emission_map.texture < 0 ? m.emission
                                      : m.emission * textures_[m.emission_map.texture]->mean;
}

SurfaceLook Surfaces::look(const Material& m, const vec2& uv) const {
    SurfaceLook look{.base_color = m.base_color * vec3(color(m.base_color_map, uv)),
                     .metallic = m.metallic,
                     .roughness = m.roughness,
                     .specular = m.specular,
                     .ior = m.ior,
                     .transmission = m.transmission,
                     .thin_walled = m.thin_walled};
    if (m.metallic_roughness_map.texture >= 0) {
        const vec4 texel = color(m.metallic_roughness_map, uv);
        look.metallic *= texel.b;
        look.roughness *= texel.g;
    }
    if (m.transmission_map.texture >= 0) look.transmission *= color(m.transmission_map, uv).r;
    return look;
}

bool Surfaces::has_rest(const Material& m) const {
    const bool glossy = m.metallic > 0 || m.specular > 0;
    const bool mapped = m.metallic_roughness_map.texture >= 0;
    return m.transmission > 0 || shader_of(m).may(TESSERA_SHADER_RESHAPES) ||
           (glossy && (mapped || m.roughness * m.roughness < Bsdf::narrow_alpha));
}

bool Surfaces::may_be_ideal(const Material& m) const {
    const float least_roughness = m.metallic_roughness_map.texture >= 0 ? 0 : m.roughness;
    return m.transmission > 0 || is_mirror(m.metallic, least_roughness) ||
           shader_of(m).may(TESSERA_SHADER_RESHAPES);
}

/// `n`, on the front of `t`, as the normal map tilts it.
vec3 Surfaces::bumped(const Material& m, const WorldTriangle& t, const Mesh& mesh,
                      const uvec3& corners, const vec2& uv, const vec3& n) const {
    if (mesh.texcoords.empty()) return n;
    // How the place moves with u and v tells the tangents; green runs against v.
    const vec2 uv0 = apply(m.normal_map, mesh.texcoords[corners.x]);
    const vec2 d1 = apply(m.normal_map, mesh.texcoords[corners.y]) - uv0;
    const vec2 d2 = apply(m.normal_map, mesh.texcoords[corners.z]) - uv0;
    const float area = d1.x * d2.y - d1.y * d2.x;
    const float sign = std::copysign(1.0f, area);
    const vec3 along_u = sign * ((t.p1 - t.p0) * d2.y - (t.p2 - t.p0) * d1.y);
    const vec3 along_v = sign * ((t.p2 - t.p0) * d1.x - (t.p1 - t.p0) * d2.x);
    const vec3 tangent = unit_or(along_u - n * dot(n, along_u), vec3(0));
    if (area == 0 || tangent == vec3(0)) return n;
    const vec3 across = cross(n, tangent);
    const vec3 bitangent = dot(across, along_v) > 0 ? -across : across;
    const vec3 texel = 2.0f * vec3(color(m.normal_map, uv)) - 1.0f;
    return unit_or(m.normal_scale * (texel.x * tangent + texel.y * bitangent) + texel.z * n, n);
}

SurfacePoint Surfaces::at(const Ray& ray, const Hit& hit) const {
    const WorldTriangle t = triangle(hit.instance, hit.triangle);
    SurfacePoint s;
    find(ray, hit, t, t.off_front(), 0, s);
    return s;
}

void Surfaces::find(const Ray& ray, const Hit& hit, TriangleCache& cache, SurfacePoint& s,
                    float pixel) const {
    const TriangleCache::Entry& entry = cached(hit, cache);
    find(ray, hit, entry.shape, entry.off_front, pixel, s);
}

const BoundShader& Surfaces::shader_of(const Material& m) const {
    static const BoundShader none;
    return m.shader.empty() ? none : shaders_[std::size_t(&m - scene_.materials.data())];
}

/// What the material's shader makes of the point; tilts the normal of `s`.
Bsdf Surfaces::shaded(const Material& m, const Hit& hit, const WorldTriangle& t, const vec2& uv,
                      float pixel, bool front, SurfacePoint& s) const {
    // The texture sticks to the object when it deforms: it is that of the mesh at rest.
    const Object& object = scene_.objects[object_of(hit.instance)];
    const Mesh& rest = *rest_[object.mesh];
    const uvec3 corners = rest.triangles[hit.triangle];
    const vec3 p0 = rest.positions[corners.x];
    const vec3 e1 = rest.positions[corners.y] - p0, e2 = rest.positions[corners.z] - p0;
    const vec3 p = p0 + hit.u * e1 + hit.v * e2;
    const vec3 n = unit_or(cross(e1, e2), vec3(0, 1, 0));
    const vec3 w1 = t.p1 - t.p0, w2 = t.p2 - t.p0;
    const float rest_size = dot(e1, e1) + dot(e2, e2), size = dot(w1, w1) + dot(w2, w2);
    const float world_from_rest = rest_size > 0 ? std::sqrt(size / rest_size) : 1;

    // A round filter as large as the ellipse that the pixel sees.
    const float slant = std::sqrt(std::max(dot(s.ng, s.wo), 1.0f / 64));
    SurfaceLook plain = look(m, uv);
    tessera_shading point{
        .position = {p.x, p.y, p.z},
        .normal = {n.x, n.y, n.z},
        .uv = {uv.x, uv.y},
        .footprint = world_from_rest > 0 ? pixel / (slant * world_from_rest) : 0,
        .base_color = {plain.base_color.x, plain.base_color.y, plain.base_color.z},
        .roughness = plain.roughness,
        .metallic = plain.metallic,
        .specular = plain.specular,
        .transmission = plain.transmission,
        .slope = {}};
    const BoundShader& shader = shader_of(m);
    shader.shade(point);

    const vec3 slope(point.slope[0], point.slope[1], point.slope[2]);
    if (slope != vec3(0)) {
        const vec3 g = world_from_rest * (normal_from_object_[hit.instance] * slope);
        const vec3 outward = front ? s.n : -s.n;
        const vec3 tilted = unit_or(outward - (g - outward * dot(outward, g)), outward);
        const vec3 facing = front ? tilted : -tilted;
        if (dot(facing, s.wo) > 0) s.n = facing;
    }
    plain.base_color = {point.base_color[0], point.base_color[1], point.base_color[2]};
    if (shader.may(TESSERA_SHADER_ROUGHENS))
        plain.roughness = std::max(plain.roughness, point.roughness);
    if (shader.may(TESSERA_SHADER_RESHAPES)) {
        plain.roughness = point.roughness;
        plain.metallic = point.metallic;
        plain.specular = point.specular;
        plain.transmission = point.transmission;
    } else if (is_lambert(m)) {
        return lambert_bsdf(plain.base_color);
    }
    return make_bsdf(plain, dot(s.n, s.wo), front);
}

const TriangleCache::Entry& Surfaces::cached(const Hit& hit, TriangleCache& cache) const {
    const std::size_t place = (hit.triangle + 7 * hit.instance) % cache.entries.size();
    TriangleCache::Entry& entry = cache.entries[place];
    if (entry.instance != hit.instance || entry.triangle != hit.triangle) {
        const WorldTriangle t = triangle(hit.instance, hit.triangle);
        entry = {hit.instance, hit.triangle, t, t.off_front()};
    }
    return entry;
}

/// `t` is what the ray hit; `s` is as made.
void Surfaces::find(const Ray& ray, const Hit& hit, const WorldTriangle& t, const vec3& off_front,
                    float pixel, SurfacePoint& s) const {
    const Mesh& mesh = mesh_of(hit.instance);
    const uvec3 corners = mesh.triangles[hit.triangle];
    const Material& m = material(hit.instance, hit.triangle);
    const mat3& normal_from_object = normal_from_object_[hit.instance];
    const vec2 b(hit.u, hit.v);

    // Barycentric weights keep the point on the triangle; org + t * dir would lose digits with
    // distance.
    s.p = t.point(b);
    s.wo = -normalize(ray.dir);
    const bool front = dot(t.ng, s.wo) > 0;
    s.ng = front ? t.ng : -t.ng;
    s.org = front ? s.p + off_front : s.p - off_front;

    // Shade with the interpolated normal where it faces the viewer as the triangle does.
    s.n = s.ng;
    if (!mesh.normals.empty()) {
        const vec3 n = unit_or(normal_from_object * interpolate(mesh.normals, corners, b), s.ng);
        s.n = dot(n, s.ng) < 0 ? -n : n;
        if (!(dot(s.n, s.wo) > 0)) s.n = s.ng;
    }

    const vec2 uv = texcoord(mesh, corners, b);
    if (m.normal_map.texture >= 0) {
        const vec3 n = bumped(m, t, mesh, corners, uv, front ? s.n : -s.n);
        if (dot(front ? n : -n, s.wo) > 0) s.n = front ? n : -n;
    }
    if (shader_of(m).shader) [[unlikely]]
        s.bsdf = shaded(m, hit, t, uv, pixel, front, s);
    else
        s.bsdf = is_lambert(m) ? lambert_bsdf(m.base_color * vec3(color(m.base_color_map, uv)))
                               : make_bsdf(look(m, uv), dot(s.n, s.wo), front);
    if (front || m.two_sided_emission) s.emission = m.emission * vec3(color(m.emission_map, uv));
}

}  // namespace tessera
