#include "common/mesh.h"

#include <bit>
#include <cstring>
#include <stdexcept>
#include <type_traits>

#include "common/fixed_point.h"

namespace tessera {
namespace {

static_assert(std::endian::native == std::endian::little, "blobs are little-endian");
static_assert(sizeof(vec3) == 12 && sizeof(vec2) == 8 && sizeof(uvec3) == 12);

constexpr std::uint32_t mesh_magic = 0x314d5354;     // "TSM1"
constexpr std::uint32_t shape_magic = 0x31535354;    // "TSS1"
constexpr std::uint32_t packed_magic = 0x51535354;   // "TSSQ"
constexpr std::uint32_t texture_magic = 0x31545354;  // "TST1"
constexpr std::uint32_t float_magic = 0x46545354;    // "TSTF"

class Writer {
public:
    template <class T>
    void value(const T& v) {
        static_assert(std::is_trivially_copyable_v<T>);
        append(&v, sizeof v);
    }
    template <class T>
    void array(const std::vector<T>& v) {
        value(std::uint64_t(v.size()));
        append(v.data(), v.size() * sizeof(T));
    }
    Bytes take() { return std::move(bytes_); }

private:
    void append(const void* data, std::size_t size) {
        const auto* p = static_cast<const std::byte*>(data);
        bytes_.insert(bytes_.end(), p, p + size);
    }
    Bytes bytes_;
};

class Reader {
public:
    explicit Reader(std::span<const std::byte> bytes) : rest_(bytes) {}

