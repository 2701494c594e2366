// OBJ and MTL: what is read, what is dropped with a note, and what is refused with file and line.

#include <gtest/gtest.h>

#include "common/image_io.h"
#include "common/scene_io.h"
#include "tests/scene_checks.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

class LoadObj : public testing::Test {
protected:
    LoadedScene load(std::string_view text) { return load_obj(dir_.write("a.obj", text)); }

    /// The part of the error behind the folder's name.
    std::string error(std::string_view text) {
        const std::string message = user_error([&] { load(text); });
        const std::size_t at = message.find("a.obj");
        return at == std::string::npos ? message : message.substr(at);
    }

    TempDir dir_;
};

constexpr std::string_view square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";

TEST_F(LoadObj, a_square_is_two_triangles_over_four_vertices) {
    const LoadedScene loaded = load(std::string(square) + "f 1 2 3 4\n");
    expect_sound(loaded.bundle);
    const Mesh mesh = mesh_of(loaded.bundle, 0);
    EXPECT_EQ(mesh.positions.size(), 4u);
    EXPECT_EQ(mesh.triangles, (std::vector<uvec3>{{0, 1, 2}, {0, 2, 3}}));
    EXPECT_TRUE(mesh.normals.empty());
    EXPECT_TRUE(mesh.slots.empty());
    EXPECT_EQ(loaded.bundle.scene.materials.at(0).base_color, vec3(0.8f));
    EXPECT_TRUE(loaded.notes.empty());
}

TEST_F(LoadObj, negative_indices_count_from_the_newest) {
    const LoadedScene a = load(std::string(square) + "f 1 2 3\nf 1 3 4\n");
    const LoadedScene b = load(std::string(square) + "f -4 -3 -2\nf -4 -2 -1\n");
    EXPECT_EQ(a.bundle.scene.meshes, b.bundle.scene.meshes);
}

TEST_F(LoadObj, concave_polygons_keep_their_area) {
    const LoadedScene loaded = load("v 0 0 0\nv 4 0 0\nv 4 4 0\nv 2 1 0\nv 0 4 0\nf 1 2 3 4 5\n");
    float area = 0;
    for (const WorldTriangle& t : world_triangles(loaded.bundle)) {
        EXPECT_GT(cross(t.points[1] - t.points[0], t.points[2] - t.points[0]).z, 0);
        area += t.area();
    }
    EXPECT_FLOAT_EQ(area, 16 - 6);
}

TEST_F(LoadObj, texture_coordinates_start_at_the_top) {
    const LoadedScene loaded =
        load(std::string(square) + "vt 0.25 0.25\nvt 1 0\nvt 1\nf 1/1 2/2 3/3\n");
    const Mesh mesh = mesh_of(loaded.bundle, 0);
    EXPECT_EQ(mesh.texcoords, (std::vector<vec2>{{0.25f, 0.75f}, {1, 1}, {1, 1}}));
}

TEST_F(LoadObj, faces_without_normals_stay_flat_beside_those_with) {
    const LoadedScene loaded =
        load(std::string(square) + "vn 0 0.6 0.8\nf 1//1 2//1 3//1\nf 1 3 4\n");
    const Mesh mesh = mesh_of(loaded.bundle, 0);
    ASSERT_EQ(mesh.normals.size(), 6u);
    for (const uvec3& t : mesh.triangles) {
        const bool given = mesh.positions[t.y] == vec3(1, 0, 0);
        for (int k = 0; k < 3; ++k)
            EXPECT_EQ(mesh.normals[t[k]], given ? vec3(0, 0.6f, 0.8f) : vec3(0, 0, 1));
    }
}

TEST_F(LoadObj, materials_are_lambert_mirror_or_lamp) {
    Image red({2, 2}, 3);
    for (std::size_t p = 0; p < 4; ++p) red.data[3 * p] = 1;
    write_image(red, dir_.file("red.png"));
    dir_.write("a.mtl",
               "newmtl matt\nKd 0.1 0.2 0.3\nmap_Kd red.png\n"
               "newmtl glass\nKd 1 0 0\nKs 0.9 0.8 0.7\nillum 3\n"
               "newmtl lamp\nKd 0 0 0\nKe 5 6 7\nnewmtl unused\n");
    const LoadedScene loaded = load("mtllib a.mtl\n" + std::string(square) +
                                    "usemtl lamp\nf 1 2 3\nusemtl matt\nf 1 3 4\n"
                                    "usemtl glass\nf 1 2 4\nusemtl lamp\nf 2 3 4\n");
    expect_sound(loaded.bundle);
    const Scene& scene = loaded.bundle.scene;
    ASSERT_EQ(scene.materials.size(), 3u);
    EXPECT_EQ(mesh_of(loaded.bundle, 0).slots, (std::vector<std::uint16_t>{0, 1, 2, 0}));
    const auto named = [&](const std::string& name) {
        return *std::find_if(scene.materials.begin(), scene.materials.end(),
                             [&](const Material& m) { return m.name == name; });
    };
    EXPECT_EQ(named("lamp").emission, vec3(5, 6, 7));
    EXPECT_TRUE(named("lamp").two_sided_emission);
    EXPECT_EQ(named("matt").base_color, vec3(0.1f, 0.2f, 0.3f));
    EXPECT_EQ(named("matt").metallic, 0);
    EXPECT_EQ(named("matt").roughness, 1);
    EXPECT_EQ(texture_of(loaded.bundle, named("matt").base_color_map.texture).rgba[0], 255);
    EXPECT_EQ(named("glass").base_color, vec3(0.9f, 0.8f, 0.7f));
    EXPECT_EQ(named("glass").metallic, 1);
    EXPECT_EQ(named("glass").roughness, 0);
    EXPECT_TRUE(has_note(loaded.notes, "1 unused material"));
}

