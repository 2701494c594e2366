// glTF 2.0, .gltf and .glb, parsed by tinygltf; bounds, sparse accessors and pictures are ours.
//
// The node tree is flattened: every node with a mesh is an instance, and instances share the mesh.
// A glTF mesh is one Mesh whose slots are its primitives. A camera looks along its node's -z; the
// distance of `at` is the node's extra `target_distance` (which save_glb writes) or 1. glTF has no
// sides for emission: `doubleSided` surfaces emit from both. What we do not model is noted once
// each.
//
// Animations become one Motion: all play at once, and of two that change the same thing the first
// wins. A node whose mesh has morph targets or a skin is an object of its own, with the mesh's
// vertices as the file has them: what has no area now may have some later.

#include <fmt/format.h>
#include <tiny_gltf.h>

#include <algorithm>
#include <array>
#include <glm/gtc/matrix_transform.hpp>
#include <glm/gtc/quaternion.hpp>
#include <map>
#include <optional>
#include <set>

#include "common/animate.h"
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
        find_soft_meshes();
        for (std::size_t i = 0; i < model_.meshes.size(); ++i)
            is_soft_[i] ? read_soft_mesh(model_.meshes[i]) : read_mesh(model_.meshes[i]);
        read_animations();
        read_nodes();
        read_skins();
        shape_objects();
        name_what_moves();
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
        Material out{.name = m.name,
                     .base_color = colour(pbr.baseColorFactor, vec3(1)),
                     .base_color_map = map(pbr.baseColorTexture, true),
                     .metallic = float(pbr.metallicFactor),
                     .roughness = float(pbr.roughnessFactor),
                     .metallic_roughness_map = map(pbr.metallicRoughnessTexture, false)};
        out.specular =
            float(number(extension(m.extensions, "KHR_materials_specular"), "specularFactor", 1));
        // Zero stands for an index without bound, which reflects all; 1 for no surface.
        const double ior = number(extension(m.extensions, "KHR_materials_ior"), "ior", 1.5);
        out.ior = ior == 0 ? 1e4f : float(std::max(ior, 1.0));
        read_transmission(m, out);
        read_alpha(m, out);
        out.normal_map = map(plain_info(m.normalTexture), false);
        out.normal_scale = float(m.normalTexture.scale);
        out.emission = colour(m.emissiveFactor, vec3(0)) * float(strength);
        out.emission_map = map(m.emissiveTexture, true);
        out.two_sided_emission = m.doubleSided;
        read_shader(m.extras, out);
        return out;
    }

    /// As save_glb() writes it; what is written otherwise is somebody else's.
    static void read_shader(const Value& extras, Material& out) {
        const Value* shader = member(extras, "shader");
        if (shader == nullptr || !shader->IsString()) return;
        out.shader = shader->Get<std::string>();
        const Value* parameters = member(extras, "shader_parameters");
        if (parameters == nullptr) return;
        for (std::size_t i = 0; i < std::min(parameters->ArrayLen(), most_shader_parameters); ++i) {
            const Value& parameter = parameters->Get(int(i));
            const Value* name = member(parameter, "name");
            const Value* value = member(parameter, "value");
            if (name == nullptr || !name->IsString() || value == nullptr || value->ArrayLen() != 3)
                continue;
            vec3 numbers;
            for (int c = 0; c < 3; ++c) numbers[c] = float(value->Get(c).GetNumberAsDouble());
            out.shader_parameters.push_back({name->Get<std::string>(), numbers});
        }
    }

    static void read_alpha(const tinygltf::Material& m, Material& out) {
        if (m.alphaMode == "MASK") out.alpha_mode = AlphaMode::mask;
        if (m.alphaMode == "BLEND") out.alpha_mode = AlphaMode::blend;
        const auto& factor = m.pbrMetallicRoughness.baseColorFactor;
        if (out.alpha_mode != AlphaMode::opaque && factor.size() == 4) out.alpha = float(factor[3]);
        out.alpha_cutoff = float(m.alphaCutoff);
    }

    /// Without a thickness the surface is a pane (KHR_materials_volume).
    void read_transmission(const tinygltf::Material& m, Material& out) {
        const Value* transmission = extension(m.extensions, "KHR_materials_transmission");
        if (transmission == nullptr) return;
        out.transmission = float(number(transmission, "transmissionFactor", 0));
        out.thin_walled =
            !(number(extension(m.extensions, "KHR_materials_volume"), "thicknessFactor", 0) > 0);
        if (const Value* texture = member(*transmission, "transmissionTexture"))
            out.transmission_map = map(texture_info(*texture), false);
    }

    static tinygltf::TextureInfo plain_info(const tinygltf::NormalTextureInfo& normal) {
        tinygltf::TextureInfo info;
        info.index = normal.index;
        info.texCoord = normal.texCoord;
        info.extensions = normal.extensions;
        return info;
    }

    /// A texture that an extension names.
    static tinygltf::TextureInfo texture_info(const Value& value) {
        tinygltf::TextureInfo info;
        info.index = index_of(&value, "index");
        info.texCoord = std::max(index_of(&value, "texCoord"), 0);
        if (const Value* extensions = member(value, "extensions"))
            if (const Value* transform = member(*extensions, "KHR_texture_transform"))
                info.extensions["KHR_texture_transform"] = *transform;
        return info;
    }

    void note_unmodelled(const tinygltf::Material& m) {
        static const std::set<std::string> modelled_extensions{
            "KHR_materials_emissive_strength", "KHR_materials_ior", "KHR_materials_specular",
            "KHR_materials_transmission", "KHR_materials_volume"};
        if (m.occlusionTexture.index >= 0) unmodelled("occlusion maps");
        for (const auto& [name, value] : m.extensions)
            if (!modelled_extensions.contains(name)) unmodelled(name);
        const Value* volume = extension(m.extensions, "KHR_materials_volume");
        if (volume != nullptr && member(*volume, "attenuationColor") != nullptr)
            unmodelled("colour of bodies of glass (attenuationColor)");
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

    static std::vector<tinygltf::TextureInfo> textures_of(const tinygltf::Material& m) {
        std::vector<tinygltf::TextureInfo> all{
            m.pbrMetallicRoughness.baseColorTexture, m.emissiveTexture,
            m.pbrMetallicRoughness.metallicRoughnessTexture, plain_info(m.normalTexture)};
        const Value* transmission = extension(m.extensions, "KHR_materials_transmission");
        const Value* map = transmission ? member(*transmission, "transmissionTexture") : nullptr;
        if (map != nullptr) all.push_back(texture_info(*map));
        return all;
    }

    /// The set that the material reads, when it reads one: coordinates nobody needs are not kept.
    std::vector<vec2> read_texcoords(const tinygltf::Primitive& primitive) {
        if (primitive.material < 0) return {};
        std::optional<int> set;
        for (const tinygltf::TextureInfo& info :
             textures_of(at(model_.materials, primitive.material, "material"))) {
            if (info.index < 0) continue;
            if (set && *set != texcoord_set(info))
                unmodelled("several texture coordinate sets in one material");
            if (!set) set = texcoord_set(info);
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
                loaded_.bundle,
                {.name = "default", .base_color = vec3(1), .metallic = 1, .specular = 1});
        return *default_material_;
    }

    // What deforms --------------------------------------------------------------------------------

    /// A mesh whose vertices can move, and its look.
    struct Soft {
        Mesh mesh;
        SoftMesh motion;
        std::vector<std::uint32_t> materials;
    };

    void find_soft_meshes() {
        is_soft_.resize(model_.meshes.size());
        for (std::size_t i = 0; i < model_.meshes.size(); ++i)
            for (const tinygltf::Primitive& primitive : model_.meshes[i].primitives)
                if (!primitive.targets.empty()) is_soft_[i] = true;
        for (const tinygltf::Node& node : model_.nodes)
            if (node.skin >= 0 && node.mesh >= 0 && std::size_t(node.mesh) < is_soft_.size())
                is_soft_[std::size_t(node.mesh)] = true;
    }

    void read_soft_mesh(const tinygltf::Mesh& mesh) {
        Soft soft;
        std::vector<Mesh> parts;
        bool smooth = true;
        for (const tinygltf::Primitive& primitive : mesh.primitives) {
            Mesh part = read_primitive(primitive);
            if (part.triangles.empty()) continue;
            if (soft.materials.size() > std::numeric_limits<std::uint16_t>::max())
                broken("a mesh has more than 65536 primitives");
            part.slots.assign(part.triangles.size(), std::uint16_t(soft.materials.size()));
            smooth = smooth && !part.normals.empty();
            soft.materials.push_back(material_of(primitive));
            read_targets(primitive, soft.motion, soft_vertices(parts), part.positions.size());
            read_joints(primitive, soft.motion, soft_vertices(parts), part.positions.size());
            parts.push_back(std::move(part));
        }
        for (Mesh& part : parts) {
            if (!smooth) part.normals.clear();
            append(soft.mesh, std::move(part));
        }
        if (soft.materials.size() == 1) soft.mesh.slots.clear();
        soft.motion.rest = {soft.mesh.positions, soft.mesh.normals};
        soft_of_mesh_[objects_.size()] = std::move(soft);
        objects_.push_back(std::nullopt);
    }

    static std::size_t soft_vertices(const std::vector<Mesh>& parts) {
        std::size_t count = 0;
        for (const Mesh& part : parts) count += part.positions.size();
        return count;
    }

    /// Appends what the primitive's targets add to each of its vertices, behind `first` others.
    void read_targets(const tinygltf::Primitive& primitive, SoftMesh& mesh, std::size_t first,
                      std::size_t count) {
        if (mesh.targets.size() < primitive.targets.size())
            mesh.targets.resize(primitive.targets.size());
        for (std::size_t k = 0; k < mesh.targets.size(); ++k) {
            const auto read = [&](const char* attribute, std::vector<vec3>& values) {
                std::vector<vec3> added;
                if (k < primitive.targets.size())
                    if (const auto found = primitive.targets[k].find(attribute);
                        found != primitive.targets[k].end())
                        added = accessors_.vec3s(found->second);
                if (!added.empty() && added.size() != count)
                    broken("a morph target and its primitive differ in length");
                values.resize(first);
                values.insert(values.end(), added.begin(), added.end());
                values.resize(first + count);
            };
            read("POSITION", mesh.targets[k].positions);
            read("NORMAL", mesh.targets[k].normals);
        }
    }

    void read_joints(const tinygltf::Primitive& primitive, SoftMesh& mesh, std::size_t first,
                     std::size_t count) {
        const auto joints = primitive.attributes.find("JOINTS_0");
        const auto weights = primitive.attributes.find("WEIGHTS_0");
        mesh.joints.resize(first + count);
        mesh.joint_weights.resize(first + count);
        if (joints == primitive.attributes.end() || weights == primitive.attributes.end()) return;
        if (primitive.attributes.contains("JOINTS_1"))
            unmodelled("more than four joints at a vertex");
        const std::vector<vec4> which = accessors_.vec4s(joints->second);
        const std::vector<vec4> much = accessors_.vec4s(weights->second);
        if (which.size() != count || much.size() != count)
            broken("a primitive's attributes differ in length");
        for (std::size_t i = 0; i < count; ++i) {
            const float sum = much[i].x + much[i].y + much[i].z + much[i].w;
            mesh.joint_weights[first + i] = sum > 0 ? much[i] / sum : vec4(0);
            for (int k = 0; k < 4; ++k) {
                if (!(which[i][k] >= 0 && which[i][k] < 65536)) broken("a joint is out of range");
                mesh.joints[first + i][std::size_t(k)] = std::uint16_t(which[i][k]);
            }
        }
    }

    /// An object of this node alone; its shape comes when all joints are known.
    std::uint32_t add_soft_object(const tinygltf::Node& node, const Soft& soft) {
        Motion& motion = loaded_.bundle.motion;
        const std::string& mesh_name = model_.meshes[std::size_t(node.mesh)].name;
        const std::uint32_t object = add_object(
            loaded_.bundle, node.name.empty() ? mesh_name : node.name, soft.mesh, soft.materials);
        const auto [mesh, added] =
            soft_index_.try_emplace(node.mesh, std::uint32_t(motion.soft_meshes.size()));
        if (added) motion.soft_meshes.push_back(soft.motion);
        deformed_.push_back(
            {object,
             {.object = {}, .mesh = mesh->second, .node = motion_node_, .skin = node.skin}});
        return object;
    }

    void read_skins() {
        Motion& motion = loaded_.bundle.motion;
        for (const tinygltf::Skin& skin : model_.skins) {
            Skin& out = motion.skins.emplace_back();
            if (skin.inverseBindMatrices >= 0)
                out.joint_from_mesh = accessors_.mat4s(skin.inverseBindMatrices);
            else
                out.joint_from_mesh.resize(skin.joints.size(), glm::dmat4(1));
            if (out.joint_from_mesh.size() < skin.joints.size())
                broken("a skin has fewer matrices than joints");
            for (const int joint : skin.joints) {
                at(model_.nodes, joint, "node");
                const auto found = motion_nodes_.find(joint);
                if (found == motion_nodes_.end()) broken("a joint of a skin is not in the scene");
                out.joints.push_back(found->second);
            }
        }
        for (auto& [object, deformed] : deformed_) {
            if (deformed.skin < 0) continue;
            const Skin& skin = at(motion.skins, deformed.skin, "skin");
            for (const auto& joints : motion.soft_meshes[deformed.mesh].joints)
                for (const std::uint16_t joint : joints)
                    if (joint >= skin.joints.size()) broken("a vertex has a joint beyond its skin");
        }
    }

    /// Puts vertices where they are at rest: for good, if nothing moves them.
    void shape_objects() {
        SceneBundle& bundle = loaded_.bundle;
        Motion rest = bundle.motion;
        for (MotionNode& node : rest.nodes)
            node.translation_track = node.rotation_track = node.scale_track = node.weights_track =
                MotionNode::none;
        const std::vector<glm::dmat4> world_from_node = node_transforms(rest, 0);
        for (const auto& [index, deformed] : deformed_) {
            const Shape shape = deformed_shape(rest, deformed, 0, world_from_node);
            Object& object = bundle.scene.objects[index];
            if (deforms(deformed)) {
                object.shape = std::int32_t(add_shape(bundle, shape));
            } else {
                const Mesh& mesh = soft_of_mesh_.at(mesh_of_soft(deformed.mesh)).mesh;
                object.mesh = add_mesh(bundle, reshaped(mesh, shape));
            }
        }
    }

    bool deforms(const Motion::Deformed& deformed) const {
        const Motion& motion = loaded_.bundle.motion;
        return !motion.empty() &&
               (deformed.skin >= 0 || motion.nodes[deformed.node].weights_track >= 0);
    }

    std::size_t mesh_of_soft(std::uint32_t soft) const {
        const auto found = std::ranges::find(soft_index_, soft, [](auto& e) { return e.second; });
        return std::size_t(found->first);
    }

    // Animations ----------------------------------------------------------------------------------

    /// Tracks of a node, as MotionNode has them.
    struct NodeTracks {
        std::int32_t translation = MotionNode::none, rotation = MotionNode::none,
                     scale = MotionNode::none, weights = MotionNode::none;
    };

    void read_animations() {
        for (const tinygltf::Animation& animation : model_.animations)
            for (const tinygltf::AnimationChannel& channel : animation.channels)
                read_channel(at(animation.samplers, channel.sampler, "sampler"), channel);
    }

    void read_channel(const tinygltf::AnimationSampler& sampler,
                      const tinygltf::AnimationChannel& channel) {
        if (channel.target_node < 0) return unmodelled("animation of what is no node");
        NodeTracks& tracks = tracks_[channel.target_node];
        const std::map<std::string, std::int32_t NodeTracks::*> places{
            {"translation", &NodeTracks::translation},
            {"rotation", &NodeTracks::rotation},
            {"scale", &NodeTracks::scale},
            {"weights", &NodeTracks::weights}};
        const auto place = places.find(channel.target_path);
        if (place == places.end())
            return unmodelled(fmt::format("animation of `{}`", channel.target_path));
        std::int32_t& track = tracks.*place->second;
        if (track != MotionNode::none)
            return unmodelled("a second animation of what one animates already");
        track = std::int32_t(loaded_.bundle.motion.tracks.size());
        const std::uint32_t components = channel.target_path == "rotation"  ? 4
                                         : channel.target_path == "weights" ? 0
                                                                            : 3;
        loaded_.bundle.motion.tracks.push_back(read_track(sampler, components));
    }

    /// `components` 0: as many as there are.
    Track read_track(const tinygltf::AnimationSampler& sampler, std::uint32_t components) const {
        Track track{.components = components,
                    .times = accessors_.floats(sampler.input),
                    .values = accessors_.floats(sampler.output)};
        if (sampler.interpolation == "STEP") track.interpolation = Interpolation::step;
        if (sampler.interpolation == "CUBICSPLINE")
            track.interpolation = Interpolation::cubic_spline;
        const std::size_t values =
            track.times.size() * (track.interpolation == Interpolation::cubic_spline ? 3 : 1);
        if (components == 0 && values > 0)
            track.components = std::uint32_t(track.values.size() / values);
        const auto is_finite = [](float v) { return std::isfinite(v); };
        const auto not_later = [](float a, float b) { return !(a < b); };
        if (track.times.empty() || track.components == 0 ||
            track.values.size() != values * track.components ||
            !std::ranges::all_of(track.values, is_finite) ||
            !std::ranges::all_of(track.times, is_finite) ||
            std::ranges::adjacent_find(track.times, not_later) != track.times.end())
            broken(fmt::format("the keys of an animation (accessors {} and {}) are malformed",
                               sampler.input, sampler.output));
        return track;
    }

    /// What moves is named once all names are unique; a scene that stands still needs no motion.
    void name_what_moves() {
        Scene& scene = loaded_.bundle.scene;
        Motion& motion = loaded_.bundle.motion;
        if (motion.empty()) {
            motion = {};
            return;
        }
        make_names_unique(scene);
        const auto name = [](std::vector<Motion::Carried>& carried, const auto& table,
                             const std::vector<std::size_t>& indices) {
            for (std::size_t i = 0; i < carried.size(); ++i)
                carried[i].name = table[indices[i]].name;
        };
        name(motion.instances, scene.instances, carried_instances_);
        name(motion.lights, scene.lights, carried_lights_);
        name(motion.cameras, scene.cameras, carried_cameras_);
        for (auto& [index, deformed] : deformed_) {
            if (!deforms(deformed)) continue;
            deformed.object = scene.objects[index].name;
            motion.objects.push_back(deformed);
        }
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
            std::int32_t parent;
            bool moves;
        };
        std::vector<Visit> open;
        const auto push = [&](const std::vector<int>& nodes, const glm::dmat4& world_from_parent,
                              std::int32_t parent, bool moves) {
            for (auto it = nodes.rbegin(); it != nodes.rend(); ++it)
                open.push_back({*it, world_from_parent, parent, moves});
        };
        push(roots(), glm::dmat4(1), MotionNode::none, false);
        std::vector<bool> visited(model_.nodes.size());
        while (!open.empty()) {
            const Visit visit = open.back();
            open.pop_back();
            const tinygltf::Node& node = at(model_.nodes, visit.node, "node");
            if (visited[std::size_t(visit.node)])
                broken(fmt::format("node {} has two parents", visit.node));
            visited[std::size_t(visit.node)] = true;
            const glm::dmat4 world_from_node = visit.world_from_parent * local_transform(node);
            add_motion_node(visit.node, visit.parent);
            const MotionNode& added = loaded_.bundle.motion.nodes.back();
            node_moves_ = visit.moves || added.translation_track >= 0 ||
                          added.rotation_track >= 0 || added.scale_track >= 0;
            read_node(node, world_from_node);
            push(node.children, world_from_node, std::int32_t(motion_node_), node_moves_);
        }
    }

    void add_motion_node(int index, std::int32_t parent) {
        const tinygltf::Node& node = model_.nodes[std::size_t(index)];
        std::vector<MotionNode>& nodes = loaded_.bundle.motion.nodes;
        motion_node_ = std::uint32_t(nodes.size());
        motion_nodes_[index] = motion_node_;
        const NodeTracks tracks = tracks_.contains(index) ? tracks_.at(index) : NodeTracks{};
        MotionNode out{.parent = parent, .weights = {}};
        out.is_fixed = tracks.translation < 0 && tracks.rotation < 0 && tracks.scale < 0;
        out.fixed = local_transform(node);
        const auto vector = [](const std::vector<double>& v, const vec3& fallback) {
            return v.size() == 3 ? vec3(v[0], v[1], v[2]) : fallback;
        };
        out.translation = vector(node.translation, vec3(0));
        out.scale = vector(node.scale, vec3(1));
        if (const auto& r = node.rotation; r.size() == 4)
            out.rotation = glm::quat(glm::dquat(r[3], r[0], r[1], r[2]));
        out.translation_track = tracks.translation;
        out.rotation_track = tracks.rotation;
        out.scale_track = tracks.scale;
        out.weights_track = tracks.weights;
        const bool has_mesh = node.mesh >= 0 && std::size_t(node.mesh) < model_.meshes.size();
        const std::vector<double>& weights = !node.weights.empty() || !has_mesh
                                                 ? node.weights
                                                 : model_.meshes[std::size_t(node.mesh)].weights;
        out.weights.assign(weights.begin(), weights.end());
        nodes.push_back(std::move(out));
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
        if (node.mesh >= 0) {
            std::optional<std::uint32_t> object = at(objects_, node.mesh, "mesh");
            const auto soft = soft_of_mesh_.find(std::size_t(node.mesh));
            if (soft != soft_of_mesh_.end() && !soft->second.mesh.triangles.empty())
                object = add_soft_object(node, soft->second);
            // Skins put vertices into the world themselves.
            if (object) place(node, *object, node.skin >= 0 ? glm::dmat4(1) : world_from_node);
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
            add_carried_instance(node, name, object, world_from_node, glm::dmat4(1));
            return;
        }
        for (const glm::dmat4& node_from_instance : instance_transforms(*attributes))
            add_carried_instance(node, name, object, world_from_node, node_from_instance);
    }

    void add_carried_instance(const tinygltf::Node& node, const std::string& name,
                              std::uint32_t object, const glm::dmat4& world_from_node,
                              const glm::dmat4& node_from_instance) {
        const std::uint32_t instance =
            add_instance(loaded_.bundle, name, object, mat4(world_from_node * node_from_instance));
        if (!node_moves_ || node.skin >= 0) return;
        loaded_.bundle.scene.instances[instance].moves = true;
        carried_instances_.push_back(instance);
        loaded_.bundle.motion.instances.push_back({{}, motion_node_, node_from_instance});
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
        if (!node_moves_) return;
        carried_cameras_.push_back(loaded_.bundle.scene.cameras.size() - 1);
        loaded_.bundle.motion.cameras.push_back({{}, motion_node_});
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
        if (!node_moves_) return;
        carried_lights_.push_back(loaded_.bundle.scene.lights.size() - 1);
        loaded_.bundle.motion.lights.push_back({{}, motion_node_});
    }

    const tinygltf::Model& model_;
    std::string file_;
    AccessorReader accessors_;
    LoadedScene loaded_;
    MeshCleaning cleaning_;
    std::set<std::string> unmodelled_;
    std::vector<std::optional<std::uint32_t>> objects_;  // by glTF mesh; nothing: none of its own
    std::vector<bool> is_soft_;                          // by glTF mesh
    std::map<std::size_t, Soft> soft_of_mesh_;           // by glTF mesh
    std::map<int, std::uint32_t> soft_index_;            // glTF mesh -> Motion::soft_meshes
    std::vector<std::pair<std::uint32_t, Motion::Deformed>> deformed_;  // by object
    std::map<int, NodeTracks> tracks_;                                  // by glTF node
    std::map<int, std::uint32_t> motion_nodes_;                         // by glTF node
    std::uint32_t motion_node_ = 0;                                     // being read
    bool node_moves_ = false;
    std::vector<std::size_t> carried_instances_, carried_lights_, carried_cameras_;
    std::optional<std::uint32_t> default_material_;
    std::map<std::pair<int, bool>, std::int32_t> textures_;
};

}  // namespace

LoadedScene load_gltf(const std::filesystem::path& file) {
    const tinygltf::Model model = parse(file);
    return GltfReader(model, file).read();
}

}  // namespace tessera
