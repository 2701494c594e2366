// A scene as one binary glTF 2.0 file: the slots of a mesh become primitives over shared vertices,
// textures are embedded PNG. Emission beyond 1 is a power of two in
// KHR_materials_emissive_strength, so that the product is exact. A camera is a node that looks
// along -z; its distance to `at` is the node's extra `target_distance`.

#include <fmt/format.h>

#include <array>
#include <fstream>
#include <map>
#include <nlohmann/json.hpp>

#include "common/check.h"
#include "common/image_io.h"
#include "common/scene_io.h"

namespace tessera {
namespace {

using Json = nlohmann::json;

// Constants of the glTF 2.0 specification.
constexpr int gltf_float = 5126;
constexpr int gltf_unsigned_int = 5125;
constexpr int gltf_array_buffer = 34962;
constexpr int gltf_element_array_buffer = 34963;
constexpr std::uint32_t glb_magic = 0x46546c67;
constexpr std::uint32_t glb_json = 0x4e4f534a;
constexpr std::uint32_t glb_binary = 0x004e4942;

Json to_json(const vec2& v) { return {v.x, v.y}; }
Json to_json(const vec3& v) { return {v.x, v.y, v.z}; }

Json to_json(const mat4& m) {
    Json out = Json::array();
    for (int i = 0; i < 16; ++i) out.push_back(m[i / 4][i % 4]);
    return out;
}

/// A colour of any size as factor in [0, 1] times a power of two.
struct ScaledColour {
    vec3 factor;
    float scale;
};

ScaledColour scaled(const vec3& colour) {
    float scale = 1;
    while (max_component(colour) > scale) scale *= 2;
    return {colour / scale, scale};
}

/// World from a node that looks along its -z.
mat4 looking(const vec3& from, const vec3& direction, const vec3& up) {
    const vec3 back = -normalize(direction);
    vec3 right = cross(up, back);
    right = length(right) > 1e-6f ? normalize(right) : Frame(back).s;
    return mat4(vec4(right, 0), vec4(cross(back, right), 0), vec4(back, 0), vec4(from, 1));
}

int wrap_mode(Wrap wrap) {
    constexpr std::array modes{10497, 33648, 33071};  // repeat, mirror, clamp
    return modes[std::size_t(wrap)];
}

class GlbWriter {
public:
    explicit GlbWriter(const SceneBundle& bundle) : bundle_(bundle), scene_(bundle.scene) {}

    Json make() {
        json_["asset"] = {{"version", "2.0"}, {"generator", "tessera " TESSERA_VERSION}};
        json_["scene"] = 0;
        for (const BlobId& id : scene_.meshes) add_attributes(decode_mesh(blob(id)));
        for (const Material& material : scene_.materials) add_material(material);
        for (const Object& object : scene_.objects) add_object(object);
        for (const Instance& instance : scene_.instances) add_instance(instance);
        for (const Light& light : scene_.lights) add_light(light);
        for (const Camera& camera : scene_.cameras) add_camera(camera);
        add_motion();
        finish();
        return std::move(json_);
    }

    const Bytes& binary() const { return binary_; }

private:
    /// A mesh whose vertices are in the file already.
    struct WrittenMesh {
        Mesh mesh;
        Json attributes;
        std::vector<Json> slot_indices;  ///< accessor of each slot's triangles; null: none
    };

    std::span<const std::byte> blob(const BlobId& id) const {
        const auto bytes = bundle_.blobs.find(id);
        CHECK(bytes != nullptr);
        return *bytes;
    }

    std::size_t append(const char* table, Json entry) {
        json_[table].push_back(std::move(entry));
        return json_[table].size() - 1;
    }

    std::size_t add_view(std::span<const std::byte> bytes, int target = 0) {
        binary_.resize((binary_.size() + 3) / 4 * 4);
        Json view{{"buffer", 0}, {"byteOffset", binary_.size()}, {"byteLength", bytes.size()}};
        if (target != 0) view["target"] = target;
        binary_.insert(binary_.end(), bytes.begin(), bytes.end());
        return append("bufferViews", std::move(view));
    }

    template <class T>
    std::size_t add_accessor(const std::vector<T>& values, const char* type, std::size_t count,
                             int component_type, int target) {
        return append("accessors",
                      {{"bufferView", add_view(std::as_bytes(std::span(values)), target)},
                       {"componentType", component_type},
                       {"count", count},
                       {"type", type}});
    }

