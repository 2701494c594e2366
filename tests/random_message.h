// Messages of every kind with random contents that respect the protocol's limits.
#pragma once

#include <random>

#include "common/message_codec.h"

namespace tessera {

class RandomMessage {
public:
    explicit RandomMessage(unsigned seed) : random_(seed) {}

    static constexpr std::size_t kinds = std::variant_size_v<MessageBody>;

    /// A message whose body is the variant's alternative `kind`.
    Message make(std::size_t kind) {
        Message message;
        message.body = body(kind, std::make_index_sequence<kinds>{});
        if (const auto* chunk = message.get<BlobChunk>())
            message.payload = payload(chunk->total - chunk->offset);
        if (const auto* chunk = message.get<PictureChunk>())
            message.payload = payload(std::min<std::uint64_t>(chunk->total - chunk->offset, 999));
        if (const auto* results = message.get<TileResults>()) {
            std::uint64_t bytes = 0;
            for (const TileReport& tile : results->tiles) bytes += tile.pixel_bytes;
            message.payload = payload(bytes);
        }
        if (const auto* chunk = message.get<SumsChunk>())
            message.payload = payload(std::min<std::uint64_t>(chunk->total - chunk->offset, 999));
        return message;
    }

private:
    template <std::size_t... I>
    MessageBody body(std::size_t kind, std::index_sequence<I...>) {
        MessageBody out;
        ((I == kind ? void(out = make_one(std::variant_alternative_t<I, MessageBody>{})) : void()),
         ...);
        return out;
    }

    std::uint32_t below(std::uint64_t n) { return std::uint32_t(random_() % n); }
    std::uint32_t number() { return below(2) ? below(10) : std::uint32_t(random_()); }
    std::uint64_t big() { return random_() >> below(64); }
    bool coin() { return below(2) == 1; }
    double amount() { return std::generate_canonical<double, 32>(random_) * below(1000); }
    float real() { return (float(below(2000001)) - 1e6f) / (1 + below(1000)); }
    vec3 vector() { return {real(), real(), real()}; }
    template <class Enum>
    Enum one_of(Enum last) {
        return Enum(below(std::uint64_t(last) + 1));
    }

    std::string text() {
        std::string out(below(12), ' ');
        for (char& c : out) c = char(' ' + below(95));
        return out;
    }
    /// As files spell names: any bytes at all.
    std::string name() {
        std::string out(below(12), ' ');
        for (char& c : out) c = char(below(256));
        return out;
    }
    std::vector<std::string> names() {
        std::vector<std::string> out(below(4));
        for (std::string& n : out) n = name();
        return out;
    }
    BlobId blob() {
        BlobId id;
        for (auto& byte : id.digest) byte = std::uint8_t(below(256));
        return id;
    }
    Payload payload(std::uint64_t size) {
        const auto bytes = std::make_shared<Bytes>(size);
        for (std::byte& b : *bytes) b = std::byte(below(256));
        if (size == 0) return {};
        return {bytes, *bytes};
    }

