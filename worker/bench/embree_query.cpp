#include "worker/bench/embree_query.h"

#include <pmmintrin.h>

#include <bit>

#include "common/check.h"

namespace tessera {
namespace {

// RTCRayN and RTCHitN: arrays of `width` values, one for each of these fields.
enum Field { org_x, org_y, org_z, tnear, dir_x, dir_y, dir_z, time, tfar, mask, id, flags };
constexpr int ray_fields = 12;
constexpr int geometry_id_field = ray_fields + 6;
constexpr int instance_id_field = ray_fields + 7;
constexpr int ray_hit_fields = ray_fields + 8;
static_assert(sizeof(RTCRay) == ray_fields * sizeof(float));
static_assert(sizeof(RTCRayHit) == ray_hit_fields * sizeof(float));
static_assert(sizeof(RTCRayHit16) == 16 * sizeof(RTCRayHit));

constexpr std::uint32_t width_of(EmbreeCall call) {
    switch (call) {
        case EmbreeCall::packets16:
        case EmbreeCall::stream16:
            return 16;
        case EmbreeCall::packets8:
            return 8;
        case EmbreeCall::packets4:
            return 4;
        case EmbreeCall::stream:
        case EmbreeCall::single:
            return 1;
    }
    return 1;
}

/// Masks that switch on the first n lanes.
struct LaneMasks {
    alignas(64) int lanes[17][16];
    constexpr LaneMasks() : lanes{} {
        for (int n = 0; n <= 16; ++n)
            for (int i = 0; i < n; ++i) lanes[n][i] = -1;
    }
};
constexpr LaneMasks lane_masks;

class FlushToZero {
public:
    FlushToZero() : before_(_mm_getcsr()) {
        _MM_SET_FLUSH_ZERO_MODE(_MM_FLUSH_ZERO_ON);
        _MM_SET_DENORMALS_ZERO_MODE(_MM_DENORMALS_ZERO_ON);
    }
    ~FlushToZero() { _mm_setcsr(before_); }
    FlushToZero(const FlushToZero&) = delete;
    FlushToZero& operator=(const FlushToZero&) = delete;

private:
    unsigned before_;
};

}  // namespace

std::string name_of(EmbreeCall call, bool occlusion) {
    constexpr const char* widths[] = {"16", "8", "4", "1M", "NM", "1"};
    return std::string(occlusion ? "occluded" : "intersect") + widths[int(call)];
}

EmbreeQuery::EmbreeQuery(EmbreeCall call, RayUse use)
    : call_(call),
      use_(use),
      width_(width_of(call)),
      packet_floats_(std::size_t(width_) * (use.occlusion ? ray_fields : ray_hit_fields)) {
    rtcInitIntersectContext(&context_);
    context_.flags =
        use.coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT;
}

void EmbreeQuery::load(std::span<const Ray> rays, std::span<const RayGroup> groups) {
    stretches_.clear();
    slots_.resize(rays.size());
    std::uint32_t packets = 0;
    for (const RayGroup& group : groups) {
        if (group.count == 0) continue;
        const std::uint32_t own = (group.count + width_ - 1) / width_;
        stretches_.push_back({packets, own, group.count - (own - 1) * width_});
        for (std::uint32_t i = 0; i < group.count; ++i)
            slots_[group.first + i] = packets * width_ + i;
        packets += own;
    }
    memory_.assign((packets * packet_floats_ + 15) / 16, Line{});
    for (std::size_t i = 0; i < rays.size(); ++i) set_lane(slots_[i], rays[i], rays[i].tmax);
    // Lanes that no ray fills repeat one of the packet, with tnear > tfar: Embree's way to leave
    // them out of streams. Packets of zeros make some of its calls run for ever.
    for (const RayGroup& group : groups)
        for (std::uint32_t i = group.count; group.count > 0 && i % width_ != 0; ++i)
            set_lane(slots_[group.first] + i, rays[group.first + group.count - 1], -1);
}

void EmbreeQuery::set_lane(std::uint32_t slot, const Ray& ray, float far_end) {
    float* const lane = packet(slot / width_) + slot % width_;
    const auto set = [&](int field, float value) { lane[std::size_t(field) * width_] = value; };
    for (int k = 0; k < 3; ++k) {
        set(org_x + k, ray.org[k]);
        set(dir_x + k, ray.dir[k]);
    }
    set(tnear, ray.tmin);
    set(tfar, far_end);
    const float none = std::bit_cast<float>(RTC_INVALID_GEOMETRY_ID);
    set(mask, none);  // all bits
    if (use_.occlusion) return;
    set(geometry_id_field, none);
    set(instance_id_field, none);
}

void EmbreeQuery::trace_packet(RTCScene scene, float* p, std::uint32_t lanes) {
    const int* const valid = lane_masks.lanes[lanes];
    const bool occlusion = use_.occlusion;
    switch (width_) {
        case 16:
            occlusion ? rtcOccluded16(valid, scene, &context_, reinterpret_cast<RTCRay16*>(p))
                      : rtcIntersect16(valid, scene, &context_, reinterpret_cast<RTCRayHit16*>(p));
            return;
        case 8:
            occlusion ? rtcOccluded8(valid, scene, &context_, reinterpret_cast<RTCRay8*>(p))
                      : rtcIntersect8(valid, scene, &context_, reinterpret_cast<RTCRayHit8*>(p));
            return;
        case 4:
            occlusion ? rtcOccluded4(valid, scene, &context_, reinterpret_cast<RTCRay4*>(p))
                      : rtcIntersect4(valid, scene, &context_, reinterpret_cast<RTCRayHit4*>(p));
            return;
        default:
            occlusion ? rtcOccluded1(scene, &context_, reinterpret_cast<RTCRay*>(p))
                      : rtcIntersect1(scene, &context_, reinterpret_cast<RTCRayHit*>(p));
    }
}

void EmbreeQuery::trace_stream(RTCScene scene, float* first, std::uint32_t packets) {
    const std::size_t bytes = packet_floats_ * sizeof(float);
    if (use_.occlusion)
        rtcOccludedNM(scene, &context_, reinterpret_cast<RTCRayN*>(first), width_, packets, bytes);
    else
        rtcIntersectNM(scene, &context_, reinterpret_cast<RTCRayHitN*>(first), width_, packets,
                       bytes);
}

void EmbreeQuery::run(RTCScene scene) {
    const FlushToZero flush;
    const bool streams = call_ == EmbreeCall::stream || call_ == EmbreeCall::stream16;
    for (const Stretch& s : stretches_) {
        if (streams) {
            trace_stream(scene, packet(s.first_packet), s.packets);
            continue;
        }
        for (std::uint32_t i = 0; i < s.packets; ++i)
            trace_packet(scene, packet(s.first_packet + i),
                         i + 1 == s.packets ? s.last_lanes : width_);
    }
}

EmbreeQuery::Answer EmbreeQuery::answer(std::size_t i) const {
    const float* const lane = packet(slots_[i] / width_) + slots_[i] % width_;
    const float t = lane[tfar * width_];
    if (use_.occlusion) return {t < 0, t};  // Embree marks an occluded ray with -infinity
    const auto geometry = std::bit_cast<std::uint32_t>(lane[geometry_id_field * width_]);
    return {geometry != RTC_INVALID_GEOMETRY_ID, t};
}

}  // namespace tessera