    template <class T>
    T value() {
        static_assert(std::is_trivially_copyable_v<T>);
        T v;
        copy_out(&v, sizeof v);
        return v;
    }
    template <class T>
    std::vector<T> array() {
        const auto count = value<std::uint64_t>();
        if (count > rest_.size() / sizeof(T)) throw std::runtime_error("blob ends early");
        std::vector<T> v(count);
        copy_out(v.data(), count * sizeof(T));
        return v;
    }
    void expect_end() const {
        if (!rest_.empty()) throw std::runtime_error("blob has bytes left over");
    }

private:
    void copy_out(void* to, std::size_t size) {
        if (size > rest_.size()) throw std::runtime_error("blob ends early");
        if (size > 0) std::memcpy(to, rest_.data(), size);
        rest_ = rest_.subspan(size);
    }
    std::span<const std::byte> rest_;
};

void write(const PackedPoints& points, Writer& out) {
    out.value(points.error);
    out.value(points.count);
    out.value(points.lo);
    out.value(points.step);
    out.value(points.bits);
    out.array(points.packed);
}

PackedPoints read_points(Reader& in) {
    PackedPoints points;
    points.error = in.value<float>();
    points.count = in.value<std::uint64_t>();
    points.lo = in.value<vec3>();
    points.step = in.value<vec3>();
    points.bits = in.value<uvec3>();
    points.packed = in.array<std::byte>();
    return points;
}

}  // namespace

Bytes encode(const Mesh& mesh) {
    Writer out;
    out.value(mesh_magic);
    out.array(mesh.positions);
    out.array(mesh.normals);
    out.array(mesh.texcoords);
    out.array(mesh.triangles);
    out.array(mesh.slots);
    return out.take();
}

Mesh decode_mesh(std::span<const std::byte> bytes) {
    Reader in(bytes);
    if (in.value<std::uint32_t>() != mesh_magic) throw std::runtime_error("blob is not a mesh");
    Mesh mesh;
    mesh.positions = in.array<vec3>();
    mesh.normals = in.array<vec3>();
    mesh.texcoords = in.array<vec2>();
    mesh.triangles = in.array<uvec3>();
    mesh.slots = in.array<std::uint16_t>();
    in.expect_end();
    const auto fits = [](std::size_t optional, std::size_t count) {
        return optional == 0 || optional == count;
    };
    if (!fits(mesh.normals.size(), mesh.positions.size()) ||
        !fits(mesh.texcoords.size(), mesh.positions.size()) ||
        !fits(mesh.slots.size(), mesh.triangles.size()))
        throw std::runtime_error("mesh arrays disagree in length");
    for (const uvec3& t : mesh.triangles)
        if (std::max({t.x, t.y, t.z}) >= mesh.positions.size())
            throw std::runtime_error("mesh index out of range");
    return mesh;
}

Bytes encode(const Shape& shape) {
    Writer out;
    out.value(shape_magic);
    out.array(shape.positions);
    out.array(shape.normals);
    return out.take();
}

Bytes encode_within(const Shape& shape, float error) {
    constexpr float normal_error = 1e-3f;
    Writer out;
    out.value(packed_magic);
    write(pack(shape.positions, error), out);
    write(pack(shape.normals, normal_error), out);
    return out.take();
}

float shape_error(std::span<const std::byte> shape) {
    constexpr std::size_t head = sizeof(std::uint32_t) + sizeof(float);
    if (shape.size() < head) return 0;
    Reader in(shape.first(head));
    return in.value<std::uint32_t>() == packed_magic ? in.value<float>() : 0;
}

Shape decode_shape(std::span<const std::byte> bytes) {
    Reader in(bytes);
    const auto magic = in.value<std::uint32_t>();
    if (magic != shape_magic && magic != packed_magic)
        throw std::runtime_error("blob is not a shape");
    Shape shape;
    if (magic == packed_magic) {
        shape.positions = unpack(read_points(in));
        shape.normals = unpack(read_points(in));
    } else {
        shape.positions = in.array<vec3>();
        shape.normals = in.array<vec3>();
    }
    in.expect_end();
    if (!shape.normals.empty() && shape.normals.size() != shape.positions.size())
        throw std::runtime_error("shape arrays disagree in length");
    return shape;
}

std::uint64_t vertex_count(std::span<const std::byte> mesh) {
    constexpr std::size_t head = sizeof(std::uint32_t) + sizeof(std::uint64_t);
    if (mesh.size() < head) return 0;
    Reader in(mesh.first(head));
    return in.value<std::uint32_t>() == mesh_magic ? in.value<std::uint64_t>() : 0;
}

Mesh reshaped(Mesh mesh, Shape shape) {
    if (shape.positions.size() != mesh.positions.size())
        throw std::runtime_error("shape and mesh differ in their number of vertices");
    mesh.positions = std::move(shape.positions);
    mesh.normals = std::move(shape.normals);
    return mesh;
}

Bytes encode(const Texture& texture) {
    Writer out;
    out.value(texture.radiance.empty() ? texture_magic : float_magic);
    out.value(texture.width);
    out.value(texture.height);
    out.value(std::uint8_t(texture.srgb));
    out.value(texture.wrap_u);
    out.value(texture.wrap_v);
    if (texture.radiance.empty())
        out.array(texture.rgba);
    else
        out.array(texture.radiance);
    return out.take();
}

Texture decode_texture(std::span<const std::byte> bytes) {
    Reader in(bytes);
    const auto magic = in.value<std::uint32_t>();
    if (magic != texture_magic && magic != float_magic)
        throw std::runtime_error("blob is not a texture");
    const auto wrap = [&] {
        const auto value = in.value<std::uint8_t>();
        if (value > std::uint8_t(Wrap::clamp)) throw std::runtime_error("texture wrap unknown");
        return Wrap(value);
    };
    Texture texture;
    texture.width = in.value<std::uint32_t>();
    texture.height = in.value<std::uint32_t>();
    texture.srgb = in.value<std::uint8_t>() != 0;
    texture.wrap_u = wrap();
    texture.wrap_v = wrap();
    if (magic == float_magic)
        texture.radiance = in.array<vec3>();
    else
        texture.rgba = in.array<std::uint8_t>();
    in.expect_end();
    if (texture.width == 0 || texture.height == 0 ||
        texture.rgba.size() / 4 + texture.radiance.size() !=
            std::uint64_t(texture.width) * texture.height ||
        texture.rgba.size() % 4 != 0)
        throw std::runtime_error("texture size and pixels disagree");
    return texture;
}

}  // namespace tessera
