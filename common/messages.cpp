#include <fmt/format.h>

#include <bit>
#include <cmath>
#include <functional>
#include <utility>

#include "common/check.h"
#include "common/message_codec.h"
#include "protocol.pb.h"
#include "scene.pb.h"

// For every value type T there are `pack(const T&, wire::T&)` and `unpack(const wire::T&, T&)`;
// `unpack` throws ProtocolError for what no well-behaved peer sends. Generic code at the end picks
// the pair by the message's kind.

namespace tessera {
namespace {

static_assert(std::endian::native == std::endian::little, "payloads are little-endian");

template <class... Args>
[[noreturn]] void refuse(fmt::format_string<Args...> format, Args&&... args) {
    throw ProtocolError(fmt::format(format, std::forward<Args>(args)...));
}

// ---- Values -------------------------------------------------------------------------------------

template <class T>
T in_range(T value, T low, T high, const char* field) {
    if (value < low || value > high) refuse("{} is {}, must be {} to {}", field, value, low, high);
    return value;
}

template <class T>
T finite(T value, const char* field) {
    if (!std::isfinite(value)) refuse("{} is not finite", field);
    return value;
}

/// Seconds, errors: finite and not negative.
template <class T>
T amount(T value, const char* field) {
    if (!(finite(value, field) >= 0)) refuse("{} is negative", field);
    return value;
}

const std::string& short_text(const std::string& text, const char* field) {
    if (text.size() > max_name_bytes) refuse("{} is longer than {} bytes", field, max_name_bytes);
    const auto is_control = [](unsigned char c) { return c < 0x20 || c == 0x7f; };
    if (std::any_of(text.begin(), text.end(), is_control))
        refuse("{} holds control characters", field);
    return text;
}

void require_set(bool set, const char* field) {
    if (!set) refuse("{} is not set", field);
}

/// Enumerators on the wire are ours plus one, so that "not set" is none of them.
template <class Wire, class Enum>
Wire pack_enum(Enum value) {
    return Wire(int(value) + 1);
}

template <class Enum, class Wire>
Enum unpack_enum(Wire value, Enum last, const char* field) {
    if (int(value) < 1 || int(value) > int(last) + 1)
        refuse("{} has the unknown value {}", field, int(value));
    return Enum(int(value) - 1);
}

template <class Values, class Field>
void pack_texts(const Values& values, Field& out) {
    out.Assign(values.begin(), values.end());
}

template <class Field>
std::vector<std::string> unpack_texts(const Field& in) {
    return {in.begin(), in.end()};
}

// ---- Lists --------------------------------------------------------------------------------------

void pack(const BlobId& v, wire::BlobId& out) { out.set_sha256(v.digest.data(), v.digest.size()); }
void unpack(const wire::BlobId& in, BlobId& v) {
    if (in.sha256().size() != v.digest.size())
        refuse("blob id of {} bytes, must be {}", in.sha256().size(), v.digest.size());
    std::memcpy(v.digest.data(), in.sha256().data(), v.digest.size());
}

void pack(const WorkerShare& v, wire::WorkerShare& out) {
    out.set_name(v.name);
    out.set_threads(v.threads);
    out.set_tiles(v.tiles);
    out.set_rays(v.rays);
}
void unpack(const wire::WorkerShare& in, WorkerShare& v) {
    v.name = in.name();
    v.threads = in.threads();
    v.tiles = in.tiles();
    v.rays = in.rays();
}

void pack(const WorkerStatus& v, wire::WorkerStatus& out) {
    out.set_peer(v.peer);
    out.set_name(v.name);
    out.set_address(v.address);
    out.set_threads(v.threads);
    out.set_leases(v.leases);
    out.set_tiles(v.tiles);
    out.set_rays(v.rays);
    out.set_round_trip_seconds(v.round_trip_seconds);
    out.set_prefetch(v.prefetch);
    out.set_task_seconds(v.task_seconds);
    out.set_memory_bytes(v.memory_bytes);
    out.set_overdue(v.overdue);
    out.set_busy_seconds(v.busy_seconds);
    out.set_relayed_bytes(v.relayed_bytes);
    out.set_sent_bytes(v.sent_bytes);
}
void unpack(const wire::WorkerStatus& in, WorkerStatus& v) {
    v.peer = in.peer();
    v.name = in.name();
    v.address = in.address();
    v.threads = in.threads();
    v.leases = in.leases();
    v.tiles = in.tiles();
    v.rays = in.rays();
    v.round_trip_seconds = amount(in.round_trip_seconds(), "round_trip_seconds");
    v.prefetch = in.prefetch();
    v.task_seconds = amount(in.task_seconds(), "task_seconds");
    v.memory_bytes = in.memory_bytes();
    v.overdue = in.overdue();
    v.busy_seconds = amount(in.busy_seconds(), "busy_seconds");
    v.relayed_bytes = in.relayed_bytes();
    v.sent_bytes = in.sent_bytes();
}

void pack(const SceneStatus& v, wire::SceneStatus& out) {
    out.set_name(v.name);
    out.set_version(v.version);
    out.set_instances(v.instances);
    out.set_bytes(v.bytes);
}
void unpack(const wire::SceneStatus& in, SceneStatus& v) {
    v.name = in.name();
    v.version = in.version();
    v.instances = in.instances();
    v.bytes = in.bytes();
}

void pack(const SetShape& v, wire::SetShape& out) {
    out.set_object(v.object);
    pack(v.shape, *out.mutable_shape());
}
void unpack(const wire::SetShape& in, SetShape& v) {
    require_set(in.has_shape(), "shape");
    v.object = in.object();
    unpack(in.shape(), v.shape);
}

/// Into the message TileTask, and into the fields that TileReport shares with it.
template <class Out>
void pack_task(const TileTask& v, Out& out) {
    out.set_frame(v.frame);
    out.set_tile(v.tile);
    out.set_first_pass(v.first_pass);
    out.set_pass_count(v.pass_count);
    out.set_part(v.part);
}
template <class In>
void unpack_task(const In& in, TileTask& v) {
    v.frame = in.frame();
    v.tile = in_range(in.tile(), 0u, max_tiles - 1, "tile");
    v.first_pass = in_range(in.first_pass(), 0u, max_passes - 1, "first_pass");
    v.pass_count = in_range(in.pass_count(), 1u, max_passes - v.first_pass, "pass_count");
    v.part = in_range(in.part(), 0u, quarters, "part");
}

void pack(const TileTask& v, wire::TileTask& out) { pack_task(v, out); }
void unpack(const wire::TileTask& in, TileTask& v) { unpack_task(in, v); }

void pack(const std::vector<LightEstimate>& v, wire::LightEstimates& out) {
    for (const LightEstimate& estimate : v) {
        out.add_light(estimate.light);
        out.add_radiance(estimate.radiance);
    }
}
void unpack(const wire::LightEstimates& in, std::vector<LightEstimate>& v) {
    if (in.light_size() != in.radiance_size()) refuse("light estimates lack numbers or values");
    for (int i = 0; i < in.light_size(); ++i) {
        if (i > 0 && in.light(i) <= in.light(i - 1)) refuse("light estimates are not in order");
        v.push_back({in.light(i), amount(in.radiance(i), "radiance")});
    }
}

void pack(const TileReport& v, wire::TileReport& out) {
    pack_task(v.task, out);
    out.set_rays(v.rays);
    out.set_sanitised(v.sanitised);
    out.set_seconds(v.seconds);
    out.set_pixel_bytes(v.pixel_bytes);
    if (!v.lights.empty()) pack(v.lights, *out.mutable_lights());
    out.set_active_lights(v.active_lights);
}
void unpack(const wire::TileReport& in, TileReport& v) {
    unpack_task(in, v.task);
    v.rays = in.rays();
    v.sanitised = in.sanitised();
    v.seconds = amount(in.seconds(), "seconds");
    v.pixel_bytes = in.pixel_bytes();
    unpack(in.lights(), v.lights);
    v.active_lights = in.active_lights();
}

void pack(const EditOperation& v, wire::EditOperation& out);
void unpack(const wire::EditOperation& in, EditOperation& v);

template <class T, class Field>
void pack_each(const std::vector<T>& values, Field& out) {
    out.Reserve(int(values.size()));
    for (const T& value : values) pack(value, *out.Add());
}

template <class T, class Field>
void unpack_each(const Field& in, std::vector<T>& values) {
    values.resize(std::size_t(in.size()));
    for (int i = 0; i < in.size(); ++i) unpack(in[i], values[std::size_t(i)]);
}

// ---- Scenes -------------------------------------------------------------------------------------

void pack(const vec2& v, wire::Vec2& out) {
    out.set_x(v.x);
    out.set_y(v.y);
}
void unpack(const wire::Vec2& in, vec2& v) { v = {in.x(), in.y()}; }

void pack(const vec3& v, wire::Vec3& out) {
    out.set_x(v.x);
    out.set_y(v.y);
    out.set_z(v.z);
}
void unpack(const wire::Vec3& in, vec3& v) { v = {in.x(), in.y(), in.z()}; }

void pack(const TextureMap& v, wire::TextureMap& out) {
    out.set_texture_plus_one(std::uint32_t(v.texture + 1));
    pack(v.offset, *out.mutable_offset());
    pack(v.scale, *out.mutable_scale());
    out.set_rotation(v.rotation);
}
void unpack(const wire::TextureMap& in, TextureMap& v) {
    const std::uint32_t most = std::numeric_limits<std::int32_t>::max();
    v.texture = std::int32_t(in_range(in.texture_plus_one(), 0u, most, "texture_plus_one")) - 1;
    unpack(in.offset(), v.offset);
    unpack(in.scale(), v.scale);
    v.rotation = in.rotation();
}

void pack(const ShaderParameter& v, wire::ShaderParameter& out) {
    out.set_name(v.name);
    pack(v.value, *out.mutable_value());
}
void unpack(const wire::ShaderParameter& in, ShaderParameter& v) {
    v.name = in.name();
    unpack(in.value(), v.value);
}

void pack(const Material& v, wire::Material& out) {
    out.set_name(v.name);
    pack(v.base_color, *out.mutable_base_color());
    pack(v.base_color_map, *out.mutable_base_color_map());
    out.set_metallic(v.metallic);
    out.set_roughness(v.roughness);
    pack(v.metallic_roughness_map, *out.mutable_metallic_roughness_map());
    pack(v.emission, *out.mutable_emission());
    pack(v.emission_map, *out.mutable_emission_map());
    out.set_two_sided_emission(v.two_sided_emission);
    out.set_specular(v.specular);
    out.set_ior(v.ior);
    out.set_transmission(v.transmission);
    pack(v.transmission_map, *out.mutable_transmission_map());
    out.set_thin_walled(v.thin_walled);
    pack(v.normal_map, *out.mutable_normal_map());
    out.set_normal_scale(v.normal_scale);
    out.set_alpha_mode(pack_enum<wire::AlphaMode>(v.alpha_mode));
    out.set_alpha(v.alpha);
    out.set_alpha_cutoff(v.alpha_cutoff);
    out.set_shader(v.shader);
    for (const ShaderParameter& p : v.shader_parameters) pack(p, *out.add_shader_parameters());
}
void unpack(const wire::Material& in, Material& v) {
    v.name = in.name();
    unpack(in.base_color(), v.base_color);
    unpack(in.base_color_map(), v.base_color_map);
    v.metallic = in.metallic();
    v.roughness = in.roughness();
    unpack(in.metallic_roughness_map(), v.metallic_roughness_map);
    unpack(in.emission(), v.emission);
    unpack(in.emission_map(), v.emission_map);
    v.two_sided_emission = in.two_sided_emission();
    v.specular = in.specular();
    v.ior = in.ior();
    v.transmission = in.transmission();
    unpack(in.transmission_map(), v.transmission_map);
    v.thin_walled = in.thin_walled();
    unpack(in.normal_map(), v.normal_map);
    v.normal_scale = in.normal_scale();
    v.alpha_mode = unpack_enum(in.alpha_mode(), AlphaMode::blend, "alpha mode");
    v.alpha = in.alpha();
    v.alpha_cutoff = in.alpha_cutoff();
    v.shader = in.shader();
    for (const auto& p : in.shader_parameters()) unpack(p, v.shader_parameters.emplace_back());
}

void pack(const Environment& v, wire::Environment& out) {
    pack(v.radiance, *out.mutable_radiance());
    out.set_texture_plus_one(std::uint32_t(v.texture + 1));
    out.set_rotation(v.rotation);
}
void unpack(const wire::Environment& in, Environment& v) {
    const std::uint32_t most = std::numeric_limits<std::int32_t>::max();
    unpack(in.radiance(), v.radiance);
    v.texture = std::int32_t(in_range(in.texture_plus_one(), 0u, most, "texture_plus_one")) - 1;
    v.rotation = in.rotation();
}

void pack(const Object& v, wire::Object& out) {
    out.set_name(v.name);
    out.set_mesh(v.mesh);
    out.mutable_materials()->Assign(v.materials.begin(), v.materials.end());
    out.set_shape_plus_one(std::uint32_t(v.shape + 1));
}
void unpack(const wire::Object& in, Object& v) {
    v.name = in.name();
    v.mesh = in.mesh();
    v.materials.assign(in.materials().begin(), in.materials().end());
    const std::uint32_t most = std::numeric_limits<std::int32_t>::max();
    v.shape = std::int32_t(in_range(in.shape_plus_one(), 0u, most, "shape_plus_one")) - 1;
}

void pack(const mat4& v, google::protobuf::RepeatedField<float>& out) {
    const float* first = &v[0][0];
    out.Assign(first, first + 16);
}
void unpack(const google::protobuf::RepeatedField<float>& in, mat4& v) {
    if (in.size() != 16) refuse("transform of {} numbers, must be 16", in.size());
    std::memcpy(&v[0][0], in.data(), sizeof(mat4));
}

void pack(const Instance& v, wire::Instance& out) {
    out.set_name(v.name);
    out.set_object(v.object);
    pack(v.world_from_object, *out.mutable_world_from_object());
    out.set_moves(v.moves);
}
void unpack(const wire::Instance& in, Instance& v) {
    v.name = in.name();
    v.object = in.object();
    unpack(in.world_from_object(), v.world_from_object);
    v.moves = in.moves();
}

void pack(const Light& v, wire::Light& out) {
    out.set_name(v.name);
    out.set_kind(pack_enum<wire::LightKind>(v.kind));
    pack(v.position, *out.mutable_position());
    pack(v.direction, *out.mutable_direction());
    pack(v.intensity, *out.mutable_intensity());
    out.set_inner_angle(v.inner_angle);
    out.set_outer_angle(v.outer_angle);
}
void unpack(const wire::Light& in, Light& v) {
    v.name = in.name();
    v.kind = unpack_enum(in.kind(), LightKind::directional, "light kind");
    unpack(in.position(), v.position);
    unpack(in.direction(), v.direction);
    unpack(in.intensity(), v.intensity);
    v.inner_angle = in.inner_angle();
    v.outer_angle = in.outer_angle();
}

void pack(const Camera& v, wire::Camera& out) {
    out.set_name(v.name);
    pack(v.eye, *out.mutable_eye());
    pack(v.at, *out.mutable_at());
    pack(v.up, *out.mutable_up());
    out.set_fov_y(v.fov_y);
}
void unpack(const wire::Camera& in, Camera& v) {
    v.name = in.name();
    unpack(in.eye(), v.eye);
    unpack(in.at(), v.at);
    unpack(in.up(), v.up);
    v.fov_y = in.fov_y();
}

template <class T, class Table>
void pack_table(const TableDelta<T>& v, Table& out) {
    out.set_size(v.size);
    out.mutable_index()->Reserve(int(v.changed.size()));
    out.mutable_entry()->Reserve(int(v.changed.size()));
    for (const auto& [index, entry] : v.changed) {
        out.add_index(index);
        pack(entry, *out.add_entry());
    }
}
template <class T, class Table>
void unpack_table(const Table& in, TableDelta<T>& v) {
    if (in.index_size() != in.entry_size())
        refuse("table of {} entries with {} indices", in.entry_size(), in.index_size());
    v.size = in.size();
    v.changed.resize(std::size_t(in.index_size()));
    for (int i = 0; i < in.index_size(); ++i) {
        v.changed[std::size_t(i)].first = in.index(i);
        unpack(in.entry(i), v.changed[std::size_t(i)].second);
    }
}

void pack(const SceneDelta& v, wire::SceneDelta& out) {
    out.set_base_version(v.base_version);
    out.set_next_version(v.next_version);
    pack_table(v.meshes, *out.mutable_meshes());
    pack_table(v.textures, *out.mutable_textures());
    pack_table(v.shapes, *out.mutable_shapes());
    pack_table(v.objects, *out.mutable_objects());
    pack_table(v.instances, *out.mutable_instances());
    pack_table(v.materials, *out.mutable_materials());
    pack_table(v.lights, *out.mutable_lights());
    pack_table(v.cameras, *out.mutable_cameras());
    pack(v.environment, *out.mutable_environment());
}
void unpack(const wire::SceneDelta& in, SceneDelta& v) {
    if (in.next_version() <= in.base_version())
        refuse("delta leads from version {} to {}", in.base_version(), in.next_version());
    v.base_version = in.base_version();
    v.next_version = in.next_version();
    unpack_table(in.meshes(), v.meshes);
    unpack_table(in.textures(), v.textures);
    unpack_table(in.shapes(), v.shapes);
    unpack_table(in.objects(), v.objects);
    unpack_table(in.instances(), v.instances);
    unpack_table(in.materials(), v.materials);
    unpack_table(in.lights(), v.lights);
    unpack_table(in.cameras(), v.cameras);
    unpack(in.environment(), v.environment);
}

void pack(const SceneUpdate& v, wire::SceneUpdate& out) {
    out.set_scene(v.scene);
    pack(v.delta, *out.mutable_delta());
    out.set_tracer(pack_enum<wire::Tracer>(v.tracer));
}
void unpack(const wire::SceneUpdate& in, SceneUpdate& v) {
    require_set(in.has_delta(), "delta");
    v.tracer = unpack_enum(in.tracer(), TracerKind::embree, "tracer");
    v.scene = in.scene();
    unpack(in.delta(), v.delta);
}

void pack(const BlobRequest& v, wire::BlobRequest& out) {
    out.set_scene(v.scene);
    pack_each(v.blobs, *out.mutable_blobs());
    out.set_failed_peer(v.failed_peer);
}
void unpack(const wire::BlobRequest& in, BlobRequest& v) {
    v.scene = in.scene();
    unpack_each(in.blobs(), v.blobs);
    v.failed_peer = in.failed_peer();
}

void pack(const BlobSource& v, wire::BlobSource& out) {
    out.set_peer(v.peer);
    out.set_address(v.address);
    pack_each(v.blobs, *out.mutable_blobs());
    out.mutable_bytes()->Assign(v.bytes.begin(), v.bytes.end());
}
void unpack(const wire::BlobSource& in, BlobSource& v) {
    if (in.peer() == 0) refuse("peer is 0");
    if (in.blobs_size() != in.bytes_size())
        refuse("{} blobs, but the sizes of {}", in.blobs_size(), in.bytes_size());
    v.peer = in.peer();
    v.address = short_text(in.address(), "address");
    unpack_each(in.blobs(), v.blobs);
    v.bytes.assign(in.bytes().begin(), in.bytes().end());
}

void pack(const BlobChunk& v, wire::BlobChunk& out) {
    pack(v.blob, *out.mutable_blob());
    out.set_offset(v.offset);
    out.set_total(v.total);
}
void unpack(const wire::BlobChunk& in, BlobChunk& v) {
    unpack(in.blob(), v.blob);
    v.offset = in.offset();
    v.total = in.total();
}

void pack(const SceneReady& v, wire::SceneReady& out) {
    out.set_scene(v.scene);
    out.set_version(v.version);
    out.set_build_seconds(v.build_seconds);
    pack_texts(v.modelled, *out.mutable_modelled());
    pack_texts(v.left_out, *out.mutable_left_out());
}
void unpack(const wire::SceneReady& in, SceneReady& v) {
    v.scene = in.scene();
    v.version = in.version();
    v.build_seconds = amount(in.build_seconds(), "build_seconds");
    v.modelled = unpack_texts(in.modelled());
    v.left_out = unpack_texts(in.left_out());
}

void pack(const SceneDrop& v, wire::SceneDrop& out) { out.set_scene(v.scene); }
void unpack(const wire::SceneDrop& in, SceneDrop& v) { v.scene = in.scene(); }

// ---- Edits --------------------------------------------------------------------------------------

void pack(const SetTransform& v, wire::SetTransform& out) {
    out.set_instance(v.instance);
    pack(v.world_from_object, *out.mutable_world_from_object());
}
void unpack(const wire::SetTransform& in, SetTransform& v) {
    v.instance = in.instance();
    unpack(in.world_from_object(), v.world_from_object);
}

void pack(const CreateInstance& v, wire::CreateInstance& out) {
    out.set_instance(v.instance);
    out.set_object(v.object);
    pack(v.world_from_object, *out.mutable_world_from_object());
}
void unpack(const wire::CreateInstance& in, CreateInstance& v) {
    v.instance = in.instance();
    v.object = in.object();
    unpack(in.world_from_object(), v.world_from_object);
}

void pack(const DeleteInstance& v, wire::DeleteInstance& out) { out.set_instance(v.instance); }
void unpack(const wire::DeleteInstance& in, DeleteInstance& v) { v.instance = in.instance(); }

std::optional<vec3> optional_of(bool set, const wire::Vec3& in) {
    if (!set) return std::nullopt;
    return vec3(in.x(), in.y(), in.z());
}
std::optional<float> optional_of(bool set, float in) {
    return set ? std::optional(in) : std::nullopt;
}

void pack(const SetMaterial& v, wire::SetMaterial& out) {
    out.set_material(v.material);
    if (v.base_color) pack(*v.base_color, *out.mutable_base_color());
    if (v.metallic) out.set_metallic(*v.metallic);
    if (v.roughness) out.set_roughness(*v.roughness);
    if (v.emission) pack(*v.emission, *out.mutable_emission());
    if (v.shader) out.set_shader(*v.shader);
    for (const ShaderParameter& p : v.shader_parameters) pack(p, *out.add_shader_parameters());
}
void unpack(const wire::SetMaterial& in, SetMaterial& v) {
    v.material = in.material();
    v.base_color = optional_of(in.has_base_color(), in.base_color());
    v.metallic = optional_of(in.has_metallic(), in.metallic());
    v.roughness = optional_of(in.has_roughness(), in.roughness());
    v.emission = optional_of(in.has_emission(), in.emission());
    if (in.has_shader()) v.shader = in.shader();
    for (const auto& p : in.shader_parameters()) unpack(p, v.shader_parameters.emplace_back());
}

void pack(const SetLight& v, wire::SetLight& out) {
    out.set_light(v.light);
    if (v.position) pack(*v.position, *out.mutable_position());
    if (v.direction) pack(*v.direction, *out.mutable_direction());
    if (v.intensity) pack(*v.intensity, *out.mutable_intensity());
    if (v.inner_angle) out.set_inner_angle(*v.inner_angle);
    if (v.outer_angle) out.set_outer_angle(*v.outer_angle);
}
void unpack(const wire::SetLight& in, SetLight& v) {
    v.light = in.light();
    v.position = optional_of(in.has_position(), in.position());
    v.direction = optional_of(in.has_direction(), in.direction());
    v.intensity = optional_of(in.has_intensity(), in.intensity());
    v.inner_angle = optional_of(in.has_inner_angle(), in.inner_angle());
    v.outer_angle = optional_of(in.has_outer_angle(), in.outer_angle());
}

void pack(const CreateLight& v, wire::CreateLight& out) { pack(v.light, *out.mutable_light()); }
void unpack(const wire::CreateLight& in, CreateLight& v) {
    require_set(in.has_light(), "light");
    unpack(in.light(), v.light);
}

void pack(const DeleteLight& v, wire::DeleteLight& out) { out.set_light(v.light); }
void unpack(const wire::DeleteLight& in, DeleteLight& v) { v.light = in.light(); }

void pack(const SetCamera& v, wire::SetCamera& out) { pack(v.camera, *out.mutable_camera()); }
void unpack(const wire::SetCamera& in, SetCamera& v) {
    require_set(in.has_camera(), "camera");
    unpack(in.camera(), v.camera);
}

void pack(const CreateObject& v, wire::CreateObject& out) {
    out.set_object(v.object);
    pack(v.mesh, *out.mutable_mesh());
    pack_texts(v.materials, *out.mutable_materials());
}
void unpack(const wire::CreateObject& in, CreateObject& v) {
    require_set(in.has_mesh(), "mesh");
    v.object = in.object();
    unpack(in.mesh(), v.mesh);
    v.materials = unpack_texts(in.materials());
}

void pack(const DeleteObject& v, wire::DeleteObject& out) { out.set_object(v.object); }
void unpack(const wire::DeleteObject& in, DeleteObject& v) { v.object = in.object(); }

void pack(const CreateMaterial& v, wire::CreateMaterial& out) {
    pack(v.material, *out.mutable_material());
}
void unpack(const wire::CreateMaterial& in, CreateMaterial& v) {
    require_set(in.has_material(), "material");
    unpack(in.material(), v.material);
}

void pack(const DeleteMaterial& v, wire::DeleteMaterial& out) { out.set_material(v.material); }
void unpack(const wire::DeleteMaterial& in, DeleteMaterial& v) { v.material = in.material(); }

void pack(const DeleteCamera& v, wire::DeleteCamera& out) { out.set_camera(v.camera); }
void unpack(const wire::DeleteCamera& in, DeleteCamera& v) { v.camera = in.camera(); }

void pack(const SetEnvironment& v, wire::SetEnvironment& out) {
    if (v.radiance) pack(*v.radiance, *out.mutable_radiance());
    if (v.rotation) out.set_rotation(*v.rotation);
}
void unpack(const wire::SetEnvironment& in, SetEnvironment& v) {
    v.radiance = optional_of(in.has_radiance(), in.radiance());
    v.rotation = optional_of(in.has_rotation(), in.rotation());
}

void pack(const EditOperation& v, wire::EditOperation& out) {
    struct Packer {
        wire::EditOperation& out;
        void operator()(const SetTransform& e) { pack(e, *out.mutable_set_transform()); }
        void operator()(const CreateInstance& e) { pack(e, *out.mutable_create_instance()); }
        void operator()(const DeleteInstance& e) { pack(e, *out.mutable_delete_instance()); }
        void operator()(const SetMaterial& e) { pack(e, *out.mutable_set_material()); }
        void operator()(const SetLight& e) { pack(e, *out.mutable_set_light()); }
        void operator()(const CreateLight& e) { pack(e, *out.mutable_create_light()); }
        void operator()(const DeleteLight& e) { pack(e, *out.mutable_delete_light()); }
        void operator()(const SetCamera& e) { pack(e, *out.mutable_set_camera()); }
        void operator()(const SetShape& e) { pack(e, *out.mutable_set_shape()); }
        void operator()(const CreateObject& e) { pack(e, *out.mutable_create_object()); }
        void operator()(const DeleteObject& e) { pack(e, *out.mutable_delete_object()); }
        void operator()(const CreateMaterial& e) { pack(e, *out.mutable_create_material()); }
        void operator()(const DeleteMaterial& e) { pack(e, *out.mutable_delete_material()); }
        void operator()(const DeleteCamera& e) { pack(e, *out.mutable_delete_camera()); }
        void operator()(const SetEnvironment& e) { pack(e, *out.mutable_set_environment()); }
    };
    std::visit(Packer{out}, v);
}
void unpack(const wire::EditOperation& in, EditOperation& v) {
    using Wire = wire::EditOperation;
    switch (in.operation_case()) {
        case Wire::kSetTransform:
            return unpack(in.set_transform(), v.emplace<SetTransform>());
        case Wire::kCreateInstance:
            return unpack(in.create_instance(), v.emplace<CreateInstance>());
        case Wire::kDeleteInstance:
            return unpack(in.delete_instance(), v.emplace<DeleteInstance>());
        case Wire::kSetMaterial:
            return unpack(in.set_material(), v.emplace<SetMaterial>());
        case Wire::kSetLight:
            return unpack(in.set_light(), v.emplace<SetLight>());
        case Wire::kCreateLight:
            return unpack(in.create_light(), v.emplace<CreateLight>());
        case Wire::kDeleteLight:
            return unpack(in.delete_light(), v.emplace<DeleteLight>());
        case Wire::kSetCamera:
            return unpack(in.set_camera(), v.emplace<SetCamera>());
        case Wire::kSetShape:
            return unpack(in.set_shape(), v.emplace<SetShape>());
        case Wire::kCreateObject:
            return unpack(in.create_object(), v.emplace<CreateObject>());
        case Wire::kDeleteObject:
            return unpack(in.delete_object(), v.emplace<DeleteObject>());
        case Wire::kCreateMaterial:
            return unpack(in.create_material(), v.emplace<CreateMaterial>());
        case Wire::kDeleteMaterial:
            return unpack(in.delete_material(), v.emplace<DeleteMaterial>());
        case Wire::kDeleteCamera:
            return unpack(in.delete_camera(), v.emplace<DeleteCamera>());
        case Wire::kSetEnvironment:
            return unpack(in.set_environment(), v.emplace<SetEnvironment>());
        case Wire::OPERATION_NOT_SET:
            refuse("operation is not set");
    }
}

void pack(const SceneShare& v, wire::SceneShare& out) { out.set_scene(v.scene); }
void unpack(const wire::SceneShare& in, SceneShare& v) { v.scene = in.scene(); }

void pack(const SceneWatch& v, wire::SceneWatch& out) { out.set_scene(v.scene); }
void unpack(const wire::SceneWatch& in, SceneWatch& v) { v.scene = in.scene(); }

void pack(const SceneEdit& v, wire::SceneEdit& out) {
    out.set_request(v.request);
    out.set_scene(v.scene);
    pack_each(v.operations, *out.mutable_operations());
    out.mutable_blob_bytes()->Assign(v.blob_bytes.begin(), v.blob_bytes.end());
}
void unpack(const wire::SceneEdit& in, SceneEdit& v) {
    v.request = in.request();
    v.scene = in.scene();
    unpack_each(in.operations(), v.operations);
    v.blob_bytes.assign(in.blob_bytes().begin(), in.blob_bytes().end());
}

void pack(const EditResult& v, wire::EditResult& out) {
    out.set_request(v.request);
    out.set_scene(v.scene);
    out.set_version(v.version);
    pack_texts(v.complaints, *out.mutable_complaints());
}
void unpack(const wire::EditResult& in, EditResult& v) {
    v.request = in.request();
    v.scene = in.scene();
    v.version = in.version();
    v.complaints = unpack_texts(in.complaints());
}

// ---- Session ------------------------------------------------------------------------------------

void pack(const Hello& v, wire::Hello& out) {
    out.set_protocol(v.protocol);
    out.set_role(pack_enum<wire::Role>(v.role));
    out.set_build(v.build);
    out.set_token(v.token);
    out.set_name(v.name);
    out.set_threads(v.threads);
    out.set_relay_port(v.relay_port);
}
void unpack(const wire::Hello& in, Hello& v) {
    v.protocol = in.protocol();
    v.role = unpack_enum(in.role(), Role::viewer, "role");
    v.build = short_text(in.build(), "build");
    v.token = short_text(in.token(), "token");
    v.name = short_text(in.name(), "name");
    v.threads = in.threads();
    v.relay_port = std::uint16_t(in_range(in.relay_port(), 0u, 65535u, "relay_port"));
}

void pack(const Welcome& v, wire::Welcome& out) {
    out.set_peer(v.peer);
    out.set_build(v.build);
    pack_texts(v.scenes, *out.mutable_scenes());
    out.set_relay_token(v.relay_token);
}
void unpack(const wire::Welcome& in, Welcome& v) {
    v.peer = in.peer();
    v.build = in.build();
    v.scenes = unpack_texts(in.scenes());
    v.relay_token = short_text(in.relay_token(), "relay_token");
}

void pack(const Refused& v, wire::Refused& out) { out.set_reason(v.reason); }
void unpack(const wire::Refused& in, Refused& v) { v.reason = in.reason(); }

void pack(const Ping& v, wire::Ping& out) { out.set_stamp(v.stamp); }
void unpack(const wire::Ping& in, Ping& v) { v.stamp = in.stamp(); }

void pack(const Pong& v, wire::Pong& out) {
    out.set_stamp(v.stamp);
    out.set_memory_bytes(v.memory_bytes);
    out.set_relayed_bytes(v.relayed_bytes);
}
void unpack(const wire::Pong& in, Pong& v) {
    v.stamp = in.stamp();
    v.memory_bytes = in.memory_bytes();
    v.relayed_bytes = in.relayed_bytes();
}

void pack(const Leave&, wire::Leave&) {}
void unpack(const wire::Leave&, Leave&) {}

void pack(const Failure& v, wire::Failure& out) {
    out.set_request(v.request);
    out.set_reason(v.reason);
}
void unpack(const wire::Failure& in, Failure& v) {
    v.request = in.request();
    v.reason = in.reason();
}

// ---- Frames -------------------------------------------------------------------------------------

void pack(const RenderSettings& v, wire::RenderSettings& out) {
    out.set_integrator(pack_enum<wire::Integrator>(v.integrator));
    out.set_tracer(pack_enum<wire::Tracer>(v.tracer));
    out.set_filter(pack_enum<wire::FilterPlace>(v.filter));
    out.set_passes(v.passes);
    out.set_vpls(v.vpls);
    out.set_interleave(v.interleave);
    out.set_bounces(v.bounces);
    out.set_seed(v.seed);
    out.set_track_lights(v.track_lights);
}
void unpack(const wire::RenderSettings& in, RenderSettings& v) {
    v.integrator = unpack_enum(in.integrator(), Integrator::path, "integrator");
    v.tracer = unpack_enum(in.tracer(), TracerKind::embree, "tracer");
    v.filter = unpack_enum(in.filter(), FilterPlace::off, "filter");
    v.passes = in_range(in.passes(), 1u, max_passes, "passes");
    v.vpls = in_range(in.vpls(), 0u, max_vpls, "vpls");
    v.interleave = in_range(in.interleave(), 1u, max_interleave, "interleave");
    v.bounces = in.bounces();
    v.seed = in.seed();
    v.track_lights = in.track_lights();
}

void pack_channels(ChannelSet v, google::protobuf::RepeatedField<int>& out) {
    for (int c = 0; c < channel_count; ++c)
        if (v.has(Channel(c))) out.Add(pack_enum<wire::Channel>(Channel(c)));
}
ChannelSet unpack_channels(const google::protobuf::RepeatedField<int>& in) {
    ChannelSet set;
    for (const int c : in) set = set.with(unpack_enum(c, Channel::owner, "extra channel"));
    return set;
}

void check_view(const Camera& camera) {
    for (const vec3& v : {camera.eye, camera.at, camera.up})
        if (!is_finite(v)) refuse("camera is not finite");
    if (!(finite(camera.fov_y, "fov_y") > 0 && camera.fov_y < 180))
        refuse("fov_y is {} degrees, must be more than 0 and less than 180", camera.fov_y);
}

int unpack_side(std::uint32_t pixels, const char* field) {
    return int(in_range(pixels, 1u, std::uint32_t(max_image_side), field));
}

void pack(const FrameSpec& v, wire::FrameSpec& out) {
    out.set_frame(v.frame);
    out.set_scene(v.scene);
    out.set_version(v.version);
    out.set_width(std::uint32_t(v.size.width));
    out.set_height(std::uint32_t(v.size.height));
    pack(v.camera, *out.mutable_camera());
    pack(v.settings, *out.mutable_settings());
    pack_channels(v.extra, *out.mutable_extra());
    if (!v.lights.empty()) pack(v.lights, *out.mutable_lights());
}
void unpack(const wire::FrameSpec& in, FrameSpec& v) {
    require_set(in.has_camera(), "camera");
    require_set(in.has_settings(), "settings");
    v.frame = in.frame();
    v.scene = in.scene();
    v.version = in.version();
    v.size = {unpack_side(in.width(), "width"), unpack_side(in.height(), "height")};
    if (v.size.pixels() > max_image_pixels)
        refuse("picture of {} pixels, at most {}", v.size.pixels(), max_image_pixels);
    unpack(in.camera(), v.camera);
    check_view(v.camera);
    unpack(in.settings(), v.settings);
    v.extra = unpack_channels(in.extra());
    unpack(in.lights(), v.lights);
}

void pack(const FrameRequest& v, wire::FrameRequest& out) {
    out.set_request(v.request);
    pack(v.spec, *out.mutable_spec());
    out.set_format(pack_enum<wire::PictureFormat>(v.format));
    out.set_tone_curve(pack_enum<wire::ToneCurve>(v.tone_map.curve));
    out.set_exposure(v.tone_map.exposure);
    out.set_time_limit(v.time_limit);
    out.set_error_limit(v.error_limit);
    out.set_sums_bytes(v.sums_bytes);
}
void unpack(const wire::FrameRequest& in, FrameRequest& v) {
    if (in.request() == 0) refuse("request is 0");
    require_set(in.has_spec(), "spec");
    v.request = in.request();
    unpack(in.spec(), v.spec);
    v.format = unpack_enum(in.format(), PictureFormat::srgb8, "format");
    v.tone_map.curve = unpack_enum(in.tone_curve(), ToneCurve::filmic, "tone_curve");
    v.tone_map.exposure = finite(in.exposure(), "exposure");
    v.time_limit = amount(in.time_limit(), "time_limit");
    v.error_limit = amount(in.error_limit(), "error_limit");
    v.sums_bytes = in.sums_bytes();
}

void pack(const FrameSave& v, wire::FrameSave& out) { out.set_request(v.request); }
void unpack(const wire::FrameSave& in, FrameSave& v) { v.request = in.request(); }

void pack(const SumsChunk& v, wire::SumsChunk& out) {
    out.set_request(v.request);
    out.set_offset(v.offset);
    out.set_total(v.total);
    out.set_render_seconds(v.render_seconds);
    out.set_rays(v.rays);
}
void unpack(const wire::SumsChunk& in, SumsChunk& v) {
    v.request = in.request();
    v.offset = in.offset();
    v.total = in.total();
    v.render_seconds = amount(in.render_seconds(), "render_seconds");
    v.rays = in.rays();
}

void pack(const View& v, wire::View& out) {
    out.set_request(v.request);
    pack(v.spec, *out.mutable_spec());
    out.set_format(pack_enum<wire::PictureFormat>(v.format));
    out.set_tone_curve(pack_enum<wire::ToneCurve>(v.tone_map.curve));
    out.set_exposure(v.tone_map.exposure);
    out.set_shown(pack_enum<wire::Channel>(v.shown));
    out.set_error_limit(v.error_limit);
    out.set_stamp(v.stamp);
    out.set_jpeg_quality(v.jpeg_quality);
}
void unpack(const wire::View& in, View& v) {
    if (in.request() == 0) refuse("request is 0");
    require_set(in.has_spec(), "spec");
    v.request = in.request();
    unpack(in.spec(), v.spec);
    v.format = unpack_enum(in.format(), PictureFormat::automatic, "format");
    v.tone_map.curve = unpack_enum(in.tone_curve(), ToneCurve::filmic, "tone_curve");
    v.tone_map.exposure = finite(in.exposure(), "exposure");
    v.shown = unpack_enum(in.shown(), Channel::owner, "shown channel");
    v.error_limit = amount(in.error_limit(), "error_limit");
    v.stamp = in.stamp();
    v.jpeg_quality = in.jpeg_quality();
    if (v.jpeg_quality > 100) refuse("jpeg_quality is more than 100");
}

void pack(const ViewEnd& v, wire::ViewEnd& out) { out.set_request(v.request); }
void unpack(const wire::ViewEnd& in, ViewEnd& v) { v.request = in.request(); }

void pack(const ViewPicture& v, wire::ViewPicture& out) {
    out.set_request(v.request);
    out.set_stamp(v.stamp);
    out.set_version(v.version);
    out.set_passes(v.passes);
    out.set_settled(v.settled);
    out.set_error_estimate(v.error_estimate);
    out.set_first_seconds(v.first_seconds);
    out.set_render_seconds(v.render_seconds);
    out.set_rays(v.rays);
}
void unpack(const wire::ViewPicture& in, ViewPicture& v) {
    v.request = in.request();
    v.stamp = in.stamp();
    v.version = in.version();
    v.passes = in.passes();
    v.settled = in.settled();
    v.error_estimate = amount(in.error_estimate(), "error_estimate");
    v.first_seconds = amount(in.first_seconds(), "first_seconds");
    v.render_seconds = amount(in.render_seconds(), "render_seconds");
    v.rays = in.rays();
}

void pack(const FrameCancel& v, wire::FrameCancel& out) { out.set_request(v.request); }
void unpack(const wire::FrameCancel& in, FrameCancel& v) { v.request = in.request(); }

void pack(const FrameProgress& v, wire::FrameProgress& out) {
    out.set_request(v.request);
    out.set_tiles_done(v.tiles_done);
    out.set_tiles_total(v.tiles_total);
    out.set_passes_done(v.passes_done);
    out.set_workers(v.workers);
    out.set_error_estimate(v.error_estimate);
}
void unpack(const wire::FrameProgress& in, FrameProgress& v) {
    v.request = in.request();
    v.tiles_done = in.tiles_done();
    v.tiles_total = in.tiles_total();
    v.passes_done = in.passes_done();
    v.workers = in.workers();
    v.error_estimate = amount(in.error_estimate(), "error_estimate");
}

void pack(const PictureChunk& v, wire::PictureChunk& out) {
    out.set_request(v.request);
    out.set_channel(pack_enum<wire::Channel>(v.channel));
    out.set_format(pack_enum<wire::PictureFormat>(v.format));
    out.set_width(v.width);
    out.set_height(v.height);
    out.set_components(v.components);
    out.set_offset(v.offset);
    out.set_total(v.total);
}
void unpack(const wire::PictureChunk& in, PictureChunk& v) {
    v.request = in.request();
    v.channel = unpack_enum(in.channel(), Channel::owner, "channel");
    v.format = unpack_enum(in.format(), PictureFormat::jpeg, "format");
    v.width = std::uint32_t(unpack_side(in.width(), "width"));
    v.height = std::uint32_t(unpack_side(in.height(), "height"));
    v.components = in_range(in.components(), 1u, 4u, "components");
    v.offset = in.offset();
    v.total = in.total();
    const std::uint64_t numbers = std::uint64_t(v.width) * v.height * v.components;
    const std::uint64_t bytes = numbers * (v.format == PictureFormat::linear_float ? 4 : 1);
    const bool fits =
        v.format == PictureFormat::jpeg ? v.total <= bytes + max_jpeg_overhead : v.total == bytes;
    if (!fits) refuse("total is {} bytes, must be {}", v.total, bytes);
}

void pack(const FrameStatistics& v, wire::FrameStatistics& out) {
    out.set_build_seconds(v.build_seconds);
    out.set_render_seconds(v.render_seconds);
    out.set_passes(v.passes);
    out.set_rays(v.rays);
    out.set_sanitised(v.sanitised);
    out.set_tiles_reissued(v.tiles_reissued);
    out.set_error_estimate(v.error_estimate);
    pack_texts(v.modelled, *out.mutable_modelled());
    pack_texts(v.left_out, *out.mutable_left_out());
    pack_each(v.workers, *out.mutable_workers());
    if (!v.lights.empty()) pack(v.lights, *out.mutable_lights());
    out.set_active_lights(v.active_lights);
}
void unpack(const wire::FrameStatistics& in, FrameStatistics& v) {
    v.build_seconds = amount(in.build_seconds(), "build_seconds");
    v.render_seconds = amount(in.render_seconds(), "render_seconds");
    v.passes = in.passes();
    v.rays = in.rays();
    v.sanitised = in.sanitised();
    v.tiles_reissued = in.tiles_reissued();
    v.error_estimate = amount(in.error_estimate(), "error_estimate");
    v.modelled = unpack_texts(in.modelled());
    v.left_out = unpack_texts(in.left_out());
    unpack_each(in.workers(), v.workers);
    unpack(in.lights(), v.lights);
    v.active_lights = in.active_lights();
}

void pack(const FrameDone& v, wire::FrameDone& out) {
    out.set_request(v.request);
    pack(v.statistics, *out.mutable_statistics());
}
void unpack(const wire::FrameDone& in, FrameDone& v) {
    require_set(in.has_statistics(), "statistics");
    v.request = in.request();
    unpack(in.statistics(), v.statistics);
}

// ---- Work ---------------------------------------------------------------------------------------

void pack(const FrameBegin& v, wire::FrameBegin& out) { pack(v.spec, *out.mutable_spec()); }
void unpack(const wire::FrameBegin& in, FrameBegin& v) {
    require_set(in.has_spec(), "spec");
    unpack(in.spec(), v.spec);
}

void pack(const FrameEnd& v, wire::FrameEnd& out) { out.set_frame(v.frame); }
void unpack(const wire::FrameEnd& in, FrameEnd& v) { v.frame = in.frame(); }

template <class Field>
void check_together(const Field& in) {
    if (std::size_t(in.size()) > max_tiles_together)
        refuse("{} tiles in one message, at most {} may be", in.size(), max_tiles_together);
}

void pack(const TileTasks& v, wire::TileTasks& out) { pack_each(v.tasks, *out.mutable_tasks()); }
void unpack(const wire::TileTasks& in, TileTasks& v) {
    check_together(in.tasks());
    unpack_each(in.tasks(), v.tasks);
}

void pack(const TileResults& v, wire::TileResults& out) {
    pack_each(v.tiles, *out.mutable_tiles());
}
void unpack(const wire::TileResults& in, TileResults& v) {
    check_together(in.tiles());
    unpack_each(in.tiles(), v.tiles);
}

// ---- Status -------------------------------------------------------------------------------------

void pack(const StatusRequest&, wire::StatusRequest&) {}
void unpack(const wire::StatusRequest&, StatusRequest&) {}

void pack(const Status& v, wire::Status& out) {
    out.set_build(v.build);
    out.set_uptime_seconds(v.uptime_seconds);
    out.set_viewers(v.viewers);
    out.set_frames_in_flight(v.frames_in_flight);
    out.set_frames_done(v.frames_done);
    pack_each(v.scenes, *out.mutable_scenes());
    pack_each(v.workers, *out.mutable_workers());
    out.set_memory_bytes(v.memory_bytes);
    out.set_worker_bytes(v.worker_bytes);
}
void unpack(const wire::Status& in, Status& v) {
    v.build = in.build();
    v.uptime_seconds = amount(in.uptime_seconds(), "uptime_seconds");
    v.viewers = in.viewers();
    v.frames_in_flight = in.frames_in_flight();
    v.frames_done = in.frames_done();
    unpack_each(in.scenes(), v.scenes);
    unpack_each(in.workers(), v.workers);
    v.memory_bytes = in.memory_bytes();
    v.worker_bytes = in.worker_bytes();
}

// ---- Kinds --------------------------------------------------------------------------------------

/// A message's value type, its wire type and its number.
template <class V, class W, wire::Kind number>
struct Entry {
    using Value = V;
    using Wire = W;
    static constexpr std::uint16_t kind = number;
};

template <class... Entries>
struct Table {};

using Kinds = Table<
    Entry<Hello, wire::Hello, wire::KIND_HELLO>, Entry<Welcome, wire::Welcome, wire::KIND_WELCOME>,
    Entry<Refused, wire::Refused, wire::KIND_REFUSED>,
    Entry<SceneUpdate, wire::SceneUpdate, wire::KIND_SCENE_UPDATE>,
    Entry<BlobRequest, wire::BlobRequest, wire::KIND_BLOB_REQUEST>,
    Entry<BlobChunk, wire::BlobChunk, wire::KIND_BLOB_CHUNK>,
    Entry<SceneReady, wire::SceneReady, wire::KIND_SCENE_READY>,
    Entry<SceneDrop, wire::SceneDrop, wire::KIND_SCENE_DROP>,
    Entry<FrameRequest, wire::FrameRequest, wire::KIND_FRAME_REQUEST>,
    Entry<FrameCancel, wire::FrameCancel, wire::KIND_FRAME_CANCEL>,
    Entry<FrameProgress, wire::FrameProgress, wire::KIND_FRAME_PROGRESS>,
    Entry<PictureChunk, wire::PictureChunk, wire::KIND_PICTURE_CHUNK>,
    Entry<FrameDone, wire::FrameDone, wire::KIND_FRAME_DONE>,
    Entry<FrameBegin, wire::FrameBegin, wire::KIND_FRAME_BEGIN>,
    Entry<FrameEnd, wire::FrameEnd, wire::KIND_FRAME_END>,
    Entry<TileTasks, wire::TileTasks, wire::KIND_TILE_TASKS>,
    Entry<TileResults, wire::TileResults, wire::KIND_TILE_RESULTS>,
    Entry<Failure, wire::Failure, wire::KIND_FAILURE>,
    Entry<StatusRequest, wire::StatusRequest, wire::KIND_STATUS_REQUEST>,
    Entry<Status, wire::Status, wire::KIND_STATUS>, Entry<Ping, wire::Ping, wire::KIND_PING>,
    Entry<Pong, wire::Pong, wire::KIND_PONG>,
    Entry<SceneShare, wire::SceneShare, wire::KIND_SCENE_SHARE>,
    Entry<SceneWatch, wire::SceneWatch, wire::KIND_SCENE_WATCH>,
    Entry<SceneEdit, wire::SceneEdit, wire::KIND_SCENE_EDIT>,
    Entry<EditResult, wire::EditResult, wire::KIND_EDIT_RESULT>,
    Entry<View, wire::View, wire::KIND_VIEW>, Entry<ViewEnd, wire::ViewEnd, wire::KIND_VIEW_END>,
    Entry<ViewPicture, wire::ViewPicture, wire::KIND_VIEW_PICTURE>,
    Entry<Leave, wire::Leave, wire::KIND_LEAVE>,
    Entry<FrameSave, wire::FrameSave, wire::KIND_FRAME_SAVE>,
    Entry<SumsChunk, wire::SumsChunk, wire::KIND_SUMS_CHUNK>,
    Entry<BlobSource, wire::BlobSource, wire::KIND_BLOB_SOURCE>>;

/// Calls `f` with the entry for which `wanted(entry)` holds; returns whether there is one.
template <class... Entries, class Wanted, class F>
bool with_entry(Table<Entries...>, Wanted wanted, F f) {
    return ((wanted(Entries{}) && (f(Entries{}), true)) || ...);
}

// ---- Payloads -----------------------------------------------------------------------------------

void check_chunk(std::uint64_t offset, std::uint64_t size, std::uint64_t total) {
    if (offset > total || size > total - offset)
        refuse("bytes from {} to {} of {}", offset, offset + size, total);
    if (size == 0 && total != 0) refuse("empty chunk");
}

/// The parts of a payload are all of it. `what` they are, in words.
template <class Sizes, class SizeOf>
void check_parts(const Sizes& parts, SizeOf size_of, std::uint64_t size, const char* what) {
    for (const auto& part : parts) {
        if (size_of(part) > size) refuse("{} larger than their payload", what);
        size -= size_of(part);
    }
    if (size != 0) refuse("{} bytes more than {} take", size, what);
}

/// Attaches the payload to the message that it came with.
void attach_payload(Payload payload, Message& message) {
    const std::size_t size = payload.bytes.size();
    if (const auto* results = message.get<TileResults>())
        check_parts(
            results->tiles, [](const TileReport& tile) { return tile.pixel_bytes; }, size,
            "the tiles");
    else if (const auto* blob = message.get<BlobChunk>())
        check_chunk(blob->offset, size, blob->total);
    else if (const auto* picture = message.get<PictureChunk>())
        check_chunk(picture->offset, size, picture->total);
    else if (const auto* sums = message.get<SumsChunk>())
        check_chunk(sums->offset, size, sums->total);
    else if (const auto* edit = message.get<SceneEdit>())
        check_parts(edit->blob_bytes, std::identity{}, size, "the blobs of an edit");
    else if (size != 0)
        refuse("payload of {} bytes where none belongs", size);
    if (size != 0) message.payload = std::move(payload);
}

template <class Wire>
Bytes serialise(std::uint16_t kind, const Wire& message, std::size_t payload_bytes) {
    const std::size_t size = message.ByteSizeLong();
    if (size > max_message_bytes)
        throw UserError(fmt::format(
            "the scene's tables take {} MB, at most {} MB can be sent; use fewer instances",
            size >> 20, max_message_bytes >> 20));
    CHECK(payload_bytes <= max_payload_bytes);
    const auto header = encode(FrameHeader{.kind = kind,
                                           .message_bytes = std::uint32_t(size),
                                           .payload_bytes = std::uint32_t(payload_bytes)});
    Bytes head(header.size() + size);
    std::copy(header.begin(), header.end(), head.begin());
    message.SerializeWithCachedSizesToArray(
        reinterpret_cast<std::uint8_t*>(head.data() + header.size()));
    return head;
}

/// Where a message's parts lie as long as it is encoded or decoded: not on
/// the heap, unless they are large.
class Scratch {
public:
    template <class Wire>
    Wire& make() {
        return *google::protobuf::Arena::CreateMessage<Wire>(&arena_);
    }

private:
    google::protobuf::ArenaOptions options() {
        google::protobuf::ArenaOptions out;
        out.initial_block = first_.data();
        out.initial_block_size = first_.size();
        out.max_block_size = 1 << 20;
        return out;
    }

