// glTF 2.0, .gltf and .glb, parsed by tinygltf; bounds, sparse accessors and pictures are ours.
//
// The node tree is flattened: every node with a mesh is an instance, and instances share the mesh.
// A glTF mesh is one Mesh whose slots are its primitives. A camera looks along its node's -z; the
// distance of `at` is the node's extra `target_distance` (which save_glb writes) or 1. glTF has no
// sides for emission: `doubleSided` surfaces emit from both. What we do not model is noted once
// each.

#include <fmt/format.h>
#include <tiny_gltf.h>

#include <algorithm>
#include <array>
#include <glm/gtc/matrix_transform.hpp>
#include <glm/gtc/quaternion.hpp>
#include <map>
#include <optional>
#include <set>

#include "common/check.h"
#include "common/clean_mesh.h"
#include "common/gltf_accessor.h"
#include "common/image_io.h"
#include "common/scene_builder.h"
#include "common/scene_io.h"
#include "common/text_reader.h"

namespace tessera {
namespace {

using tinygltf::Value;

// Extensions come as untyped values: read with a fallback --------------------------------------

const Value* member(const Value& object, const std::string& name) {
    return object.Has(name) ? &object.Get(name) : nullptr;
}

const Value* extension(const tinygltf::ExtensionMap& extensions, const std::string& name) {
    const auto it = extensions.find(name);
    return it == extensions.end() ? nullptr : &it->second;
}

double number(const Value* object, const std::string& name, double fallback) {
    const Value* value = object == nullptr ? nullptr : member(*object, name);
    return value != nullptr && value->IsNumber() ? value->GetNumberAsDouble() : fallback;
}

/// -1 when there is none.
int index_of(const Value* object, const std::string& name) {
    const double value = number(object, name, -1);
    return value >= 0 && value < 2e9 ? int(value) : -1;
}

vec2 pair(const Value& object, const std::string& name, const vec2& fallback) {
    const Value* value = member(object, name);
    if (value == nullptr || value->ArrayLen() != 2) return fallback;
    return {float(value->Get(0).GetNumberAsDouble()), float(value->Get(1).GetNumberAsDouble())};
}

vec3 colour(const std::vector<double>& rgb, const vec3& fallback) {
    return rgb.size() < 3 ? fallback : vec3(float(rgb[0]), float(rgb[1]), float(rgb[2]));
}

// ------------------------------------------------------------------------------------------------

/// tinygltf's image hook: keeps the encoded bytes. Those in a buffer view are left to us, who check
/// its bounds.
bool keep_encoded(tinygltf::Image* image, int, std::string*, std::string*, int, int,
                  const unsigned char* bytes, int size, void*) {
    image->as_is = true;
    if (image->bufferView < 0) image->image.assign(bytes, bytes + size);
    return true;
}

/// Lets tinygltf find only files in the folder that `user_data` points to.
bool exists_within(const std::string& file, void* user_data) {
    const auto& folder = *static_cast<const std::filesystem::path*>(user_data);
    return lies_within(folder, file) && tinygltf::FileExists(file, nullptr);
}

tinygltf::Model parse(const std::filesystem::path& file) {
    const std::string bytes = read_file(file);
    if (bytes.size() > std::numeric_limits<unsigned>::max())
        throw UserError(fmt::format("{}: larger than 4 GB; split the file", file.string()));
    tinygltf::TinyGLTF parser;
    parser.SetImageLoader(keep_encoded, nullptr);
    std::filesystem::path folder = file.parent_path();
    parser.SetFsCallbacks({.FileExists = exists_within,
                           .ExpandFilePath = tinygltf::ExpandFilePath,
                           .ReadWholeFile = tinygltf::ReadWholeFile,
                           .WriteWholeFile = tinygltf::WriteWholeFile,
                           .user_data = &folder});
    tinygltf::Model model;
    std::string error, warning;
    bool good = false;
    const auto size = unsigned(bytes.size());
    try {
        good =
            bytes.starts_with("glTF")
                ? parser.LoadBinaryFromMemory(&model, &error, &warning,
                                              reinterpret_cast<const unsigned char*>(bytes.data()),
                                              size, folder.string())
                : parser.LoadASCIIFromString(&model, &error, &warning, bytes.data(), size,
                                             folder.string());
    } catch (const std::exception& exception) {
        error = exception.what();
    }
    std::replace(error.begin(), error.end(), '\n', ' ');
    if (!good)
        throw UserError(
            fmt::format("{}: this is no valid glTF: {}; repair the file or export it again",
                        file.string(), error));
    return model;
}

/// Triangles of a primitive's vertex order.
std::vector<uvec3> assemble(int mode, const std::vector<std::uint32_t>& order) {
    std::vector<uvec3> triangles;
    const std::size_t n = order.size();
    if (mode == TINYGLTF_MODE_TRIANGLES) {
        for (std::size_t i = 0; i + 2 < n; i += 3)
            triangles.push_back({order[i], order[i + 1], order[i + 2]});
    } else if (mode == TINYGLTF_MODE_TRIANGLE_STRIP) {
        for (std::size_t i = 0; i + 2 < n; ++i)
            triangles.push_back({order[i], order[i + 1 + i % 2], order[i + 2 - i % 2]});
    } else {
        for (std::size_t i = 1; i + 1 < n; ++i)
            triangles.push_back({order[i], order[i + 1], order[0]});
    }
    return triangles;
}

class GltfReader {
public:
    GltfReader(const tinygltf::Model& model, const std::filesystem::path& file)
        : model_(model), file_(file.string()), accessors_(model, file_) {}

