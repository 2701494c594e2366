// Wavefront OBJ with MTL materials. The .mtl is read by tinyobjloader; the geometry by us, because
// tinyobjloader takes unreadable numbers for zero and cannot say in which line a face is wrong.
//
// The whole file is one mesh; `usemtl` names pick its slots. Normals are taken where the file has
// them and never invented. MTL's `Kd` is Lambert, `Ke` emission from both sides; `illum 3` and the
// other reflecting models are a mirror of colour `Ks`. OBJ's texture coordinates start at the
// bottom left, ours at the top left: v is flipped.

#include <fmt/format.h>
#include <tiny_obj_loader.h>

#include <array>
#include <fstream>
#include <limits>
#include <map>
#include <set>

#include "common/check.h"
#include "common/clean_mesh.h"
#include "common/image_io.h"
#include "common/polygon.h"
#include "common/scene_builder.h"
#include "common/scene_io.h"
#include "common/text_reader.h"

namespace tessera {
namespace {

constexpr std::int64_t absent = -1;

/// Indices of one corner of a face, from zero.
struct Corner {
    std::int64_t position = absent;
    std::int64_t texcoord = absent;
    std::int64_t normal = absent;
};

struct Attributes {
    std::vector<vec3> positions;
    std::vector<vec2> texcoords;
    std::vector<vec3> normals;
};

/// A mesh of faces that have the same attributes; corners that agree share a vertex.
class Part {
public:
    void add_triangle(const Attributes& all, std::span<const Corner, 3> corners,
                      std::uint16_t slot) {
        mesh_.triangles.push_back(
            {vertex(all, corners[0]), vertex(all, corners[1]), vertex(all, corners[2])});
        mesh_.slots.push_back(slot);
    }
    Mesh take() { return std::move(mesh_); }

private:
    static constexpr std::uint32_t none = std::numeric_limits<std::uint32_t>::max();
    struct Vertex {
        Corner corner;
        std::uint32_t next;  ///< another vertex at the same position
    };

    std::uint32_t vertex(const Attributes& all, const Corner& c) {
        if (first_.size() < all.positions.size()) first_.resize(all.positions.size(), none);
        std::uint32_t& first = first_[std::size_t(c.position)];
        for (std::uint32_t v = first; v != none; v = vertices_[v].next)
            if (vertices_[v].corner.texcoord == c.texcoord &&
                vertices_[v].corner.normal == c.normal)
                return v;
        vertices_.push_back({c, first});
        first = std::uint32_t(vertices_.size() - 1);
        mesh_.positions.push_back(all.positions[std::size_t(c.position)]);
        if (c.texcoord != absent) mesh_.texcoords.push_back(all.texcoords[std::size_t(c.texcoord)]);
        if (c.normal != absent) mesh_.normals.push_back(all.normals[std::size_t(c.normal)]);
        return first;
    }

    Mesh mesh_;
    std::vector<Vertex> vertices_;
    std::vector<std::uint32_t> first_;  ///< by position
};

/// What the geometry file says: parts by attributes, and the names behind slots and libraries.
class ObjReader {
public:
    ObjReader(const std::string& file, std::string_view text) : in_(file, text) {}

    void read() {
        while (in_.next_line()) read_line(in_.word());
    }

    std::array<Part, 4> parts;
    std::vector<std::string> slot_names;  ///< empty name: faces before any usemtl
    std::vector<std::string> libraries;

private:
    void read_line(std::string_view keyword) {
        if (keyword == "v") {
            all_.positions.push_back(read_vec3());
        } else if (keyword == "vt") {
            const auto u = float(in_.number());
            const std::string_view v = in_.rest();
            all_.texcoords.push_back({u, 1 - (v.empty() ? 0.0f : float(in_.number()))});
        } else if (keyword == "vn") {
            all_.normals.push_back(read_vec3());
        } else if (keyword == "f") {
            read_face();
        } else if (keyword == "usemtl") {
            material_ = in_.rest();
        } else if (keyword == "mtllib") {
            libraries.emplace_back(in_.rest());
        }
    }

    vec3 read_vec3() {
        const auto x = float(in_.number());
        const auto y = float(in_.number());
        return {x, y, float(in_.number())};
    }

