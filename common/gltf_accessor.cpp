#include "common/gltf_accessor.h"

#include <fmt/format.h>
#include <tiny_gltf.h>

#include <cstring>
#include <limits>
#include <type_traits>

#include "common/check.h"

namespace tessera {
namespace {

/// An accessor without data is all zeros and costs the file nothing, so its size has a bound.
constexpr std::uint64_t max_implicit_count = std::uint64_t(1) << 22;

[[noreturn]] void broken(const std::string& origin, const std::string& what) {
    throw UserError(fmt::format("{}: {}; repair the file or export it again", origin, what));
}

/// Values of one type at a fixed distance in a buffer.
struct StridedView {
    const unsigned char* data = nullptr;
    std::uint64_t count = 0;
    std::uint64_t stride = 0;  ///< bytes
    int component_type = 0;
    bool normalized = false;

    double component(std::uint64_t element, int which) const;
};

template <class T>
double load(const unsigned char* from, int which, bool normalized) {
    T value;
    std::memcpy(&value, from + std::size_t(which) * sizeof(T), sizeof(T));
    if (!normalized || std::is_floating_point_v<T>) return double(value);
    return std::max(-1.0, double(value) / double(std::numeric_limits<T>::max()));
}

double StridedView::component(std::uint64_t element, int which) const {
    const unsigned char* from = data + element * stride;
    switch (component_type) {
        case TINYGLTF_COMPONENT_TYPE_BYTE:
            return load<std::int8_t>(from, which, normalized);
        case TINYGLTF_COMPONENT_TYPE_UNSIGNED_BYTE:
            return load<std::uint8_t>(from, which, normalized);
        case TINYGLTF_COMPONENT_TYPE_SHORT:
            return load<std::int16_t>(from, which, normalized);
        case TINYGLTF_COMPONENT_TYPE_UNSIGNED_SHORT:
            return load<std::uint16_t>(from, which, normalized);
        case TINYGLTF_COMPONENT_TYPE_UNSIGNED_INT:
            return load<std::uint32_t>(from, which, normalized);
        default:
            return load<float>(from, which, normalized);
    }
}

/// Bytes of a component type that glTF allows in an accessor, or 0.
std::uint64_t component_size(int type) {
    switch (type) {
        case TINYGLTF_COMPONENT_TYPE_BYTE:
        case TINYGLTF_COMPONENT_TYPE_UNSIGNED_BYTE:
            return 1;
        case TINYGLTF_COMPONENT_TYPE_SHORT:
        case TINYGLTF_COMPONENT_TYPE_UNSIGNED_SHORT:
            return 2;
        case TINYGLTF_COMPONENT_TYPE_UNSIGNED_INT:
        case TINYGLTF_COMPONENT_TYPE_FLOAT:
            return 4;
        default:
            return 0;
    }
}

bool is_unsigned(int component_type) {
    return component_type == TINYGLTF_COMPONENT_TYPE_UNSIGNED_BYTE ||
           component_type == TINYGLTF_COMPONENT_TYPE_UNSIGNED_SHORT ||
           component_type == TINYGLTF_COMPONENT_TYPE_UNSIGNED_INT;
}

/// `count` values of `components` components from `offset` in buffer view `view`.
StridedView strided_view(const tinygltf::Model& model, const std::string& origin, int view,
                         std::uint64_t offset, std::uint64_t count, int component_type,
                         int components) {
    const std::uint64_t value_size = component_size(component_type) * std::uint64_t(components);
    if (value_size == 0) broken(origin, "unknown component type");
    const ByteRange bytes = buffer_view_bytes(model, view, origin);
    const std::uint64_t given = model.bufferViews[std::size_t(view)].byteStride;
    const std::uint64_t stride = given == 0 ? value_size : given;
    if (stride < value_size || stride > 4096) broken(origin, "byteStride does not fit the values");
    const bool fits = offset <= bytes.size &&
                      (count == 0 || (bytes.size - offset >= value_size &&
                                      count - 1 <= (bytes.size - offset - value_size) / stride));
    if (!fits) broken(origin, fmt::format("{} values do not fit into buffer view {}", count, view));
    return {.data = bytes.data + offset,
            .count = count,
            .stride = stride,
            .component_type = component_type};
}

/// All components of all values, in order; `Convert` makes the element type.
template <class Element, class Convert>
std::vector<Element> read(const tinygltf::Model& model, const tinygltf::Accessor& accessor,
                          const std::string& origin, int components, Convert convert) {
    if (tinygltf::GetNumComponentsInType(std::uint32_t(accessor.type)) != components)
        broken(origin, fmt::format("its values must have {} components", components));
    std::vector<Element> values;
    if (accessor.bufferView >= 0) {
        StridedView view = strided_view(model, origin, accessor.bufferView, accessor.byteOffset,
                                        accessor.count, accessor.componentType, components);
        view.normalized = accessor.normalized;
        values.reserve(view.count);
        for (std::uint64_t i = 0; i < view.count; ++i) values.push_back(convert(view, i));
    } else {
        if (accessor.count > max_implicit_count) broken(origin, "it has no data for its count");
        values.resize(accessor.count);
    }
    if (!accessor.sparse.isSparse) return values;
    const auto& sparse = accessor.sparse;
    if (sparse.count < 0 || sparse.indices.byteOffset < 0 || sparse.values.byteOffset < 0 ||
        !is_unsigned(sparse.indices.componentType))
        broken(origin, "its sparse part is malformed");
    const auto count = std::uint64_t(sparse.count);
    const StridedView places = strided_view(model, origin, sparse.indices.bufferView,
                                            std::uint64_t(sparse.indices.byteOffset), count,
                                            sparse.indices.componentType, 1);
    StridedView replacements = strided_view(model, origin, sparse.values.bufferView,
                                            std::uint64_t(sparse.values.byteOffset), count,
                                            accessor.componentType, components);
    replacements.normalized = accessor.normalized;
    for (std::uint64_t i = 0; i < count; ++i) {
        const auto place = std::uint64_t(places.component(i, 0));
        if (place >= values.size()) broken(origin, "a sparse index is out of range");
        values[place] = convert(replacements, i);
    }
    return values;
}

const tinygltf::Accessor& accessor_at(const tinygltf::Model& model, int index,
                                      const std::string& file) {
    if (index < 0 || std::size_t(index) >= model.accessors.size())
        broken(file, fmt::format("accessor {} does not exist", index));
    return model.accessors[std::size_t(index)];
}

std::string origin_of(const std::string& file, int accessor) {
    return fmt::format("{}: accessor {}", file, accessor);
}

}  // namespace

ByteRange buffer_view_bytes(const tinygltf::Model& model, int index, const std::string& origin) {
    if (index < 0 || std::size_t(index) >= model.bufferViews.size())
        broken(origin, fmt::format("buffer view {} does not exist", index));
    const tinygltf::BufferView& view = model.bufferViews[std::size_t(index)];
    if (view.buffer < 0 || std::size_t(view.buffer) >= model.buffers.size())
        broken(origin, fmt::format("buffer {} does not exist", view.buffer));
    const auto& data = model.buffers[std::size_t(view.buffer)].data;
    if (view.byteOffset > data.size() || view.byteLength > data.size() - view.byteOffset)
        broken(origin, fmt::format("buffer view {} reaches beyond its buffer", index));
    return {data.data() + view.byteOffset, view.byteLength};
}

template <class Vector>
std::vector<Vector> AccessorReader::vectors(int index) const {
    const tinygltf::Accessor& accessor = accessor_at(model_, index, file_);
    const auto convert = [](const StridedView& view, std::uint64_t i) {
        Vector v;
        for (int c = 0; c < Vector::length(); ++c) v[c] = float(view.component(i, c));
        return v;
    };
    return read<Vector>(model_, accessor, origin_of(file_, index), Vector::length(), convert);
}
template std::vector<vec2> AccessorReader::vectors(int) const;
template std::vector<vec3> AccessorReader::vectors(int) const;
template std::vector<vec4> AccessorReader::vectors(int) const;

std::vector<glm::dmat4> AccessorReader::mat4s(int index) const {
    const tinygltf::Accessor& accessor = accessor_at(model_, index, file_);
    const auto convert = [](const StridedView& view, std::uint64_t i) {
        glm::dmat4 m;
        for (int c = 0; c < 16; ++c) m[c / 4][c % 4] = view.component(i, c);
        return m;
    };
    return read<glm::dmat4>(model_, accessor, origin_of(file_, index), 16, convert);
}

std::vector<float> AccessorReader::floats(int index) const {
    const tinygltf::Accessor& accessor = accessor_at(model_, index, file_);
    const int components = tinygltf::GetNumComponentsInType(std::uint32_t(accessor.type));
    if (components < 1 || components > 4)
        broken(origin_of(file_, index), "numbers or vectors are wanted");
    const auto convert = [&](const StridedView& view, std::uint64_t i) {
        vec4 v(0);
        for (int c = 0; c < components; ++c) v[c] = float(view.component(i, c));
        return v;
    };
    std::vector<float> out;
    for (const vec4& v : read<vec4>(model_, accessor, origin_of(file_, index), components, convert))
        for (int c = 0; c < components; ++c) out.push_back(v[c]);
    return out;
}

std::vector<std::uint32_t> AccessorReader::indices(int index) const {
    const tinygltf::Accessor& accessor = accessor_at(model_, index, file_);
    if (!is_unsigned(accessor.componentType))
        broken(origin_of(file_, index), "indices must be unsigned integers");
    return read<std::uint32_t>(model_, accessor, origin_of(file_, index), 1,
                               [](const StridedView& view, std::uint64_t i) {
                                   return std::uint32_t(view.component(i, 0));
                               });
}

}  // namespace tessera