    LoadedScene read() {
        check_required_extensions();
        for (const tinygltf::Material& material : model_.materials)
            add_material(loaded_.bundle, convert(material));
        for (const tinygltf::Mesh& mesh : model_.meshes) read_mesh(mesh);
        read_nodes();
        if (!model_.animations.empty()) unmodelled("animation");
        for (std::string& note : describe(cleaning_)) loaded_.notes.push_back(std::move(note));
        if (const std::size_t unused = drop_unused_materials(loaded_.bundle.scene))
            loaded_.notes.push_back(fmt::format("dropped {} unused materials", unused));
        for (const std::string& feature : unmodelled_)
            loaded_.notes.push_back(fmt::format("not modelled, left out: {}", feature));
        check_values(loaded_.bundle.scene, file_);
        return std::move(loaded_);
    }

private:
    [[noreturn]] void broken(const std::string& what) const {
        throw UserError(fmt::format("{}: {}; repair the file or export it again", file_, what));
    }

    void unmodelled(const std::string& feature) { unmodelled_.insert(feature); }

    template <class T>
    const T& at(const std::vector<T>& table, int index, const char* what) const {
        if (index < 0 || std::size_t(index) >= table.size())
            broken(fmt::format("{} {} does not exist", what, index));
        return table[std::size_t(index)];
    }

    /// Extensions without which geometry cannot be read are refused; a missing look is a note.
    void check_required_extensions() {
        static const std::set<std::string> known{"KHR_lights_punctual", "KHR_texture_transform",
                                                 "KHR_mesh_quantization",
                                                 "EXT_mesh_gpu_instancing"};
        for (const std::string& name : model_.extensionsRequired)
            if (!known.contains(name) && !name.starts_with("KHR_materials_"))
                broken(fmt::format("it requires the extension {}, which we do not read", name));
    }

    // Materials -----------------------------------------------------------------------------------

    Material convert(const tinygltf::Material& m) {
        const auto& pbr = m.pbrMetallicRoughness;
        note_unmodelled(m);
        const double strength = number(extension(m.extensions, "KHR_materials_emissive_strength"),
                                       "emissiveStrength", 1);
        return {.name = m.name,
                .base_color = colour(pbr.baseColorFactor, vec3(1)),
                .base_color_map = map(pbr.baseColorTexture, true),
                .metallic = float(pbr.metallicFactor),
                .roughness = float(pbr.roughnessFactor),
                .metallic_roughness_map = map(pbr.metallicRoughnessTexture, false),
                .emission = colour(m.emissiveFactor, vec3(0)) * float(strength),
                .emission_map = map(m.emissiveTexture, true),
                .two_sided_emission = m.doubleSided};
    }

    void note_unmodelled(const tinygltf::Material& m) {
        if (m.alphaMode != "OPAQUE") unmodelled("alpha (surfaces are opaque)");
        if (m.normalTexture.index >= 0) unmodelled("normal maps");
        if (m.occlusionTexture.index >= 0) unmodelled("occlusion maps");
        for (const auto& [name, value] : m.extensions)
            if (name != "KHR_materials_emissive_strength") unmodelled(name);
    }

    /// The texture coordinate set that a texture reads.
    static int texcoord_set(const tinygltf::TextureInfo& info) {
        const int moved = index_of(extension(info.extensions, "KHR_texture_transform"), "texCoord");
        return moved >= 0 ? moved : info.texCoord;
    }

