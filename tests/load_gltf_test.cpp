// glTF: what each part of a file becomes, and that no bytes whatever do more than throw UserError.

#include <gtest/gtest.h>

#include <bit>
#include <nlohmann/json.hpp>
#include <random>

#include "common/image_io.h"
#include "common/scene_io.h"
#include "tests/scene_checks.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

using Json = nlohmann::json;

constexpr int unsigned_byte = 5121, unsigned_short = 5123, unsigned_int = 5125, floating = 5126;

/// A file in the making: one buffer, and accessors into it.
class GltfFile {
public:
    Json json = Json::parse(R"({"asset": {"version": "2.0"}, "scene": 0,
                                "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]})");
    std::string binary;

    template <class T>
    int accessor(const std::vector<T>& values, const char* type, int components, int component_type,
                 bool normalized = false) {
        json["accessors"].push_back({{"bufferView", view(values)},
                                     {"componentType", component_type},
                                     {"count", values.size() / components},
                                     {"normalized", normalized},
                                     {"type", type}});
        return int(json["accessors"].size()) - 1;
    }

    template <class T>
    int view(const std::vector<T>& values) {
        binary.resize((binary.size() + 3) / 4 * 4);
        json["bufferViews"].push_back({{"buffer", 0},
                                       {"byteOffset", binary.size()},
                                       {"byteLength", values.size() * sizeof(T)}});
        binary.append(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T));
        return int(json["bufferViews"].size()) - 1;
    }

    int positions(const std::vector<float>& values) {
        return accessor(values, "VEC3", 3, floating);
    }

    void primitive(const Json& attributes, int indices = -1, int mode = 4, int material = -1) {
        Json p{{"attributes", attributes}, {"mode", mode}};
        if (indices >= 0) p["indices"] = indices;
        if (material >= 0) p["material"] = material;
        json["meshes"][0]["primitives"].push_back(p);
    }

    std::filesystem::path write(const TempDir& dir) {
        dir.write("a.bin", binary);
        json["buffers"] = Json::array({{{"uri", "a.bin"}, {"byteLength", binary.size()}}});
        return dir.write("a.gltf", json.dump());
    }
};

const std::vector<float> square{0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0};

class LoadGltf : public testing::Test {
protected:
    LoadedScene load() { return load_gltf(file_.write(dir_)); }
    std::string error() {
        return user_error([this] { load(); });
    }

    GltfFile file_;
    TempDir dir_;
};

TEST_F(LoadGltf, indices_may_have_any_unsigned_type_or_be_absent) {
    const int p = file_.positions(square);
    const std::vector<uvec3> expected{{0, 1, 2}, {0, 2, 3}};
    file_.primitive({{"POSITION", p}}, file_.accessor(std::vector<std::uint8_t>{0, 1, 2, 0, 2, 3},
                                                      "SCALAR", 1, unsigned_byte));
    EXPECT_EQ(mesh_of(load().bundle, 0).triangles, expected);
    file_.json["meshes"][0]["primitives"][0]["indices"] =
        file_.accessor(std::vector<std::uint16_t>{0, 1, 2, 0, 2, 3}, "SCALAR", 1, unsigned_short);
    EXPECT_EQ(mesh_of(load().bundle, 0).triangles, expected);
    file_.json["meshes"][0]["primitives"][0].erase("indices");
    EXPECT_EQ(mesh_of(load().bundle, 0).triangles, (std::vector<uvec3>{{0, 1, 2}}));
}

TEST_F(LoadGltf, strips_and_fans_keep_their_facing) {
    file_.primitive({{"POSITION", file_.positions({0, 0, 0, 1, 0, 0, 0, 1, 0, 1, 1, 0})}}, -1, 5);
    file_.primitive({{"POSITION", file_.positions(square)}}, -1, 6);
    const LoadedScene loaded = load();
    const auto triangles = world_triangles(loaded.bundle);
    ASSERT_EQ(triangles.size(), 4u);
    for (const WorldTriangle& t : triangles)
        EXPECT_GT(cross(t.points[1] - t.points[0], t.points[2] - t.points[0]).z, 0);
    EXPECT_EQ(mesh_of(loaded.bundle, 0).slots, (std::vector<std::uint16_t>{0, 0, 1, 1}));
}