    BlobId make_one(BlobId) { return blob(); }
    TextureMap map() {
        return {.texture = int(below(5)) - 1,
                .offset = {real(), real()},
                .scale = {real(), real()},
                .rotation = real()};
    }
    ShaderParameter make_one(ShaderParameter) { return {name(), vector()}; }
    Material make_one(Material) {
        return {.name = name(),
                .base_color = vector(),
                .base_color_map = map(),
                .metallic = real(),
                .roughness = real(),
                .metallic_roughness_map = map(),
                .specular = real(),
                .ior = real(),
                .transmission = real(),
                .transmission_map = map(),
                .thin_walled = coin(),
                .emission = vector(),
                .emission_map = map(),
                .two_sided_emission = coin(),
                .normal_map = map(),
                .normal_scale = real(),
                .alpha_mode = one_of(AlphaMode::blend),
                .alpha = real(),
                .alpha_cutoff = real(),
                .shader = coin() ? name() : "",
                .shader_parameters = list<ShaderParameter>()};
    }
    Environment environment() {
        return {.radiance = vector(), .texture = int(below(5)) - 1, .rotation = real()};
    }
    Object make_one(Object) {
        return {.name = name(),
                .mesh = number(),
                .materials = std::vector<std::uint32_t>(below(4), number()),
                .shape = int(below(5)) - 1};
    }
    Instance make_one(Instance) {
        Instance out{
            .name = name(), .object = number(), .world_from_object = mat4(0), .moves = coin()};
        for (int i = 0; i < 16; ++i) out.world_from_object[i / 4][i % 4] = real();
        return out;
    }
    Light make_one(Light) {
        return {.name = name(),
                .kind = one_of(LightKind::directional),
                .position = vector(),
                .direction = vector(),
                .intensity = vector(),
                .inner_angle = real(),
                .outer_angle = real()};
    }
    Camera make_one(Camera) {
        return {.name = name(),
                .eye = vector(),
                .at = vector(),
                .up = vector(),
                .fov_y = 1 + float(below(170))};
    }
    template <class T>
    TableDelta<T> table() {
        TableDelta<T> out{.size = number(), .changed = {}};
        for (std::uint32_t n = below(4); n > 0; --n)
            out.changed.emplace_back(number(), make_one(T{}));
        return out;
    }
    FrameSpec spec() {
        FrameSpec out;
        out.frame = big();
        out.scene = name();
        out.version = big();
        out.size = {int(1 + below(max_image_side)), int(1 + below(4096))};
        out.camera = make_one(Camera{});
        out.settings = {.integrator = one_of(Integrator::path),
                        .tracer = one_of(TracerKind::embree),
                        .filter = one_of(FilterPlace::off),
                        .passes = 1 + below(max_passes),
                        .vpls = below(max_vpls + 1),
                        .interleave = 1 + below(max_interleave),
                        .bounces = number(),
                        .seed = number()};
        out.extra = {below(1u << channel_count)};
        return out;
    }

