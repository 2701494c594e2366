// PLY: ascii and both binary orders are the same scene; broken files are refused with their place.

#include <gtest/gtest.h>

#include <algorithm>
#include <bit>

#include "common/scene_io.h"
#include "tests/scene_checks.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

class LoadPly : public testing::Test {
protected:
    LoadedScene load(std::string_view bytes) { return load_ply(dir_.write("a.ply", bytes)); }

    std::string error(std::string_view bytes) {
        const std::string message = user_error([&] { load(bytes); });
        const std::size_t at = message.find("a.ply");
        return at == std::string::npos ? message : message.substr(at);
    }

    TempDir dir_;
};

std::string header(const std::string& format, int vertices, int faces) {
    return "ply\nformat " + format + " 1.0\ncomment made by a test\nelement vertex " +
           std::to_string(vertices) +
           "\nproperty float x\nproperty float y\nproperty float z\nelement face " +
           std::to_string(faces) + "\nproperty list uchar int vertex_indices\nend_header\n";
}

const std::string square = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n";

template <class T>
void put(std::string& out, T value, bool big) {
    auto bytes = std::bit_cast<std::array<char, sizeof(T)>>(value);
    if (big) std::reverse(bytes.begin(), bytes.end());
    out.append(bytes.data(), bytes.size());
}

std::string binary_square(bool big) {
    std::string out = header(big ? "binary_big_endian" : "binary_little_endian", 4, 1);
    for (const float v : {0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0}) put(out, v, big);
    put(out, std::uint8_t(4), big);
    for (const std::int32_t i : {0, 1, 2, 3}) put(out, i, big);
    return out;
}

TEST_F(LoadPly, all_encodings_are_the_same_scene) {
    const LoadedScene ascii = load(header("ascii", 4, 1) + square + "4 0 1 2 3\n");
    expect_sound(ascii.bundle);
    EXPECT_EQ(mesh_of(ascii.bundle, 0).triangles, (std::vector<uvec3>{{0, 1, 2}, {0, 2, 3}}));
    EXPECT_EQ(load(binary_square(false)).bundle.scene, ascii.bundle.scene);
    EXPECT_EQ(load(binary_square(true)).bundle.scene, ascii.bundle.scene);
}

TEST_F(LoadPly, normals_and_texture_coordinates_are_read_and_the_rest_skipped) {
    const LoadedScene loaded = load(
        "ply\nformat ascii 1.0\nelement camera 1\nproperty float w\nproperty list uchar float k\n"
        "element vertex 3\nproperty uchar red\nproperty double x\nproperty float y\nproperty "
        "float z\nproperty float nx\nproperty float ny\nproperty float nz\nproperty float s\n"
        "property float t\nelement face 1\nproperty uchar flags\nproperty list uint8 uint16 "
        "vertex_index\nend_header\n7 2 5 6\n255 0 0 0 0 0 1 0 0\n255 1 0 0 0 0 1 1 0\n"
        "255 0 1 0 0 0 1 0 1\n9 3 0 1 2\n");
    const Mesh mesh = mesh_of(loaded.bundle, 0);
    EXPECT_EQ(mesh.positions, (std::vector<vec3>{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}}));
    EXPECT_EQ(mesh.normals, (std::vector<vec3>(3, {0, 0, 1})));
    EXPECT_EQ(mesh.texcoords, (std::vector<vec2>{{0, 1}, {1, 1}, {0, 0}}));
    EXPECT_TRUE(has_note(loaded.notes, "vertex colours"));
}

TEST_F(LoadPly, ascii_errors_name_the_line) {
    const std::string head = header("ascii", 4, 1);  // ten lines long
    EXPECT_TRUE(
        error(head + square + "3 0 1 4\n").starts_with("a.ply:15: vertex 4 is out of range"));
    EXPECT_TRUE(error(head + square + "3 0 1 -1\n").starts_with("a.ply:15: vertex -1"));
    EXPECT_TRUE(error(head + square + "2 0 1\n").starts_with("a.ply:15: a face of 2 corners"));
    EXPECT_TRUE(error(head + "0 0 x\n").starts_with("a.ply:11: 'x' is no number"));
    EXPECT_NE(error(head + "0 0 0\n").find("the file ends early"), std::string::npos);
    EXPECT_TRUE(error("solid\n").starts_with("a.ply:1: this is no PLY file"));
    EXPECT_TRUE(error("ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\n")
                    .starts_with("a.ply:4: 'quad' is no PLY type"));
    EXPECT_NE(error("ply\nformat ascii 1.0\n").find("end_header"), std::string::npos);
}

TEST_F(LoadPly, binary_errors_name_the_byte) {
    const std::string whole = binary_square(false);
    EXPECT_NE(error(whole.substr(0, whole.size() - 1)).find("a.ply: byte "), std::string::npos);
    std::string out_of_range = whole;
    out_of_range.back() = 1;
    EXPECT_NE(error(out_of_range).find("out of range"), std::string::npos);
}

TEST_F(LoadPly, forged_counts_allocate_nothing) {
    EXPECT_NE(error(header("ascii", 2000000000, 1) + square).find("ends early"), std::string::npos);
    EXPECT_NE(error(header("binary_little_endian", 2000000000, 1)).find("ends early"),
              std::string::npos);
}

TEST_F(LoadPly, every_cut_off_file_is_refused_or_smaller) {
    const std::string whole = binary_square(false);
    for (std::size_t size = 0; size < whole.size(); ++size)
        user_error([&] { load(whole.substr(0, size)); });
}

TEST_F(LoadPly, no_vertices_are_an_empty_scene) {
    EXPECT_TRUE(load(header("ascii", 0, 0)).bundle.scene.instances.empty());
}

}  // namespace
}  // namespace tessera