TEST_F(LoadGltf, points_and_lines_are_noted) {
    file_.primitive({{"POSITION", file_.positions(square)}}, -1, 1);
    const LoadedScene loaded = load();
    EXPECT_TRUE(loaded.bundle.scene.instances.empty());
    EXPECT_TRUE(has_note(loaded.notes, "points and lines"));
}

TEST_F(LoadGltf, normalised_integers_become_fractions) {
    file_.json["materials"] =
        Json::parse(R"([{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}])");
    file_.json["textures"] = Json::parse(R"([{"source": 0}])");
    file_.json["images"] = Json::parse(R"([{"uri": "gone.png"}])");
    const int uv = file_.accessor(std::vector<std::uint8_t>{0, 255, 51, 0, 255, 255}, "VEC2", 2,
                                  unsigned_byte, true);
    const int p = file_.accessor(std::vector<std::int16_t>{0, 0, 0, 32767, 0, 0, 0, -32768, 0},
                                 "VEC3", 3, 5122, true);
    file_.primitive({{"POSITION", p}, {"TEXCOORD_0", uv}}, -1, 4, 0);
    const LoadedScene loaded = load();
    const Mesh mesh = mesh_of(loaded.bundle, 0);
    EXPECT_EQ(mesh.texcoords, (std::vector<vec2>{{0, 1}, {0.2f, 0}, {1, 1}}));
    EXPECT_EQ(mesh.positions, (std::vector<vec3>{{0, 0, 0}, {1, 0, 0}, {0, -1, 0}}));
    EXPECT_TRUE(has_note(loaded.notes, "gone.png"));
}

TEST_F(LoadGltf, nothing_outside_the_folder_is_read) {
    file_.primitive({{"POSITION", file_.positions(square)}});
    load();
    const TempDir elsewhere;
    const auto scene = dir_.file("a.gltf"), bytes = dir_.file("a.bin");
    std::filesystem::rename(bytes, elsewhere.file("a.bin"));
    std::filesystem::create_symlink(elsewhere.file("a.bin"), bytes);
    EXPECT_NE(user_error([&] { load_gltf(scene); }).find("a.bin"), std::string::npos);
}

TEST_F(LoadGltf, sparse_accessors_replace_values) {
    const int p = file_.positions(square);
    const int indices = file_.view(std::vector<std::uint16_t>{1});
    const int values = file_.view(std::vector<float>{5, 0, 0});
    file_.json["accessors"][p]["sparse"] = {
        {"count", 1},
        {"indices", {{"bufferView", indices}, {"componentType", unsigned_short}}},
        {"values", {{"bufferView", values}}}};
    file_.primitive({{"POSITION", p}});
    EXPECT_EQ(mesh_of(load().bundle, 0).positions[1], vec3(5, 0, 0));
    // Without a buffer view of its own, the rest is zero.
    file_.json["accessors"][p].erase("bufferView");
    EXPECT_TRUE(load().bundle.scene.instances.empty());
}

TEST_F(LoadGltf, nodes_are_flattened_into_instances_of_one_mesh) {
    file_.primitive({{"POSITION", file_.positions(square)}});
    file_.json["nodes"] = Json::parse(R"([
        {"translation": [1, 2, 3], "children": [1, 2]},
        {"mesh": 0, "name": "turned", "rotation": [0, 0, 0.70710678, 0.70710678]},
        {"mesh": 0, "matrix": [2,0,0,0, 0,2,0,0, 0,0,2,0, 0,0,1,1]}])");
    const LoadedScene loaded = load();
    const Scene& scene = loaded.bundle.scene;
    ASSERT_EQ(scene.instances.size(), 2u);
    EXPECT_EQ(scene.meshes.size(), 1u);
    EXPECT_EQ(scene.instances[0].name, "turned");
    const auto maps = [&](int i, vec3 from, vec3 to) {
        const vec3 got(scene.instances[i].world_from_object * vec4(from, 1));
        EXPECT_LT(length(got - to), 1e-5f);
    };
    maps(0, {1, 0, 0}, {1, 3, 3});
    maps(1, {1, 0, 0}, {3, 2, 4});
}