    Hello make_one(Hello) {
        return {.protocol = number(),
                .role = one_of(Role::viewer),
                .build = text(),
                .token = text(),
                .name = text(),
                .threads = number(),
                .relay_port = std::uint16_t(below(65536))};
    }
    Welcome make_one(Welcome) {
        return {.peer = big(), .build = text(), .scenes = names(), .relay_token = text()};
    }
    Refused make_one(Refused) { return {.reason = name()}; }
    SceneUpdate make_one(SceneUpdate) {
        SceneUpdate out{.scene = name(), .delta = {}, .tracer = one_of(TracerKind::embree)};
        out.delta.base_version = below(1000);
        out.delta.next_version = 1000 + big() / 2;
        out.delta.meshes = table<BlobId>();
        out.delta.textures = table<BlobId>();
        out.delta.shapes = table<BlobId>();
        out.delta.objects = table<Object>();
        out.delta.instances = table<Instance>();
        out.delta.materials = table<Material>();
        out.delta.lights = table<Light>();
        out.delta.environment = environment();
        out.delta.cameras = table<Camera>();
        return out;
    }
    BlobRequest make_one(BlobRequest) {
        BlobRequest out{
            .scene = name(), .blobs = std::vector<BlobId>(below(5)), .failed_peer = big()};
        for (BlobId& id : out.blobs) id = blob();
        return out;
    }
    BlobSource make_one(BlobSource) {
        BlobSource out{.peer = 1 + big() / 2,
                       .address = text(),
                       .blobs = std::vector<BlobId>(below(5)),
                       .bytes = {}};
        for (BlobId& id : out.blobs) {
            id = blob();
            out.bytes.push_back(big());
        }
        return out;
    }
    BlobChunk make_one(BlobChunk) {
        const std::uint64_t total = below(2000);
        return {.blob = blob(), .offset = total == 0 ? 0 : below(total), .total = total};
    }
    SceneReady make_one(SceneReady) {
        return {.scene = name(),
                .version = big(),
                .build_seconds = amount(),
                .modelled = names(),
                .left_out = names()};
    }
    SceneDrop make_one(SceneDrop) { return {.scene = name()}; }
    FrameRequest make_one(FrameRequest) {
        return {.request = 1 + big() / 2,
                .spec = spec(),
                .format = one_of(PictureFormat::srgb8),
                .tone_map = {.curve = one_of(ToneCurve::filmic), .exposure = real()},
                .time_limit = amount(),
                .error_limit = amount(),
                .sums_bytes = big()};
    }
    FrameSave make_one(FrameSave) { return {.request = big()}; }
    SumsChunk make_one(SumsChunk) {
        SumsChunk out{.request = big(),
                      .offset = 0,
                      .total = 1 + below(1u << 30),
                      .render_seconds = amount(),
                      .rays = big()};
        out.offset = below(out.total);
        return out;
    }
    FrameCancel make_one(FrameCancel) { return {.request = big()}; }
    FrameProgress make_one(FrameProgress) {
        return {.request = big(),
                .tiles_done = big(),
                .tiles_total = big(),
                .passes_done = number(),
                .workers = number(),
                .error_estimate = amount()};
    }
    PictureChunk make_one(PictureChunk) {
        PictureChunk out{.request = big(),
                         .channel = one_of(Channel::owner),
                         .format = one_of(PictureFormat::srgb8),
                         .width = 1 + below(max_image_side),
                         .height = 1 + below(max_image_side),
                         .components = 1 + below(4)};
        const std::uint64_t bytes = out.format == PictureFormat::srgb8 ? 1 : 4;
        out.total = bytes * out.width * out.height * out.components;
        out.offset = below(out.total);
        return out;
    }
    WorkerShare make_one(WorkerShare) {
        return {.name = text(), .threads = number(), .tiles = big(), .rays = big()};
    }
    FrameDone make_one(FrameDone) {
        FrameDone out{.request = big(), .statistics = {}};
        out.statistics = {.build_seconds = amount(),
                          .render_seconds = amount(),
                          .passes = number(),
                          .rays = big(),
                          .sanitised = big(),
                          .tiles_reissued = big(),
                          .error_estimate = amount(),
                          .modelled = names(),
                          .left_out = names(),
                          .workers = list<WorkerShare>()};
        return out;
    }
    FrameBegin make_one(FrameBegin) { return {.spec = spec()}; }
    FrameEnd make_one(FrameEnd) { return {.frame = big()}; }
    TileTask make_one(TileTask) {
        return {.frame = big(),
                .tile = below(max_tiles),
                .first_pass = below(max_passes / 2),
                .pass_count = 1 + below(max_passes / 2),
                .part = below(quarters + 1)};
    }
    TileTasks make_one(TileTasks) { return {list<TileTask>()}; }
    TileReport make_one(TileReport) {
        return {.task = make_one(TileTask{}),
                .rays = big(),
                .sanitised = big(),
                .seconds = float(amount()),
                .pixel_bytes = below(400),
                .lights = lights(),
                .active_lights = number()};
    }
    std::vector<LightEstimate> lights() {
        std::vector<LightEstimate> out;
        for (std::uint32_t light = below(3); out.size() < 4; light += 1 + below(1000))
            out.push_back({light, float(amount())});
        return out;
    }
    TileResults make_one(TileResults) { return {list<TileReport>()}; }
    Failure make_one(Failure) { return {.request = big(), .reason = name()}; }
    StatusRequest make_one(StatusRequest) { return {}; }
    WorkerStatus make_one(WorkerStatus) {
        return {.peer = big(),
                .name = text(),
                .address = text(),
                .threads = number(),
                .leases = number(),
                .tiles = big(),
                .rays = big(),
                .round_trip_seconds = amount(),
                .prefetch = number(),
                .task_seconds = amount(),
                .memory_bytes = big(),
                .overdue = below(2) == 1,
                .busy_seconds = amount(),
                .relayed_bytes = big(),
                .sent_bytes = big()};
    }
    SceneStatus make_one(SceneStatus) {
        return {.name = name(), .version = big(), .instances = big(), .bytes = big()};
    }
    Status make_one(Status) {
        return {.build = text(),
                .uptime_seconds = amount(),
                .viewers = number(),
                .frames_in_flight = number(),
                .frames_done = big(),
                .scenes = list<SceneStatus>(),
                .workers = list<WorkerStatus>(),
                .memory_bytes = big(),
                .worker_bytes = big()};
    }
    Ping make_one(Ping) { return {.stamp = big()}; }
    Pong make_one(Pong) { return {.stamp = big(), .memory_bytes = big(), .relayed_bytes = big()}; }
    Leave make_one(Leave) { return {}; }

