// The tile that any worker may send is refused, or becomes part of a frame that can be folded and
// shown. Input: 1 byte length of the message, the message, its payload, and so on for more tiles.

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
    const std::size_t payload_bytes =
        sizeof(float) * 16 * 2 * floats_per_pixel(tile_channels(spec));
    auto rest = std::as_bytes(std::span(data, size));
    const auto take = [&](std::size_t bytes) {
        const auto taken = rest.first(std::min(bytes, rest.size()));
        rest = rest.subspan(taken.size());
        return taken;
    };
    try {
        while (!rest.empty()) {
            const auto body = take(std::size_t(take(1)[0]));
            const Message message = decode_body(kind_tile_result, body, take(payload_bytes));
            const auto& result = std::get<TileResult>(message.body);
            if (!assembler.fits(result)) continue;
            assembler.add(result);
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