    template <class T>
    std::size_t add_vertices(const std::vector<T>& values, const char* type) {
        return add_accessor(values, type, values.size(), gltf_float, gltf_array_buffer);
    }

    void add_attributes(Mesh mesh) {
        Json attributes;
        if (!mesh.positions.empty()) {
            const std::size_t positions = add_vertices(mesh.positions, "VEC3");
            Box box;
            for (const vec3& p : mesh.positions) box.add(p);
            json_["accessors"][positions]["min"] = to_json(box.lo);
            json_["accessors"][positions]["max"] = to_json(box.hi);
            attributes["POSITION"] = positions;
        }
        if (!mesh.normals.empty()) attributes["NORMAL"] = add_vertices(mesh.normals, "VEC3");
        if (!mesh.texcoords.empty())
            attributes["TEXCOORD_0"] = add_vertices(mesh.texcoords, "VEC2");
        std::vector<Json> slots = slot_indices(mesh);
        meshes_.push_back({std::move(mesh), std::move(attributes), std::move(slots)});
    }

    std::vector<Json> slot_indices(const Mesh& mesh) {
        std::vector<std::vector<uvec3>> triangles;
        for (std::size_t i = 0; i < mesh.triangles.size(); ++i) {
            const std::size_t slot = mesh.slots.empty() ? 0 : mesh.slots[i];
            if (slot >= triangles.size()) triangles.resize(slot + 1);
            triangles[slot].push_back(mesh.triangles[i]);
        }
        std::vector<Json> accessors;
        for (const auto& of_slot : triangles)
            accessors.push_back(
                of_slot.empty() ? Json()
                                : Json(add_accessor(of_slot, "SCALAR", 3 * of_slot.size(),
                                                    gltf_unsigned_int, gltf_element_array_buffer)));
        return accessors;
    }

    std::size_t image(std::int32_t texture, const Texture& pixels) {
        const auto [it, added] = images_.try_emplace(texture, 0);
        if (added)
            it->second = append("images", {{"mimeType", "image/png"},
                                           {"bufferView", add_view(encode_png(pixels))}});
        return it->second;
    }

    Json texture_info(const TextureMap& map) {
        const Texture pixels = decode_texture(blob(scene_.textures[std::size_t(map.texture)]));
        const std::size_t sampler = append(
            "samplers", {{"wrapS", wrap_mode(pixels.wrap_u)}, {"wrapT", wrap_mode(pixels.wrap_v)}});
        Json info{{"index", append("textures", {{"source", image(map.texture, pixels)},
                                                {"sampler", sampler}})}};
        if (map != TextureMap{.texture = map.texture}) {
            info["extensions"]["KHR_texture_transform"] = {{"offset", to_json(map.offset)},
                                                           {"scale", to_json(map.scale)},
                                                           {"rotation", map.rotation}};
            use("KHR_texture_transform");
        }
        return info;
    }

    void add_material(const Material& m) {
        Json pbr{{"baseColorFactor", {m.base_color.x, m.base_color.y, m.base_color.z, m.alpha}},
                 {"metallicFactor", m.metallic},
                 {"roughnessFactor", m.roughness}};
        Json out{{"name", m.name}, {"doubleSided", m.two_sided_emission}};
        if (m.base_color_map.texture >= 0) pbr["baseColorTexture"] = texture_info(m.base_color_map);
        if (m.metallic_roughness_map.texture >= 0)
            pbr["metallicRoughnessTexture"] = texture_info(m.metallic_roughness_map);
        if (m.emission_map.texture >= 0) out["emissiveTexture"] = texture_info(m.emission_map);
        const ScaledColour emission = scaled(m.emission);
        out["emissiveFactor"] = to_json(emission.factor);
        if (emission.scale != 1) {
            out["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"] =
                emission.scale;
            use("KHR_materials_emissive_strength");
        }
        out["pbrMetallicRoughness"] = std::move(pbr);
        add_extension(out, "KHR_materials_specular", "specularFactor", m.specular, 1);
        add_extension(out, "KHR_materials_ior", "ior", m.ior, 1.5f);
        add_transmission(m, out);
        if (m.normal_map.texture >= 0) {
            out["normalTexture"] = texture_info(m.normal_map);
            out["normalTexture"]["scale"] = m.normal_scale;
        }
        if (m.alpha_mode != AlphaMode::opaque)
            out["alphaMode"] = m.alpha_mode == AlphaMode::mask ? "MASK" : "BLEND";
        if (m.alpha_mode == AlphaMode::mask) out["alphaCutoff"] = m.alpha_cutoff;
        if (!m.shader.empty()) out["extras"]["shader"] = m.shader;
        for (const ShaderParameter& p : m.shader_parameters)
            out["extras"]["shader_parameters"].push_back(
                {{"name", p.name}, {"value", to_json(p.value)}});
        append("materials", std::move(out));
    }

