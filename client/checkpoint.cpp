#include "client/checkpoint.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <fstream>
#include <span>
#include <utility>

#include "common/check.h"
#include "common/message_codec.h"

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

/// Large sums take a while to travel.
constexpr std::chrono::seconds longest_save{60};

/// What stands before the sums, little-endian.
struct Header {
    std::array<char, 8> magic = {'T', 'S', 'R', 'S', 'U', 'M', '0', '1'};
    CheckpointKey key;
    double render_seconds = 0;
    std::uint64_t rays = 0;
    BlobId sums;
};
static_assert(sizeof(Header) == 8 + 2 * 32 + 16 + 32);

BlobId digest_of(const std::string& prefix, Message message) {
    Bytes bytes = encode(std::move(message)).head;
    const auto text = std::as_bytes(std::span(prefix));
    bytes.insert(bytes.end(), text.begin(), text.end());
    return blob_id(bytes);
}

[[noreturn]] void fail(const std::filesystem::path& file) {
    throw UserError(
        fmt::format("--checkpoint: cannot write {}: {}", file.string(), std::strerror(errno)));
}

/// On the disk when it returns.
void write_all(const std::filesystem::path& file, std::span<const std::byte> header,
               std::span<const std::byte> body) {
    const int fd = open(file.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);
    bool good = fd >= 0;
    for (std::span<const std::byte> bytes : {header, body})
        while (good && !bytes.empty()) {
            const ssize_t written = write(fd, bytes.data(), bytes.size());
            good = written > 0;
            if (good) bytes = bytes.subspan(std::size_t(written));
        }
    good = good && fsync(fd) == 0;
    const int error = errno;
    if (fd >= 0) close(fd);
    errno = error;
    if (!good) fail(file);
}

}  // namespace

CheckpointKey checkpoint_key(const Scene& scene, const FrameRequest& request) {
    FrameRequest settings;
    settings.request = 1;
    settings.spec = request.spec;
    settings.spec.scene.clear();
    const SceneVersion version{.version = 1, .scene = scene};
    return {.scene = digest_of("", {SceneUpdate{.scene = {}, .delta = diff({}, version)}, {}}),
            .settings = digest_of(TESSERA_VERSION, {settings, {}})};
}

Checkpoint::Checkpoint(std::filesystem::path file, const CheckpointKey& key,
                       std::chrono::seconds every)
    : file_(std::move(file)), key_(key), every_(every), asked_(Clock::now()) {}

SavedSums Checkpoint::load() {
    std::ifstream in(file_, std::ios::binary);
    if (!in) return {};
    Header header;
    const Header expected;
    in.read(reinterpret_cast<char*>(&header), sizeof header);
    const auto refuse = [&](const char* reason) {
        throw UserError(
            fmt::format("--checkpoint: {} {}; remove it to begin anew, or name another file",
                        file_.string(), reason));
    };
    if (!in || header.magic != expected.magic) refuse("is no checkpoint of this release");
    if (header.key.scene != key_.scene) refuse("is of another scene");
    if (header.key.settings != key_.settings)
        refuse("is of other settings (camera, size, quality), or of another release");
    const std::uint64_t size = std::filesystem::file_size(file_) - sizeof header;
    SavedSums out{
        .sums = Bytes(size), .render_seconds = header.render_seconds, .rays = header.rays};
    in.read(reinterpret_cast<char*>(out.sums.data()), std::streamsize(size));
    if (!in || blob_id(out.sums) != header.sums) refuse("is damaged");
    loaded_ = {.sums = {}, .render_seconds = out.render_seconds, .rays = out.rays};
    return out;
}

bool Checkpoint::save_arrived(RenderClient& client) {
    const std::optional<SavedSums> saved = client.take_sums();
    if (!saved) return false;
    if (saved->sums.empty()) return true;
    const Header header{.key = key_,
                        .render_seconds = loaded_.render_seconds + saved->render_seconds,
                        .rays = loaded_.rays + saved->rays,
                        .sums = blob_id(saved->sums)};
    const std::filesystem::path part = file_.string() + ".part";
    write_all(part, std::as_bytes(std::span(&header, 1)), saved->sums);
    if (rename(part.c_str(), file_.c_str()) != 0) fail(file_);
    return true;
}

void Checkpoint::tick(RenderClient& client) {
    save_arrived(client);
    if (Clock::now() - asked_ < every_) return;
    asked_ = Clock::now();
    client.ask_sums();
}

void Checkpoint::save_now(RenderClient& client) {
    const auto deadline = Clock::now() + longest_save;
    client.ask_sums();
    while (!save_arrived(client) && client.connected() && Clock::now() < deadline)
        client.poll(std::chrono::milliseconds(100));
}

}  // namespace tessera
