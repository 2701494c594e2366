// The tiles that any worker may send are refused, or become part of a frame that can be folded and
// shown. Input: 1 byte length of the message, 2 bytes length of its payload, both, and so on.

#include "common/check.h"
#include "server/frame.h"
#include "tests/fuzz/fuzz_message.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    using namespace tessera;
    FrameSpec spec;
    spec.frame = 1;
    spec.size = {17, 2};
    spec.settings.passes = 2;
    FrameAssembler assembler(spec);
    FrameSums sums(spec);
    auto rest = std::as_bytes(std::span(data, size));
    const auto take = [&](std::size_t bytes) {
        const auto taken = rest.first(std::min(bytes, rest.size()));
        rest = rest.subspan(taken.size());
        return taken;
    };
    try {
        while (!rest.empty()) {
            const auto lengths = take(3);
            if (lengths.size() < 3) break;
            const auto body = take(std::size_t(lengths[0]));
            const auto payload = take(std::size_t(lengths[1]) | std::size_t(lengths[2]) << 8);
            const Message message = decode_body(kind_tile_results, body, payload);
            auto pixels = message.payload.bytes;
            for (const TileReport& tile : std::get<TileResults>(message.body).tiles) {
                const auto own = pixels.first(tile.pixel_bytes);
                pixels = pixels.subspan(tile.pixel_bytes);
                CHECK_EQ(assembler.fits(tile.task, own),
                         assembler.add(tile.task, own) != Arrival::broken);
            }
            while (std::optional<RunBuffer> run = assembler.take_complete()) {
                sums.fold(*run, 0, spec.size.height);
                sums.finish_run(*run);
                assembler.run_folded(std::move(*run));
            }
        }
    } catch (const ProtocolError&) {
    }
    CHECK_EQ(sums.picture().data.size(), 3 * spec.size.pixels());
    return 0;
}