TEST_F(LoadGltf, materials_lights_and_cameras) {
    file_.json["materials"] = Json::parse(R"([
        {"name": "lamp", "doubleSided": true, "emissiveFactor": [1, 0.5, 0.25],
         "pbrMetallicRoughness": {"baseColorFactor": [0.1, 0.2, 0.3, 1], "metallicFactor": 0.5,
                                  "roughnessFactor": 0.25},
         "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 8}}},
        {"name": "unused", "alphaMode": "BLEND"}])");
    file_.primitive({{"POSITION", file_.positions(square)}}, -1, 4, 0);
    file_.json["nodes"] = Json::parse(R"([
        {"mesh": 0, "children": [1, 2]},
        {"camera": 0, "translation": [0, 0, 4], "extras": {"target_distance": 3}},
        {"rotation": [-0.70710678, 0, 0, 0.70710678], "translation": [0, 5, 0],
         "extensions": {"KHR_lights_punctual": {"light": 0}}}])");
    file_.json["cameras"] = Json::parse(
        R"([{"type": "perspective", "name": "eye", "perspective": {"yfov": 0.5, "znear": 0.1}}])");
    file_.json["extensions"] = Json::parse(R"({"KHR_lights_punctual": {"lights": [
        {"type": "spot", "color": [1, 0.5, 0], "intensity": 10,
         "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.2}}]}})");
    const LoadedScene loaded = load();
    const Scene& scene = loaded.bundle.scene;
    ASSERT_EQ(scene.materials.size(), 1u);
    EXPECT_EQ(scene.materials[0].emission, vec3(8, 4, 2));
    EXPECT_TRUE(scene.materials[0].two_sided_emission);
    EXPECT_EQ(scene.materials[0].base_color, vec3(0.1f, 0.2f, 0.3f));
    EXPECT_EQ(scene.materials[0].metallic, 0.5f);
    EXPECT_EQ(scene.materials[0].roughness, 0.25f);
    ASSERT_EQ(scene.cameras.size(), 1u);
    EXPECT_EQ(scene.cameras[0].eye, vec3(0, 0, 4));
    EXPECT_EQ(scene.cameras[0].at, vec3(0, 0, 1));
    EXPECT_NEAR(scene.cameras[0].fov_y, 0.5f * 180 / pi, 1e-4f);
    ASSERT_EQ(scene.lights.size(), 1u);
    EXPECT_EQ(scene.lights[0].kind, LightKind::spot);
    EXPECT_LT(length(scene.lights[0].direction - vec3(0, -1, 0)), 1e-6f);
    EXPECT_EQ(scene.lights[0].intensity, vec3(10, 5, 0));
    EXPECT_EQ(scene.lights[0].position, vec3(0, 5, 0));
    EXPECT_TRUE(has_note(loaded.notes, "1 unused material"));
    EXPECT_TRUE(has_note(loaded.notes, "alpha"));
}

TEST_F(LoadGltf, textures_keep_transform_and_wrap) {
    Texture picture{.width = 1, .height = 1, .rgba = {10, 20, 30, 128}};
    const Bytes png = encode_png(picture);
    const int view = file_.view(std::vector<std::byte>(png));
    file_.json["images"] = Json::array({{{"bufferView", view}, {"mimeType", "image/png"}}});
    file_.json["samplers"] = Json::parse(R"([{"wrapS": 33071, "wrapT": 33648}])");
    file_.json["textures"] = Json::parse(R"([{"source": 0, "sampler": 0}])");
    file_.json["materials"] = Json::parse(R"([{"pbrMetallicRoughness": {
        "baseColorTexture": {"index": 0, "extensions": {"KHR_texture_transform":
            {"offset": [0.5, 0.25], "scale": [2, 3], "rotation": 1.5}}},
        "metallicRoughnessTexture": {"index": 0}}}])");
    file_.primitive({{"POSITION", file_.positions(square)}}, -1, 4, 0);
    const LoadedScene loaded = load();
    const Material& m = loaded.bundle.scene.materials.at(0);
    EXPECT_EQ(m.base_color_map, (TextureMap{.texture = m.base_color_map.texture,
                                            .offset = {0.5f, 0.25f},
                                            .scale = {2, 3},
                                            .rotation = 1.5f}));
    picture.wrap_u = Wrap::clamp;
    picture.wrap_v = Wrap::mirror;
    EXPECT_EQ(texture_of(loaded.bundle, m.base_color_map.texture), picture);
    picture.srgb = false;
    EXPECT_EQ(texture_of(loaded.bundle, m.metallic_roughness_map.texture), picture);
}