    void read_face() {
        corners_.clear();
        for (std::string_view word = in_.word(); !word.empty(); word = in_.word())
            corners_.push_back(read_corner(word));
        if (corners_.size() < 3)
            in_.fail(
                fmt::format("a face of {} corners; give it three or remove it", corners_.size()));
        // A face has an attribute when all its corners do.
        bool texcoords = true;
        bool normals = true;
        for (const Corner& c : corners_) {
            texcoords &= c.texcoord != absent;
            normals &= c.normal != absent;
        }
        positions_.clear();
        for (Corner& c : corners_) {
            if (!texcoords) c.texcoord = absent;
            if (!normals) c.normal = absent;
            positions_.push_back(all_.positions[std::size_t(c.position)]);
        }
        Part& part = parts[std::size_t(texcoords) + 2 * std::size_t(normals)];
        const std::uint16_t slot = slot_of(material_);
        for (const uvec3& t : triangulate(positions_))
            part.add_triangle(all_, std::array{corners_[t.x], corners_[t.y], corners_[t.z]}, slot);
    }

    /// `p`, `p/t`, `p//n` or `p/t/n`.
    Corner read_corner(std::string_view word) {
        std::array<std::string_view, 3> fields;
        std::string_view left = word;
        for (std::string_view& field : fields) {
            field = left.substr(0, left.find('/'));
            left.remove_prefix(std::min(field.size() + 1, left.size()));
        }
        Corner corner;
        corner.position = resolve(fields[0], all_.positions.size(), "vertex");
        if (!fields[1].empty())
            corner.texcoord = resolve(fields[1], all_.texcoords.size(), "texture coordinate");
        if (!fields[2].empty()) corner.normal = resolve(fields[2], all_.normals.size(), "normal");
        return corner;
    }

    /// One-based index, or negative: back from the newest.
    std::int64_t resolve(std::string_view field, std::size_t count, const char* what) {
        std::int64_t index;
        if (!parse_number(field, index))
            in_.fail(fmt::format("'{}' is no {} index; correct it", field.substr(0, 40), what));
        const std::int64_t resolved = index < 0 ? std::int64_t(count) + index : index - 1;
        if (index == 0 || resolved < 0 || resolved >= std::int64_t(count))
            in_.fail(
                fmt::format("{} {} is out of range: {} come before this face; correct the "
                            "index or add what is missing",
                            what, index, count));
        return resolved;
    }

    std::uint16_t slot_of(const std::string& name) {
        const auto [it, added] = slots_.try_emplace(name, slot_names.size());
        if (added) slot_names.push_back(name);
        if (it->second > std::numeric_limits<std::uint16_t>::max())
            in_.fail("more than 65536 materials are in use; split the file");
        return std::uint16_t(it->second);
    }

    TextReader in_;
    Attributes all_;
    std::string material_;
    std::map<std::string, std::size_t> slots_;
    std::vector<Corner> corners_;  // of the face being read
    std::vector<vec3> positions_;
};

/// The material libraries of one file, as a scene's materials.
class MaterialLibrary {
public:
    MaterialLibrary(const std::filesystem::path& folder, LoadedScene& scene)
        : folder_(folder), scene_(scene) {}

    /// `names` is what stood after mtllib: one file name, perhaps with blanks, or several.
    void read(const std::string& names) {
        if (read_one(names)) return;
        TextReader words("", names);
        words.next_line();
        for (std::string_view name = words.word(); !name.empty(); name = words.word())
            if (!read_one(std::string(name)))
                scene_.notes.push_back(
                    fmt::format("material library {} is missing: its surfaces are grey", name));
    }

    /// Adds the material of that name to the scene; grey when there is none.
    std::uint32_t add(const std::string& name) {
        const auto it = by_name_.find(name);
        if (it != by_name_.end()) {
            used_.insert(it->first);
            return add_material(scene_.bundle, convert(read_[std::size_t(it->second)]));
        }
        if (!name.empty())
            scene_.notes.push_back(
                fmt::format("material '{}' is not defined: its surfaces are grey", name));
        return add_material(scene_.bundle, {.name = name.empty() ? "default" : name});
    }