    TextureMap map(const tinygltf::TextureInfo& info, bool srgb) {
        if (info.index < 0) return {};
        TextureMap out{.texture = texture(info.index, srgb)};
        if (const Value* transform = extension(info.extensions, "KHR_texture_transform")) {
            out.offset = pair(*transform, "offset", out.offset);
            out.scale = pair(*transform, "scale", out.scale);
            out.rotation = float(number(transform, "rotation", 0));
        }
        return out;
    }

    std::int32_t texture(int index, bool srgb) {
        const auto [it, added] = textures_.try_emplace({index, srgb}, -1);
        if (added) it->second = read_texture(index, srgb);
        return it->second;
    }

    static Wrap wrap(int mode) {
        if (mode == TINYGLTF_TEXTURE_WRAP_CLAMP_TO_EDGE) return Wrap::clamp;
        return mode == TINYGLTF_TEXTURE_WRAP_MIRRORED_REPEAT ? Wrap::mirror : Wrap::repeat;
    }

    std::int32_t read_texture(int index, bool srgb) {
        const tinygltf::Texture& texture = at(model_.textures, index, "texture");
        if (texture.source < 0) {
            unmodelled("textures without a plain image");
            return -1;
        }
        try {
            Texture picture = decode(texture.source);
            picture.srgb = srgb;
            if (texture.sampler >= 0) {
                const auto& sampler = at(model_.samplers, texture.sampler, "sampler");
                picture.wrap_u = wrap(sampler.wrapS);
                picture.wrap_v = wrap(sampler.wrapT);
            }
            return std::int32_t(add_texture(loaded_.bundle, picture));
        } catch (const UserError& error) {
            loaded_.notes.push_back(fmt::format("texture left out: {}", error.what()));
            return -1;
        }
    }

    Texture decode(int index) const {
        const tinygltf::Image& image = at(model_.images, index, "image");
        const std::string origin =
            fmt::format("{}: image {} {}", file_, index, image.uri.substr(0, 100));
        ByteRange bytes{image.image.data(), image.image.size()};
        if (image.bufferView >= 0) bytes = buffer_view_bytes(model_, image.bufferView, origin);
        if (bytes.size == 0) throw UserError(origin + ": cannot be read; put it beside the scene");
        return decode_picture({reinterpret_cast<const std::byte*>(bytes.data), bytes.size}, origin);
    }

    // Meshes --------------------------------------------------------------------------------------

    void read_mesh(const tinygltf::Mesh& mesh) {
        Mesh whole;
        std::vector<std::uint32_t> materials;
        for (const tinygltf::Primitive& primitive : mesh.primitives) {
            Mesh part = read_primitive(primitive);
            if (part.triangles.empty()) continue;
            cleaning_ += clean_mesh(part);
            if (part.triangles.empty()) continue;
            if (materials.size() > std::numeric_limits<std::uint16_t>::max())
                broken("a mesh has more than 65536 primitives");
            part.slots.assign(part.triangles.size(), std::uint16_t(materials.size()));
            append(whole, std::move(part));
            materials.push_back(material_of(primitive));
        }
        if (whole.triangles.empty()) {
            objects_.push_back(std::nullopt);
            return;
        }
        if (materials.size() == 1) whole.slots.clear();
        objects_.push_back(add_object(loaded_.bundle, mesh.name, whole, std::move(materials)));
    }

    Mesh read_primitive(const tinygltf::Primitive& primitive) {
        if (primitive.mode >= 0 && primitive.mode < TINYGLTF_MODE_TRIANGLES) {
            unmodelled("points and lines");
            return {};
        }
        const auto position = primitive.attributes.find("POSITION");
        if (position == primitive.attributes.end()) {
            unmodelled("primitives without positions");
            return {};
        }
        if (primitive.attributes.contains("COLOR_0")) unmodelled("vertex colours");
        if (!primitive.targets.empty()) unmodelled("morph targets");
        Mesh mesh;
        mesh.positions = accessors_.vec3s(position->second);
        const auto normal = primitive.attributes.find("NORMAL");
        if (normal != primitive.attributes.end()) mesh.normals = accessors_.vec3s(normal->second);
        mesh.texcoords = read_texcoords(primitive);
        for (const std::size_t size : {mesh.normals.size(), mesh.texcoords.size()})
            if (size != 0 && size != mesh.positions.size())
                broken("a primitive's attributes differ in length");
        mesh.triangles = assemble(primitive.mode, vertex_order(primitive, mesh.positions.size()));
        return mesh;
    }