    /// Writes a value where it is not the one that absence means.
    void add_extension(Json& material, const char* extension, const char* key, float value,
                       float absent) {
        if (value == absent) return;
        material["extensions"][extension][key] = value;
        use(extension);
    }

    void add_transmission(const Material& m, Json& out) {
        add_extension(out, "KHR_materials_transmission", "transmissionFactor", m.transmission, 0);
        if (m.transmission_map.texture >= 0) {
            out["extensions"]["KHR_materials_transmission"]["transmissionTexture"] =
                texture_info(m.transmission_map);
            use("KHR_materials_transmission");
        }
        // Any thickness says that it is a body, not a pane.
        if (m.transmission > 0 && !m.thin_walled)
            add_extension(out, "KHR_materials_volume", "thicknessFactor", 1, 0);
    }

    /// glTF puts materials into meshes, so each object is a mesh; those of one Mesh share its data.
    void add_object(const Object& object) {
        const WrittenMesh& written = meshes_[object.mesh];
        Json primitives = Json::array();
        for (std::size_t slot = 0; slot < written.slot_indices.size(); ++slot) {
            if (written.slot_indices[slot].is_null()) continue;
            Json primitive{{"attributes", written.attributes},
                           {"indices", written.slot_indices[slot]}};
            if (slot < object.materials.size()) primitive["material"] = object.materials[slot];
            primitives.push_back(std::move(primitive));
        }
        append("meshes", {{"name", object.name}, {"primitives", std::move(primitives)}});
    }

    void add_node(Json node) { nodes_.push_back(append("nodes", std::move(node))); }

    void add_instance(const Instance& instance) {
        Json node{{"name", instance.name}, {"mesh", instance.object}};
        const auto& moving = bundle_.motion.instances;
        const auto carried = std::ranges::find(moving, instance.name, &Motion::Carried::name);
        if (carried != moving.end()) {
            node["matrix"] = to_json(mat4(carried->node_from_instance));
            children_[carried->node].push_back(append("nodes", std::move(node)));
            return;
        }
        if (instance.world_from_object != mat4(1))
            node["matrix"] = to_json(instance.world_from_object);
        add_node(std::move(node));
    }

    void add_light(const Light& light) {
        constexpr std::array kinds{"point", "spot", "directional"};
        const ScaledColour intensity = scaled(light.intensity);
        Json out{{"name", light.name},
                 {"type", kinds[std::size_t(light.kind)]},
                 {"color", to_json(intensity.factor)},
                 {"intensity", intensity.scale}};
        if (light.kind == LightKind::spot)
            out["spot"] = {{"innerConeAngle", light.inner_angle},
                           {"outerConeAngle", light.outer_angle}};
        Json& lights = json_["extensions"]["KHR_lights_punctual"]["lights"];
        lights.push_back(std::move(out));
        use("KHR_lights_punctual");
        add_node({{"name", light.name},
                  {"matrix", to_json(looking(light.position, light.direction, {0, 1, 0}))},
                  {"extensions", {{"KHR_lights_punctual", {{"light", lights.size() - 1}}}}}});
    }

    void add_camera(const Camera& camera) {
        const std::size_t index = append(
            "cameras",
            {{"name", camera.name},
             {"type", "perspective"},
             {"perspective", {{"yfov", glm::radians(double(camera.fov_y))}, {"znear", 0.01}}}});
        const vec3 forward = camera.at - camera.eye;
        add_node({{"name", camera.name},
                  {"camera", index},
                  {"matrix", to_json(looking(camera.eye, forward, camera.up))},
                  {"extras", {{"target_distance", length(forward)}}}});
    }