    mat4 transform() { return make_one(Instance{}).world_from_object; }
    std::optional<vec3> maybe_vector() { return coin() ? std::optional(vector()) : std::nullopt; }
    std::optional<float> maybe_real() { return coin() ? std::optional(real()) : std::nullopt; }
    EditOperation make_one(const EditOperation&) {
        switch (below(15)) {
            case 0:
                return SetTransform{name(), transform()};
            case 1:
                return CreateInstance{name(), name(), transform()};
            case 2:
                return DeleteInstance{name()};
            case 3:
                return SetMaterial{name(),
                                   maybe_vector(),
                                   maybe_real(),
                                   maybe_real(),
                                   maybe_vector(),
                                   coin() ? std::optional(name()) : std::nullopt,
                                   list<ShaderParameter>()};
            case 4:
                return SetLight{name(),         maybe_vector(), maybe_vector(),
                                maybe_vector(), maybe_real(),   maybe_real()};
            case 5:
                return CreateLight{make_one(Light{})};
            case 6:
                return DeleteLight{name()};
            case 7:
                return SetShape{name(), blob()};
            case 8:
                return CreateObject{name(), blob(), names()};
            case 9:
                return DeleteObject{name()};
            case 10:
                return CreateMaterial{make_one(Material{})};
            case 11:
                return DeleteMaterial{name()};
            case 12:
                return DeleteCamera{name()};
            case 13:
                return SetEnvironment{maybe_vector(), maybe_real()};
            default:
                return SetCamera{make_one(Camera{})};
        }
    }
    SceneShare make_one(SceneShare) { return {.scene = name()}; }
    SceneWatch make_one(SceneWatch) { return {.scene = name()}; }
    SceneEdit make_one(SceneEdit) {
        return {.request = big(),
                .scene = name(),
                .operations = list<EditOperation>(),
                .blob_bytes = {}};
    }
    EditResult make_one(EditResult) {
        return {.request = big(), .scene = name(), .version = big(), .complaints = names()};
    }

    View make_one(View) {
        return {.request = 1 + big() / 2,
                .spec = spec(),
                .format = one_of(PictureFormat::automatic),
                .tone_map = {.curve = one_of(ToneCurve::filmic), .exposure = real()},
                .shown = one_of(Channel::owner),
                .error_limit = amount(),
                .stamp = big(),
                .jpeg_quality = below(101)};
    }
    ViewEnd make_one(ViewEnd) { return {.request = big()}; }
    ViewPicture make_one(ViewPicture) {
        return {.request = big(),
                .stamp = big(),
                .version = big(),
                .passes = number(),
                .settled = coin(),
                .error_estimate = amount(),
                .first_seconds = amount(),
                .render_seconds = amount(),
                .rays = big()};
    }

    template <class T>
    std::vector<T> list() {
        std::vector<T> out(below(4));
        for (T& entry : out) entry = make_one(entry);
        return out;
    }

    std::mt19937_64 random_;
};

/// What a peer receives of an encoded message: its one contiguous run of bytes.
inline Bytes flattened(const EncodedMessage& message) {
    Bytes bytes = message.head;
    bytes.insert(bytes.end(), message.payload.bytes.begin(), message.payload.bytes.end());
    return bytes;
}

/// Decodes a frame as a connection does. Throws ProtocolError, also when bytes are missing or left.
inline Message decode_frame(std::span<const std::byte> bytes, const FrameLimits& limits = {}) {
    if (bytes.size() < frame_header_bytes) throw ProtocolError("ends early");
    const FrameHeader header = decode_header(bytes.first<frame_header_bytes>(), limits);
    const auto body = bytes.subspan(frame_header_bytes);
    if (body.size() != std::size_t(header.message_bytes) + header.payload_bytes)
        throw ProtocolError("length disagrees with the header");
    // A copy of its own size, so that the address sanitizer sees any read past the end.
    const auto owner = std::make_shared<const Bytes>(body.begin(), body.end());
    const std::span<const std::byte> own(*owner);
    return decode(header, own.first(header.message_bytes),
                  {owner, own.subspan(header.message_bytes)});
}

}  // namespace tessera