    std::vector<std::uint32_t> vertex_order(const tinygltf::Primitive& primitive,
                                            std::size_t vertices) const {
        std::vector<std::uint32_t> order;
        if (primitive.indices < 0) {
            order.resize(vertices);
            for (std::size_t i = 0; i < vertices; ++i) order[i] = std::uint32_t(i);
            return order;
        }
        order = accessors_.indices(primitive.indices);
        for (const std::uint32_t index : order)
            if (index >= vertices)
                broken(fmt::format("accessor {}: vertex {} is out of range: there are {}",
                                   primitive.indices, index, vertices));
        return order;
    }

    /// The set that the material reads, when it reads one: coordinates nobody needs are not kept.
    std::vector<vec2> read_texcoords(const tinygltf::Primitive& primitive) {
        if (primitive.material < 0) return {};
        const auto& material = at(model_.materials, primitive.material, "material");
        std::optional<int> set;
        for (const tinygltf::TextureInfo* info :
             {&material.pbrMetallicRoughness.baseColorTexture, &material.emissiveTexture,
              &material.pbrMetallicRoughness.metallicRoughnessTexture}) {
            if (info->index < 0) continue;
            if (set && *set != texcoord_set(*info))
                unmodelled("several texture coordinate sets in one material");
            if (!set) set = texcoord_set(*info);
        }
        if (!set) return {};
        const auto found = primitive.attributes.find(fmt::format("TEXCOORD_{}", *set));
        if (found == primitive.attributes.end()) return {};
        return accessors_.vec2s(found->second);
    }

    std::uint32_t material_of(const tinygltf::Primitive& primitive) {
        if (primitive.material >= 0) return std::uint32_t(primitive.material);
        // glTF's default material.
        if (!default_material_)
            default_material_ = add_material(
                loaded_.bundle, {.name = "default", .base_color = vec3(1), .metallic = 1});
        return *default_material_;
    }

    // Nodes ---------------------------------------------------------------------------------------

    std::vector<int> roots() const {
        if (!model_.scenes.empty())
            return at(model_.scenes, std::max(model_.defaultScene, 0), "scene").nodes;
        std::vector<bool> is_child(model_.nodes.size());
        for (const tinygltf::Node& node : model_.nodes)
            for (const int child : node.children)
                if (child >= 0 && std::size_t(child) < is_child.size()) is_child[child] = true;
        std::vector<int> roots;
        for (std::size_t i = 0; i < is_child.size(); ++i)
            if (!is_child[i]) roots.push_back(int(i));
        return roots;
    }

    void read_nodes() {
        struct Visit {
            int node;
            glm::dmat4 world_from_parent;
        };
        std::vector<Visit> open;
        const auto push = [&](const std::vector<int>& nodes, const glm::dmat4& world_from_parent) {
            for (auto it = nodes.rbegin(); it != nodes.rend(); ++it)
                open.push_back({*it, world_from_parent});
        };
        push(roots(), glm::dmat4(1));
        std::vector<bool> visited(model_.nodes.size());
        while (!open.empty()) {
            const Visit visit = open.back();
            open.pop_back();
            const tinygltf::Node& node = at(model_.nodes, visit.node, "node");
            if (visited[std::size_t(visit.node)])
                broken(fmt::format("node {} has two parents", visit.node));
            visited[std::size_t(visit.node)] = true;
            const glm::dmat4 world_from_node = visit.world_from_parent * local_transform(node);
            read_node(node, world_from_node);
            push(node.children, world_from_node);
        }
    }

    static glm::dmat4 local_transform(const tinygltf::Node& node) {
        glm::dmat4 m(1);
        if (node.matrix.size() == 16) {
            for (int i = 0; i < 16; ++i) m[i / 4][i % 4] = node.matrix[std::size_t(i)];
            return m;
        }
        if (const auto& t = node.translation; t.size() == 3)
            m = glm::translate(m, glm::dvec3(t[0], t[1], t[2]));
        if (const auto& r = node.rotation; r.size() == 4)
            m *= glm::mat4_cast(glm::normalize(glm::dquat(r[3], r[0], r[1], r[2])));
        if (const auto& s = node.scale; s.size() == 3)
            m = glm::scale(m, glm::dvec3(s[0], s[1], s[2]));
        return m;
    }

    void read_node(const tinygltf::Node& node, const glm::dmat4& world_from_node) {
        if (node.skin >= 0) unmodelled("skins");
        if (node.mesh >= 0) {
            const std::optional<std::uint32_t> object = at(objects_, node.mesh, "mesh");
            if (object) place(node, *object, world_from_node);
        }
        if (node.camera >= 0) read_camera(node, world_from_node);
        if (const Value* light = extension(node.extensions, "KHR_lights_punctual"))
            read_light(node, index_of(light, "light"), world_from_node);
    }

