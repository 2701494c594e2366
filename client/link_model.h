// A network link as a user of TCP sees it: all bytes arrive and keep their order, but late.
#pragma once

#include <cstddef>
#include <cstdint>

namespace tessera {

struct LinkConfig {
    double delay = 0;            ///< seconds, one way
    double jitter = 0;           ///< seconds; up to as much is added, drawn for each piece
    double bits_per_second = 0;  ///< 0: no limit
    double loss = 0;             ///< share of packets that are lost and have to be sent again
    std::uint32_t seed = 1;

    bool operator==(const LinkConfig&) const = default;
};

/// One direction of it.
class LinkModel {
public:
    explicit LinkModel(const LinkConfig& config) : config_(config) {}

    /// When the last of `bytes` arrives that are handed to the link at `now`. In seconds; `now`
    /// never goes back.
    double arrival(double now, std::size_t bytes);

private:
    float draw();

    LinkConfig config_;
    std::uint32_t drawn_ = 0;
    double idle_from_ = 0;  ///< the sender's end has put everything on the wire by then
    double last_arrival_ = 0;
};

}  // namespace tessera
