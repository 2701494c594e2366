// Stanford PLY: ascii, binary little endian and binary big endian. Vertices may have normals
// (nx ny nz) and texture coordinates (s t, u v or texture_u texture_v); faces are lists of vertex
// indices. Everything else is skipped by its declared type. Vertex colours are not modelled.
//
// Nothing is allocated by a count that the file only claims: every element takes at least a byte of
// the file before memory follows.

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cstring>
#include <limits>
#include <optional>

#include "common/check.h"
#include "common/clean_mesh.h"
#include "common/polygon.h"
#include "common/scene_builder.h"
#include "common/scene_io.h"
#include "common/text_reader.h"

namespace tessera {
namespace {

enum class Type { i8, u8, i16, u16, i32, u32, f32, f64 };

std::optional<Type> type_named(std::string_view name) {
    constexpr std::array<std::pair<std::string_view, Type>, 16> names{{{"char", Type::i8},
                                                                       {"int8", Type::i8},
                                                                       {"uchar", Type::u8},
                                                                       {"uint8", Type::u8},
                                                                       {"short", Type::i16},
                                                                       {"int16", Type::i16},
                                                                       {"ushort", Type::u16},
                                                                       {"uint16", Type::u16},
                                                                       {"int", Type::i32},
                                                                       {"int32", Type::i32},
                                                                       {"uint", Type::u32},
                                                                       {"uint32", Type::u32},
                                                                       {"float", Type::f32},
                                                                       {"float32", Type::f32},
                                                                       {"double", Type::f64},
                                                                       {"float64", Type::f64}}};
    for (const auto& [text, type] : names)
        if (text == name) return type;
    return std::nullopt;
}

struct Property {
    std::string name;
    Type type = Type::f32;
    std::optional<Type> count_type;  ///< of a list
};

struct Element {
    std::string name;
    std::uint64_t count = 0;
    std::vector<Property> properties;
};

enum class Encoding { ascii, little, big };

struct Header {
    Encoding encoding = Encoding::ascii;
    std::vector<Element> elements;
};

Type read_type(TextReader& in) {
    const std::string_view word = in.word();
    const auto type = type_named(word);
    if (!type) in.fail(fmt::format("'{}' is no PLY type; correct the header", word.substr(0, 40)));
    return *type;
}

Property read_property(TextReader& in) {
    Property property;
    TextReader list_form = in;
    if (list_form.word() == "list") {
        in = list_form;
        property.count_type = read_type(in);
        if (*property.count_type == Type::f32 || *property.count_type == Type::f64)
            in.fail("a list's count must be an integer; correct the header");
    }
    property.type = read_type(in);
    property.name = in.word();
    return property;
}

Encoding read_encoding(TextReader& in) {
    const std::string_view word = in.word();
    if (word == "ascii") return Encoding::ascii;
    if (word == "binary_little_endian") return Encoding::little;
    if (word == "binary_big_endian") return Encoding::big;
    in.fail(fmt::format("unknown PLY format '{}'; use ascii or binary", word.substr(0, 40)));
}

Element read_element(TextReader& in) {
    Element element{.name = std::string(in.word()), .properties = {}};
    std::int64_t count;
    if (!parse_number(in.word(), count) || count < 0)
        in.fail(fmt::format("element {} has no count; correct the header", element.name));
    element.count = std::uint64_t(count);
    return element;
}

Header read_header(TextReader& in) {
    if (!in.next_line() || in.word() != "ply") in.fail("this is no PLY file: it lacks 'ply'");
    Header header;
    while (in.next_line()) {
        const std::string_view keyword = in.word();
        if (keyword == "end_header") return header;
        if (keyword == "format") header.encoding = read_encoding(in);
        if (keyword == "element") header.elements.push_back(read_element(in));
        if (keyword != "property") continue;
        if (header.elements.empty()) in.fail("a property before any element; correct the header");
        header.elements.back().properties.push_back(read_property(in));
    }
    in.fail("the header has no end_header; the file is cut off");
}

/// The values of an ascii body. One element is one line.
class AsciiBody {
public:
    explicit AsciiBody(TextReader& in) : in_(in) {}

    void begin_element() {
        do {
            if (!in_.next_line()) in_.fail("the file ends early; it lacks elements of the header");
        } while (in_.rest().empty());
    }
    double value(Type) { return in_.number(); }
    [[noreturn]] void fail(const std::string& what) const { in_.fail(what); }

private:
    TextReader& in_;
};

/// The values of a binary body.
class BinaryBody {
public:
    BinaryBody(std::string file, std::string_view bytes, std::size_t at, bool big_endian)
        : file_(std::move(file)),
          bytes_(bytes),
          at_(std::min(at, bytes.size())),
          big_(big_endian) {}

    void begin_element() {
        if (at_ >= bytes_.size()) fail("the file ends early; it lacks elements of the header");
    }

    double value(Type type) {
        switch (type) {
            case Type::i8:
                return raw<std::int8_t>();
            case Type::u8:
                return raw<std::uint8_t>();
            case Type::i16:
                return raw<std::int16_t>();
            case Type::u16:
                return raw<std::uint16_t>();
            case Type::i32:
                return raw<std::int32_t>();
            case Type::u32:
                return raw<std::uint32_t>();
            case Type::f32:
                return raw<float>();
            case Type::f64:
                return raw<double>();
        }
        return 0;
    }