    std::size_t unused() const {
        return std::size_t(std::count_if(read_.begin(), read_.end(), [&](const auto& m) {
            return !m.name.empty() && !used_.contains(m.name);
        }));
    }

private:
    bool read_one(const std::string& name) {
        if (name.empty() || is_outside(name)) return false;
        std::ifstream in(folder_ / name);
        if (!in || std::filesystem::is_directory(folder_ / name)) return false;
        std::string warnings, errors;
        tinyobj::LoadMtl(&by_name_, &read_, &in, &warnings, &errors);
        return true;
    }

    Material convert(const tinyobj::material_t& m) {
        const auto colour = [](const tinyobj::real_t* c) { return vec3(c[0], c[1], c[2]); };
        Material out{.name = m.name, .base_color = colour(m.diffuse)};
        if (m.illum >= 3 && colour(m.specular) != vec3(0)) {
            out.base_color = colour(m.specular);
            out.metallic = 1;
            out.roughness = 0;
        } else {
            out.base_color_map = texture(m.diffuse_texname, m.diffuse_texopt);
        }
        out.emission = colour(m.emission);
        out.emission_map = texture(m.emissive_texname, m.emissive_texopt);
        out.two_sided_emission = out.emission != vec3(0);
        if (m.dissolve < 1)
            scene_.notes.push_back(fmt::format(
                "material '{}' is drawn opaque: its transparency is not modelled", m.name));
        return out;
    }

    TextureMap texture(std::string name, const tinyobj::texture_option_t& option) {
        if (name.empty()) return {};
        std::replace(name.begin(), name.end(), '\\', '/');
        const auto [it, added] = textures_.try_emplace({name, option.clamp}, -1);
        if (added) it->second = read_picture(name, option.clamp ? Wrap::clamp : Wrap::repeat);
        const vec2 scale(option.scale[0], option.scale[1]);
        const vec2 offset(option.origin_offset[0], option.origin_offset[1]);
        // The options move bottom-left coordinates; ours start at the top.
        return {
            .texture = it->second, .offset = {offset.x, 1 - scale.y - offset.y}, .scale = scale};
    }

    bool is_outside(const std::string& name) {
        if (lies_within(folder_, folder_ / name)) return false;
        scene_.notes.push_back(fmt::format(
            "{} lies outside the scene's folder and is not read; copy it to there", name));
        return true;
    }

    std::int32_t read_picture(const std::string& name, Wrap wrap) {
        if (is_outside(name)) return -1;
        try {
            Texture texture = read_texture(folder_ / name);
            texture.wrap_u = texture.wrap_v = wrap;
            return std::int32_t(add_texture(scene_.bundle, texture));
        } catch (const UserError& error) {
            scene_.notes.push_back(fmt::format("texture left out: {}", error.what()));
            return -1;
        }
    }

    std::filesystem::path folder_;
    LoadedScene& scene_;
    std::vector<tinyobj::material_t> read_;
    std::map<std::string, int> by_name_;
    std::set<std::string> used_;
    std::map<std::pair<std::string, bool>, std::int32_t> textures_;
};

}  // namespace

LoadedScene load_obj(const std::filesystem::path& file) {
    const std::string text = read_file(file);
    ObjReader reader(file.string(), text);
    reader.read();

    LoadedScene loaded;
    MeshCleaning cleaning;
    Mesh mesh;
    for (Part& part : reader.parts) {
        Mesh of_part = part.take();
        if (of_part.triangles.empty()) continue;
        cleaning += clean_mesh(of_part);
        append(mesh, std::move(of_part));
    }
    cleaning.empty_meshes = mesh.triangles.empty() ? 1 : 0;
    loaded.notes = describe(cleaning);
    if (mesh.triangles.empty()) return loaded;

    MaterialLibrary library(file.parent_path(), loaded);
    for (const std::string& names : reader.libraries) library.read(names);
    std::vector<std::uint32_t> materials;
    for (const std::string& name : reader.slot_names) materials.push_back(library.add(name));
    if (library.unused() > 0)
        loaded.notes.push_back(fmt::format("dropped {} unused materials", library.unused()));
    const std::string name = file.stem().string();
    add_instance(loaded.bundle, name, add_object(loaded.bundle, name, mesh, std::move(materials)));
    check_values(loaded.bundle.scene, file.string());
    return loaded;
}

}  // namespace tessera