    alignas(8) std::array<char, 16 << 10> first_;
    google::protobuf::Arena arena_{options()};
};

template <class Entry>
MessageBody parse(std::span<const std::byte> bytes) {
    Scratch scratch;
    auto& in = scratch.make<typename Entry::Wire>();
    if (!in.ParseFromArray(bytes.data(), int(bytes.size()))) refuse("no valid Protocol Buffers");
    typename Entry::Value value;
    unpack(in, value);
    return value;
}

}  // namespace

EncodedMessage encode(Message message) {
    EncodedMessage out;
    const auto pack_body = [&]<class Entry>(Entry) {
        Scratch scratch;
        auto& body = scratch.make<typename Entry::Wire>();
        pack(std::get<typename Entry::Value>(message.body), body);
        out.head = serialise(Entry::kind, body, message.payload.bytes.size());
    };
    const bool known = with_entry(
        Kinds{},
        [&]<class Entry>(Entry) {
            return std::holds_alternative<typename Entry::Value>(message.body);
        },
        pack_body);
    CHECK(known);
    out.payload = std::move(message.payload);
    return out;
}

Message decode(const FrameHeader& header, std::span<const std::byte> bytes, Payload payload) {
    Message message;
    const auto unpack_body = [&]<class Entry>(Entry) {
        try {
            message.body = parse<Entry>(bytes);
            attach_payload(std::move(payload), message);
        } catch (const ProtocolError& error) {
            refuse("{}: {}", Entry::Wire::descriptor()->name(), error.what());
        }
    };
    const auto is_kind = [&]<class Entry>(Entry) { return Entry::kind == header.kind; };
    if (!with_entry(Kinds{}, is_kind, unpack_body))
        refuse("unknown kind of message {}", header.kind);
    return message;
}

}  // namespace tessera