    [[noreturn]] void fail(const std::string& what) const {
        throw UserError(fmt::format("{}: byte {}: {}", file_, at_, what));
    }

private:
    template <class T>
    T raw() {
        if (bytes_.size() - at_ < sizeof(T)) fail("the file ends early; copy it again");
        std::array<char, sizeof(T)> bytes;
        std::memcpy(bytes.data(), bytes_.data() + at_, sizeof(T));
        at_ += sizeof(T);
        if (big_) std::reverse(bytes.begin(), bytes.end());
        return std::bit_cast<T>(bytes);
    }

    std::string file_;
    std::string_view bytes_;
    std::size_t at_;
    bool big_;
};

/// Where a vertex property goes; anything else is read and forgotten.
float* destination(const std::string& name, vec3& position, vec3& normal, vec2& texcoord) {
    if (name == "x") return &position.x;
    if (name == "y") return &position.y;
    if (name == "z") return &position.z;
    if (name == "nx") return &normal.x;
    if (name == "ny") return &normal.y;
    if (name == "nz") return &normal.z;
    if (name == "s" || name == "u" || name == "texture_u") return &texcoord.x;
    if (name == "t" || name == "v" || name == "texture_v") return &texcoord.y;
    return nullptr;
}

bool has_property(const Element& element, std::initializer_list<std::string_view> names) {
    return std::any_of(element.properties.begin(), element.properties.end(), [&](const auto& p) {
        return std::find(names.begin(), names.end(), p.name) != names.end();
    });
}

template <class Body>
class BodyReader {
public:
    explicit BodyReader(Body& in) : in_(in) {}

    Mesh read(const Header& header) {
        for (const Element& element : header.elements) {
            if (element.properties.empty()) continue;
            if (element.name == "vertex")
                read_vertices(element);
            else if (element.name == "face")
                read_faces(element);
            else
                skip(element);
        }
        return std::move(mesh_);
    }

private:
    void read_vertices(const Element& element) {
        const bool normals = has_property(element, {"nx"});
        const bool texcoords = has_property(element, {"s", "u", "texture_u"});
        for (std::uint64_t i = 0; i < element.count; ++i) {
            in_.begin_element();
            vec3 position(0), normal(0);
            vec2 texcoord(0);
            for (const Property& property : element.properties) {
                float* to = destination(property.name, position, normal, texcoord);
                if (property.count_type || to == nullptr)
                    skip(property);
                else
                    *to = float(in_.value(property.type));
            }
            mesh_.positions.push_back(position);
            if (normals) mesh_.normals.push_back(normal);
            // PLY's texture coordinates start at the bottom left, as OBJ's.
            if (texcoords) mesh_.texcoords.push_back({texcoord.x, 1 - texcoord.y});
        }
    }

    void read_faces(const Element& element) {
        for (std::uint64_t i = 0; i < element.count; ++i) {
            in_.begin_element();
            for (const Property& property : element.properties)
                if (property.count_type &&
                    (property.name == "vertex_indices" || property.name == "vertex_index"))
                    read_polygon(property);
                else
                    skip(property);
        }
    }

    void read_polygon(const Property& property) {
        corners_.clear();
        positions_.clear();
        for (std::uint64_t left = list_size(property); left > 0; --left) {
            const double index = in_.value(property.type);
            if (!(index >= 0 && index < double(mesh_.positions.size())))
                in_.fail(
                    fmt::format("vertex {} is out of range: there are {}, counted from 0; "
                                "correct the index",
                                index, mesh_.positions.size()));
            corners_.push_back(std::uint32_t(index));
            positions_.push_back(mesh_.positions[corners_.back()]);
        }
        if (corners_.size() < 3)
            in_.fail(
                fmt::format("a face of {} corners; give it three or remove it", corners_.size()));
        for (const uvec3& t : triangulate(positions_))
            mesh_.triangles.push_back({corners_[t.x], corners_[t.y], corners_[t.z]});
    }

    std::uint64_t list_size(const Property& property) {
        const double size = in_.value(*property.count_type);
        if (!(size >= 0 && size <= double(std::numeric_limits<std::uint32_t>::max())))
            in_.fail(fmt::format("a list of {} entries; correct its count", size));
        return std::uint64_t(size);
    }

    void skip(const Property& property) {
        for (std::uint64_t n = property.count_type ? list_size(property) : 1; n > 0; --n)
            in_.value(property.type);
    }

    void skip(const Element& element) {
        for (std::uint64_t i = 0; i < element.count; ++i) {
            in_.begin_element();
            for (const Property& property : element.properties) skip(property);
        }
    }

    Body& in_;
    Mesh mesh_;
    std::vector<std::uint32_t> corners_;  // of the face being read
    std::vector<vec3> positions_;
};

Mesh read_body(const Header& header, const std::string& file, std::string_view text,
               TextReader& in) {
    if (header.encoding == Encoding::ascii) {
        AsciiBody body(in);
        return BodyReader(body).read(header);
    }
    BinaryBody body(file, text, in.offset(), header.encoding == Encoding::big);
    return BodyReader(body).read(header);
}

}  // namespace

LoadedScene load_ply(const std::filesystem::path& file) {
    const std::string text = read_file(file);
    TextReader in(file.string(), text);
    const Header header = read_header(in);
    Mesh mesh = read_body(header, file.string(), text, in);
    LoadedScene loaded;
    loaded.notes = describe(clean_mesh(mesh));
    for (const Element& element : header.elements)
        if (element.name == "vertex" && has_property(element, {"red", "diffuse_red"}))
            loaded.notes.push_back("vertex colours are not modelled: the surface is grey");
    if (mesh.triangles.empty()) return loaded;
    const auto grey = add_material(loaded.bundle, {.name = "default"});
    const std::string name = file.stem().string();
    add_instance(loaded.bundle, name, add_object(loaded.bundle, name, mesh, {grey}));
    return loaded;
}

}  // namespace tessera
