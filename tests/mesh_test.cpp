// decode(encode(x)) == x for meshes and textures; no bytes whatever do more than throw.

#include "common/mesh.h"

#include <gtest/gtest.h>

#include <random>
#include <stdexcept>

namespace tessera {
namespace {

Mesh random_mesh(std::mt19937& random, bool normals, bool texcoords, bool slots) {
    const auto number = [&] { return float(int(random() % 2000) - 1000) / 64; };
    Mesh mesh;
    const std::size_t vertices = 3 + random() % 50;
    for (std::size_t i = 0; i < vertices; ++i) {
        mesh.positions.push_back({number(), number(), number()});
        if (normals) mesh.normals.push_back({number(), number(), 1});
        if (texcoords) mesh.texcoords.push_back({number(), number()});
    }
    for (std::size_t i = random() % 60; i > 0; --i) {
        const auto index = [&] { return std::uint32_t(random() % vertices); };
        mesh.triangles.push_back({index(), index(), index()});
        if (slots) mesh.slots.push_back(std::uint16_t(random() % 5));
    }
    return mesh;
}

Texture small_texture() {
    Texture texture{.width = 3, .height = 2, .srgb = false, .wrap_v = Wrap::clamp, .rgba = {}};
    for (int i = 0; i < 24; ++i) texture.rgba.push_back(std::uint8_t(i * 10));
    return texture;
}

TEST(Mesh, decoding_undoes_encoding) {
    std::mt19937 random(1);
    for (int i = 0; i < 400; ++i) {
        const Mesh mesh = random_mesh(random, i & 1, i & 2, i & 4);
        ASSERT_EQ(decode_mesh(encode(mesh)), mesh);
    }
    EXPECT_EQ(decode_texture(encode(small_texture())), small_texture());
    const Texture light{.width = 2, .height = 1, .rgba = {}, .radiance = {vec3(1e9f), vec3(0.1f)}};
    EXPECT_EQ(decode_texture(encode(light)), light);
}

TEST(Mesh, shapes_come_back_and_fit_their_meshes_only) {
    std::mt19937 random(5);
    for (int i = 0; i < 100; ++i) {
        const Mesh mesh = random_mesh(random, i & 1, i & 2, i & 4);
        EXPECT_EQ(vertex_count(encode(mesh)), mesh.positions.size());
        Shape shape{mesh.positions, mesh.normals};
        const Bytes bytes = encode(shape);
        ASSERT_EQ(decode_shape(bytes), shape);
        EXPECT_EQ(reshaped(mesh, shape), mesh);
        EXPECT_EQ(vertex_count(bytes), 0u);
        EXPECT_THROW(decode_mesh(bytes), std::runtime_error);
        EXPECT_THROW(decode_shape(std::span(bytes).first(bytes.size() - 1)), std::runtime_error);
        shape.positions.pop_back();
        EXPECT_THROW(reshaped(mesh, shape), std::runtime_error);
        shape.normals.resize(1 + shape.positions.size());
        EXPECT_THROW(decode_shape(encode(shape)), std::runtime_error);
    }
}

TEST(Mesh, shapes_with_an_error_keep_it_and_say_so) {
    std::mt19937 random(6);
    std::uniform_real_distribution<float> within(-2, 2);
    for (const float error : {1e-1f, 1e-3f, 1e-5f}) {
        Shape shape;
        for (int i = 0; i < 500; ++i) {
            shape.positions.push_back({within(random), 3, 5 + within(random)});
            shape.normals.push_back(
                normalize(vec3(within(random), within(random), 2.5f + within(random))));
        }
        const Bytes bytes = encode_within(shape, error);
        const Shape again = decode_shape(bytes);
        ASSERT_EQ(again.positions.size(), shape.positions.size());
        float most = 0, most_of_normals = 0;
        for (std::size_t i = 0; i < shape.positions.size(); ++i) {
            most = std::max(most, max_component(abs(again.positions[i] - shape.positions[i])));
            most_of_normals =
                std::max(most_of_normals, max_component(abs(again.normals[i] - shape.normals[i])));
        }
        EXPECT_LE(most, error * 1.1f);
        EXPECT_EQ(shape_error(bytes), most);
        EXPECT_LE(most_of_normals, 1.1e-3f);
        EXPECT_LT(bytes.size(), encode(shape).size() * 3 / 4);
        for (std::size_t size = 0; size < bytes.size(); size += 97)
            EXPECT_THROW(decode_shape(std::span(bytes).first(size)), std::runtime_error);
    }
    EXPECT_EQ(decode_shape(encode_within({}, 1)), Shape());
    EXPECT_EQ(shape_error(encode(Shape())), 0);
}

/// The figures that README tells.
TEST(Mesh, four_thousand_triangles_on_their_own_ways_are_small_enough_to_send) {
    std::mt19937 random(7);
    std::uniform_real_distribution<float> within(-2.25f, 2.25f);  // as museum's
    Shape shape;
    for (int i = 0; i < 3 * 4096; ++i)
        shape.positions.push_back({within(random), within(random), within(random)});
    EXPECT_LE(encode(shape).size(), 150000u);
    EXPECT_LE(encode_within(shape, 1e-3f).size(), 60000u);
}

TEST(Mesh, equal_meshes_have_equal_bytes) {
    std::mt19937 a(7), b(7);
    EXPECT_EQ(encode(random_mesh(a, true, true, true)), encode(random_mesh(b, true, true, true)));
}

TEST(Mesh, any_shorter_or_longer_blob_is_refused) {
    std::mt19937 random(2);
    for (Bytes whole : {encode(random_mesh(random, true, true, true)), encode(small_texture())}) {
        const auto refused = [](const Bytes& bytes) {
            EXPECT_THROW(decode_mesh(bytes), std::runtime_error);
            EXPECT_THROW(decode_texture(bytes), std::runtime_error);
        };
        for (std::size_t size = 0; size < whole.size(); ++size)
            refused(Bytes(whole.begin(), whole.begin() + std::ptrdiff_t(size)));
        whole.push_back({});
        refused(whole);
    }
}

TEST(Mesh, changed_bytes_decode_or_throw) {
    std::mt19937 random(3);
    const Bytes mesh = encode(random_mesh(random, true, true, true));
    const Bytes texture = encode(small_texture());
    const auto decodes = [](auto decode, const Bytes& bytes) {
        try {
            return encode(decode(bytes)) == bytes;
        } catch (const std::runtime_error&) {
            return true;
        }
    };
    for (int i = 0; i < 20000; ++i) {
        Bytes changed = mesh;
        changed[random() % changed.size()] = std::byte(random());
        ASSERT_TRUE(decodes(decode_mesh, changed));
        changed = texture;
        // Bytes 12 is a truth value, of which every other value than 0 and 1 reads as 1.
        const std::size_t at = random() % changed.size();
        changed[at] = at == 12 ? std::byte(random() & 1) : std::byte(random());
        ASSERT_TRUE(decodes(decode_texture, changed));
    }
}

TEST(Mesh, indices_and_lengths_must_fit) {
    Mesh mesh;
    mesh.positions = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}};
    mesh.triangles = {{0, 1, 3}};
    EXPECT_THROW(decode_mesh(encode(mesh)), std::runtime_error);
    mesh.triangles = {{0, 1, 2}};
    mesh.normals = {{0, 0, 1}};
    EXPECT_THROW(decode_mesh(encode(mesh)), std::runtime_error);
}

TEST(Mesh, a_forged_count_allocates_nothing) {
    Bytes bytes = encode(Mesh{});
    for (std::size_t i = 4; i < 12; ++i) bytes[i] = std::byte(0xff);
    EXPECT_THROW(decode_mesh(bytes), std::runtime_error);
}

}  // namespace
}  // namespace tessera