    /// The nodes that move, with the instances that they carry, and how they move.
    void add_motion() {
        const Motion& motion = bundle_.motion;
        if (motion.nodes.empty()) return;
        const std::size_t first = json_["nodes"].size();
        for (std::size_t i = 0; i < motion.nodes.size(); ++i) {
            const MotionNode& node = motion.nodes[i];
            append("nodes", placed(node));
            if (node.parent == MotionNode::none)
                nodes_.push_back(first + i);
            else
                children_[std::size_t(node.parent)].push_back(first + i);
            add_channel(first + i, "translation", node.translation_track);
            add_channel(first + i, "rotation", node.rotation_track);
            add_channel(first + i, "scale", node.scale_track);
        }
        for (const auto& [node, children] : children_)
            json_["nodes"][first + node]["children"] = children;
    }

    static Json placed(const MotionNode& node) {
        if (node.is_fixed) return {{"matrix", to_json(mat4(node.fixed))}};
        const glm::quat& r = node.rotation;
        return {{"translation", to_json(node.translation)},
                {"rotation", {r.x, r.y, r.z, r.w}},
                {"scale", to_json(node.scale)}};
    }

    void add_channel(std::size_t node, const char* path, std::int32_t index) {
        if (index == MotionNode::none) return;
        constexpr std::array modes{"STEP", "LINEAR", "CUBICSPLINE"};
        const Track& track = bundle_.motion.tracks[std::size_t(index)];
        const std::size_t input =
            add_accessor(track.times, "SCALAR", track.times.size(), gltf_float, 0);
        json_["accessors"][input]["min"] = {track.times.front()};
        json_["accessors"][input]["max"] = {track.times.back()};
        const std::size_t output =
            add_accessor(track.values, track.components == 4 ? "VEC4" : "VEC3",
                         track.values.size() / track.components, gltf_float, 0);
        Json& animation = json_["animations"][0];
        animation["channels"].push_back({{"sampler", animation["samplers"].size()},
                                         {"target", {{"node", node}, {"path", path}}}});
        animation["samplers"].push_back(
            {{"input", input},
             {"output", output},
             {"interpolation", modes[std::size_t(track.interpolation)]}});
    }

    void use(const char* extension) {
        Json& used = json_["extensionsUsed"];
        if (std::find(used.begin(), used.end(), extension) == used.end()) used.push_back(extension);
    }

    void finish() {
        json_["scenes"] = Json::array({{{"nodes", nodes_}}});
        if (!binary_.empty()) json_["buffers"] = Json::array({{{"byteLength", binary_.size()}}});
    }

    const SceneBundle& bundle_;
    const Scene& scene_;
    Json json_;
    Bytes binary_;
    Json nodes_ = Json::array();
    std::map<std::size_t, std::vector<std::size_t>> children_;  ///< of nodes that move
    std::vector<WrittenMesh> meshes_;
    std::map<std::int32_t, std::size_t> images_;
};

void write_word(std::ostream& out, std::uint64_t value) {
    const auto word = std::uint32_t(value);
    out.write(reinterpret_cast<const char*>(&word), sizeof word);
}

/// A chunk whose size is padded to four bytes.
void write_chunk(std::ostream& out, std::uint32_t kind, std::string_view bytes, char padding) {
    const std::size_t padded = (bytes.size() + 3) / 4 * 4;
    write_word(out, padded);
    write_word(out, kind);
    out.write(bytes.data(), std::streamsize(bytes.size()));
    out << std::string(padded - bytes.size(), padding);
}

}  // namespace

void save_glb(const SceneBundle& bundle, const std::filesystem::path& file) {
    GlbWriter writer(bundle);
    const std::string json = writer.make().dump(-1, ' ', false, Json::error_handler_t::replace);
    const Bytes& binary = writer.binary();
    const std::uint64_t total =
        12 + 8 + (json.size() + 3) / 4 * 4 + (binary.empty() ? 0 : 8 + (binary.size() + 3) / 4 * 4);
    if (total > std::numeric_limits<std::uint32_t>::max())
        throw UserError(fmt::format(
            "{}: the scene is larger than the 4 GB of a .glb file; split it", file.string()));
    std::ofstream out(file, std::ios::binary);
    write_word(out, glb_magic);
    write_word(out, 2);
    write_word(out, total);
    write_chunk(out, glb_json, json, ' ');
    if (!binary.empty())
        write_chunk(out, glb_binary, {reinterpret_cast<const char*>(binary.data()), binary.size()},
                    '\0');
    out.close();
    if (!out)
        throw UserError(fmt::format(
            "{}: cannot write this file; check the folder and its free space", file.string()));
}

}  // namespace tessera