TEST_F(LoadGltf, broken_files_are_refused_with_a_reason) {
    const int p = file_.positions(square);
    const int i = file_.accessor(std::vector<std::uint32_t>{0, 1, 7}, "SCALAR", 1, unsigned_int);
    file_.primitive({{"POSITION", p}}, i);
    EXPECT_NE(error().find("accessor 1: vertex 7 is out of range"), std::string::npos);
    const Json good = file_.json;
    const auto broken_by = [&](const char* pointer, const Json& value) {
        file_.json = good;
        file_.json["meshes"][0]["primitives"][0].erase("indices");
        file_.json[Json::json_pointer(pointer)] = value;
        return error();
    };
    EXPECT_NE(broken_by("/accessors/0/count", 5).find("accessor 0: 5 values do not fit"),
              std::string::npos);
    EXPECT_NE(broken_by("/accessors/0/byteOffset", 1u << 31).find("accessor 0"), std::string::npos);
    EXPECT_NE(broken_by("/accessors/0/type", "VEC2").find("3 components"), std::string::npos);
    EXPECT_NE(broken_by("/bufferViews/0/byteLength", 49000).find("buffer view 0"),
              std::string::npos);
    EXPECT_NE(broken_by("/accessors/0/bufferView", 9).find("buffer view 9"), std::string::npos);
    EXPECT_NE(broken_by("/nodes/0/mesh", 4).find("mesh 4"), std::string::npos);
    EXPECT_NE(broken_by("/nodes/0/children", {0}).find("two parents"), std::string::npos);
    EXPECT_NE(broken_by("/scenes/0/nodes/0", 3).find("node 3"), std::string::npos);
    EXPECT_NE(broken_by("/extensionsRequired", {"KHR_draco_mesh_compression"}).find("draco"),
              std::string::npos);
    EXPECT_NE(broken_by("/nodes/0/translation", {1e300, 0, 0}).find("not finite"),
              std::string::npos);
}

TEST_F(LoadGltf, changed_bytes_load_or_are_refused) {
    file_.primitive({{"POSITION", file_.positions(square)}});
    const std::filesystem::path path = file_.write(dir_);
    std::string text = file_.json.dump();
    std::mt19937 random(1);
    for (int i = 0; i < 400; ++i) {
        std::string changed = text;
        for (int k = 0; k < 2; ++k) changed[random() % changed.size()] = char(32 + random() % 95);
        dir_.write("a.gltf", changed);
        try {
            expect_sound(load_gltf(path).bundle);
        } catch (const UserError&) {
        }
    }
}

/// Every scene file that lies beside the checkout.
TEST(SharedScenes, load_or_are_refused) {
    const std::filesystem::path folder = TESSERA_SHARED_DIR "/scenes";
    if (!std::filesystem::exists(folder)) GTEST_SKIP() << "no " << folder;
    int loaded = 0;
    for (const auto& entry : std::filesystem::recursive_directory_iterator(folder)) {
        const std::string extension = entry.path().extension().string();
        if (extension != ".gltf" && extension != ".glb" && extension != ".obj" &&
            extension != ".ply")
            continue;
        SCOPED_TRACE(entry.path().string());
        try {
            expect_sound(load_scene(entry.path().string()).bundle);
            ++loaded;
        } catch (const UserError& error) {
            EXPECT_NE(std::string(error.what()).find(entry.path().filename().string()),
                      std::string::npos);
        }
    }
    EXPECT_GT(loaded, 0);
}

TEST(LoadScene, says_what_there_is) {
    const std::string message = user_error([] { load_scene("cornel"); });
    EXPECT_NE(message.find("cornell"), std::string::npos);
    EXPECT_NE(message.find(".glb"), std::string::npos);
    EXPECT_NE(user_error([] { load_scene("gone.obj"); }).find("gone.obj: no such file"),
              std::string::npos);
    EXPECT_EQ(load_scene("cornell").bundle.scene.instances.size(), 4u);
}

}  // namespace
}  // namespace tessera
