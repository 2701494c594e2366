#include "common/scene_io.h"

#include <fmt/format.h>

#include "common/check.h"
#include "common/generator.h"
#include "common/image_io.h"
#include "common/text_reader.h"

namespace tessera {
namespace {

using Loader = LoadedScene (*)(const std::filesystem::path&);

struct Format {
    const char* extension;
    Loader load;
};

constexpr Format formats[] = {
    {".obj", load_obj}, {".ply", load_ply}, {".gltf", load_gltf}, {".glb", load_gltf}};

const Format* format_of(const std::filesystem::path& file) {
    std::string extension = file.extension().string();
    for (char& c : extension) c = char(std::tolower(static_cast<unsigned char>(c)));
    for (const Format& format : formats)
        if (extension == format.extension) return &format;
    return nullptr;
}

std::string generator_names() {
    std::string names;
    for (const GeneratedScene& scene : generated_scenes())
        names += (names.empty() ? "" : ", ") + scene.name;
    return names;
}

}  // namespace

LoadedScene load_scene(const std::string& file_or_name) {
    if (auto generated = generate_scene(file_or_name))
        return {.bundle = std::move(*generated), .notes = {}};
    const std::filesystem::path file(file_or_name);
    const Format* format = format_of(file);
    if (format == nullptr)
        throw UserError(
            fmt::format("{}: neither a scene file (.obj, .ply, .gltf, .glb) nor a generated scene "
                        "({}); give one "
                        "of these",
                        file_or_name, generator_names()));
    if (!std::filesystem::exists(file))
        throw UserError(
            fmt::format("{}: no such file; check the name, or use a generated scene ({})",
                        file_or_name, generator_names()));
    return format->load(file);
}

void set_environment(SceneBundle& bundle, const std::string& file_or_radiance) {
    Environment& environment = bundle.scene.environment;
    double radiance = 0;
    if (parse_number(file_or_radiance, radiance)) {
        environment.radiance = vec3(float(radiance));
        return;
    }
    const Image image = read_image(file_or_radiance);
    Texture picture{.width = std::uint32_t(image.size.width),
                    .height = std::uint32_t(image.size.height),
                    .rgba = {}};
    for (std::size_t i = 0; i < image.size.pixels(); ++i)
        picture.radiance.emplace_back(image.data[3 * i], image.data[3 * i + 1],
                                      image.data[3 * i + 2]);
    environment.texture = std::int32_t(add_texture(bundle, picture));
    environment.radiance = vec3(1);
}

}  // namespace tessera