TEST_F(LoadObj, missing_materials_and_textures_are_notes) {
    dir_.write("b.mtl", "newmtl m\nmap_Kd gone.png\n");
    const LoadedScene loaded = load("mtllib nowhere.mtl b.mtl\n" + std::string(square) +
                                    "usemtl m\nf 1 2 3\nusemtl ghost\nf 1 3 4\n");
    EXPECT_TRUE(has_note(loaded.notes, "nowhere.mtl"));
    EXPECT_TRUE(has_note(loaded.notes, "gone.png"));
    EXPECT_TRUE(has_note(loaded.notes, "ghost"));
}

TEST_F(LoadObj, nothing_outside_the_folder_is_read) {
    const TempDir elsewhere;
    const std::filesystem::path library = elsewhere.write("b.mtl", "newmtl m\nKd 1 0 0\n");
    std::filesystem::create_symlink(library, dir_.file("link.mtl"));
    const std::string upwards = library.lexically_relative(dir_.file("")).string();
    for (const std::string& name : {library.string(), upwards, std::string("link.mtl")}) {
        const LoadedScene loaded =
            load("mtllib " + name + "\n" + std::string(square) + "usemtl m\nf 1 2 3\n");
        EXPECT_TRUE(has_note(loaded.notes, name + " lies outside")) << name;
        EXPECT_TRUE(has_note(loaded.notes, "'m' is not defined")) << name;
    }
}

TEST_F(LoadObj, degenerate_and_infinite_triangles_are_counted) {
    const LoadedScene loaded =
        load(std::string(square) + "v nan 0 0\nv 2 0 0\nf 1 2 3\nf 1 1 2\nf 1 2 6\nf 1 2 5\n");
    EXPECT_EQ(world_triangles(loaded.bundle).size(), 1u);
    EXPECT_EQ(mesh_of(loaded.bundle, 0).positions.size(), 3u);
    EXPECT_TRUE(has_note(loaded.notes, "2 triangles without area"));
    EXPECT_TRUE(has_note(loaded.notes, "1 triangles with vertices that are not finite"));
}

TEST_F(LoadObj, lines_may_be_continued_and_end_as_on_windows) {
    const LoadedScene loaded = load("v 0 0 0\r\nv 1 0 \\\r\n0\r\nv +1 1e0 0\r\nf 1 2 \\\r\n 3\r\n");
    EXPECT_EQ(world_triangles(loaded.bundle).size(), 1u);
}

TEST_F(LoadObj, errors_name_the_line) {
    const std::string head(square);
    EXPECT_TRUE(error(head + "f 1 2 9\n").starts_with("a.obj:5: vertex 9 is out of range"));
    EXPECT_TRUE(error(head + "f 1 2 0\n").starts_with("a.obj:5: vertex 0 is out of range"));
    EXPECT_TRUE(error(head + "f 1 2 -5\n").starts_with("a.obj:5: vertex -5 is out of range"));
    EXPECT_TRUE(error(head + "\nf 1 2\n").starts_with("a.obj:6: a face of 2 corners"));
    EXPECT_TRUE(error(head + "f 1 2 x\n").starts_with("a.obj:5: 'x' is no vertex index"));
    EXPECT_TRUE(error(head + "f 1/7 2/7 3/7\n").starts_with("a.obj:5: texture coordinate 7"));
    EXPECT_TRUE(error(head + "f 1//2 2//2 3//2\n").starts_with("a.obj:5: normal 2"));
    EXPECT_TRUE(error("v 1 two 3\n").starts_with("a.obj:1: 'two' is no number"));
    EXPECT_TRUE(error("v 1 2\n").starts_with("a.obj:1: a number is missing"));
}

TEST_F(LoadObj, an_empty_file_is_an_empty_scene) {
    const LoadedScene loaded = load("");
    EXPECT_TRUE(loaded.bundle.scene.instances.empty());
    EXPECT_TRUE(has_note(loaded.notes, "empty mesh"));
}

TEST(LoadObjFile, conference_keeps_its_triangles) {
    const char* file = TESSERA_SHARED_DIR "/scenes/conference/conference.obj";
    if (!std::filesystem::exists(file)) GTEST_SKIP() << "no " << file;
    const LoadedScene loaded = load_obj(file);
    expect_sound(loaded.bundle);
    EXPECT_GT(world_triangles(loaded.bundle).size(), 250000u);
}

}  // namespace
}  // namespace tessera
