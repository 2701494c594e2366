// Rays in the layout of one of Embree's calls, so that its rate can be measured by the call that
// suits it best, and without the cost of filling its structures.
#pragma once

#include <embree3/rtcore.h>

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "worker/tracer.h"

namespace tessera {

/// What is measured: closest hits or occlusion, of rays that resemble their neighbours or not.
struct RayUse {
    bool occlusion = false;
    bool coherent = false;
};

/// Rays that belong together: a tile's camera rays, or those from one light to a tile.
struct RayGroup {
    std::uint32_t first = 0;
    std::uint32_t count = 0;
};

enum class EmbreeCall : std::uint8_t { packets16, packets8, packets4, stream, stream16, single };
inline constexpr EmbreeCall embree_calls[] = {EmbreeCall::packets16, EmbreeCall::packets8,
                                              EmbreeCall::packets4,  EmbreeCall::stream,
                                              EmbreeCall::stream16,  EmbreeCall::single};

/// As Embree's function is called: "occluded16"...
std::string name_of(EmbreeCall call, bool occlusion);

class EmbreeQuery {
public:
    EmbreeQuery(EmbreeCall call, RayUse use);

    /// Lays the rays out; each group starts a new packet and is a stream of its own.
    void load(std::span<const Ray> rays, std::span<const RayGroup> groups);

    /// Traces them, once a load. Denormals are flushed to zero, as Embree's manual asks.
    void run(RTCScene scene);

    /// The answer to ray i, its t in `t` of closest hits.
    struct Answer {
        bool hit = false;
        float t = infinity;
    };
    Answer answer(std::size_t i) const;

private:
    struct Stretch {  ///< the packets of a group
        std::uint32_t first_packet, packets, last_lanes;
    };

    float* packet(std::size_t i) { return &memory_[0].values[0] + i * packet_floats_; }
    const float* packet(std::size_t i) const { return &memory_[0].values[0] + i * packet_floats_; }
    void set_lane(std::uint32_t slot, const Ray& ray, float far_end);
    void trace_packet(RTCScene scene, float* p, std::uint32_t lanes);
    void trace_stream(RTCScene scene, float* first, std::uint32_t packets);

    struct alignas(64) Line {
        float values[16];
    };

    EmbreeCall call_;
    RayUse use_;
    std::uint32_t width_;
    std::size_t packet_floats_;
    RTCIntersectContext context_;
    std::vector<Line> memory_;
    std::vector<Stretch> stretches_;
    std::vector<std::uint32_t> slots_;  ///< ray -> packet * width + lane
};

}  // namespace tessera