    void place(const tinygltf::Node& node, std::uint32_t object,
               const glm::dmat4& world_from_node) {
        const std::string& name =
            node.name.empty() ? loaded_.bundle.scene.objects[object].name : node.name;
        const Value* instancing = extension(node.extensions, "EXT_mesh_gpu_instancing");
        const Value* attributes = instancing ? member(*instancing, "attributes") : nullptr;
        if (attributes == nullptr) {
            add_instance(loaded_.bundle, name, object, mat4(world_from_node));
            return;
        }
        for (const glm::dmat4& node_from_instance : instance_transforms(*attributes))
            add_instance(loaded_.bundle, name, object, mat4(world_from_node * node_from_instance));
    }

    std::vector<glm::dmat4> instance_transforms(const Value& attributes) const {
        const int translation = index_of(&attributes, "TRANSLATION");
        const int rotation = index_of(&attributes, "ROTATION");
        const int scale = index_of(&attributes, "SCALE");
        std::vector<vec3> translations, scales;
        std::vector<vec4> rotations;
        if (translation >= 0) translations = accessors_.vec3s(translation);
        if (rotation >= 0) rotations = accessors_.vec4s(rotation);
        if (scale >= 0) scales = accessors_.vec3s(scale);
        const std::size_t count = std::max({translations.size(), rotations.size(), scales.size()});
        for (const std::size_t size : {translations.size(), rotations.size(), scales.size()})
            if (size != 0 && size != count) broken("instance attributes differ in length");
        std::vector<glm::dmat4> transforms(count, glm::dmat4(1));
        for (std::size_t i = 0; i < count; ++i) {
            glm::dmat4& m = transforms[i];
            if (!translations.empty()) m = glm::translate(m, glm::dvec3(translations[i]));
            if (!rotations.empty()) {
                const glm::dvec4 r(rotations[i]);
                m *= glm::mat4_cast(glm::normalize(glm::dquat(r.w, r.x, r.y, r.z)));
            }
            if (!scales.empty()) m = glm::scale(m, glm::dvec3(scales[i]));
        }
        return transforms;
    }

    void read_camera(const tinygltf::Node& node, const glm::dmat4& world_from_node) {
        const tinygltf::Camera& camera = at(model_.cameras, node.camera, "camera");
        if (camera.type != "perspective") {
            unmodelled("orthographic cameras");
            return;
        }
        const glm::dvec3 eye(world_from_node[3]);
        const glm::dvec3 forward = -glm::dvec3(world_from_node[2]);
        const double distance = number(&node.extras, "target_distance", 1);
        loaded_.bundle.scene.cameras.push_back(
            {.name = node.name.empty() ? camera.name : node.name,
             .eye = vec3(eye),
             .at = vec3(eye + normalize(forward) * distance),
             .up = vec3(normalize(glm::dvec3(world_from_node[1]))),
             .fov_y = float(glm::degrees(camera.perspective.yfov))});
    }

    void read_light(const tinygltf::Node& node, int index, const glm::dmat4& world_from_node) {
        const tinygltf::Light& light = at(model_.lights, index, "light");
        const std::map<std::string, LightKind> kinds{{"point", LightKind::point},
                                                     {"spot", LightKind::spot},
                                                     {"directional", LightKind::directional}};
        const auto kind = kinds.find(light.type);
        if (kind == kinds.end()) broken(fmt::format("light {} has no known type", index));
        loaded_.bundle.scene.lights.push_back(
            {.name = node.name.empty() ? light.name : node.name,
             .kind = kind->second,
             .position = vec3(world_from_node[3]),
             .direction = vec3(normalize(-glm::dvec3(world_from_node[2]))),
             .intensity = colour(light.color, vec3(1)) * float(light.intensity),
             .inner_angle = float(light.spot.innerConeAngle),
             .outer_angle = float(light.spot.outerConeAngle)});
    }

    const tinygltf::Model& model_;
    std::string file_;
    AccessorReader accessors_;
    LoadedScene loaded_;
    MeshCleaning cleaning_;
    std::set<std::string> unmodelled_;
    std::vector<std::optional<std::uint32_t>> objects_;  // by glTF mesh; nothing: no triangles
    std::optional<std::uint32_t> default_material_;
    std::map<std::pair<int, bool>, std::int32_t> textures_;
};

}  // namespace

LoadedScene load_gltf(const std::filesystem::path& file) {
    const tinygltf::Model model = parse(file);
    return GltfReader(model, file).read();
}

}  // namespace tessera
