// The same operations in the same order as the scalar code that serves the other cases, and so the
// same bits.
#include "worker/lamp_samples.h"

#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_AVX3_DL)
// See kernels.cpp.
#define HWY_BROKEN_EMU128 0
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "worker/lamp_samples.cpp"
#include "hwy/foreach_target.h"
// foreach_target.h comes first.
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

constexpr hn::ScalableTag<float> tag;
constexpr hn::RebindToSigned<decltype(tag)> int_tag;
using Float = hn::Vec<decltype(tag)>;
using Int = hn::Vec<decltype(int_tag)>;
using Mask = hn::Mask<decltype(tag)>;

HWY_INLINE Float splat(float x) { return hn::Set(tag, x); }

struct Vec3 {
    Float x, y, z;
};

HWY_INLINE Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
HWY_INLINE Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
HWY_INLINE Vec3 operator*(Vec3 a, Vec3 b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
HWY_INLINE Vec3 operator*(Vec3 a, Float b) { return {a.x * b, a.y * b, a.z * b}; }
HWY_INLINE Vec3 operator/(Vec3 a, Float b) { return {a.x / b, a.y / b, a.z / b}; }
HWY_INLINE Float dot_lanes(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
HWY_INLINE Vec3 if_else(Mask m, Vec3 a, Vec3 b) {
    return {hn::IfThenElse(m, a.x, b.x), hn::IfThenElse(m, a.y, b.y), hn::IfThenElse(m, a.z, b.z)};
}

HWY_INLINE Vec3 load3(const LampRequests::Column (&columns)[3], std::size_t at) {
    return {hn::Load(tag, &columns[0][at]), hn::Load(tag, &columns[1][at]),
            hn::Load(tag, &columns[2][at])};
}
HWY_INLINE void store3(Vec3 v, LampRequests::Column (&columns)[3], std::size_t at) {
    hn::Store(v.x, tag, &columns[0][at]);
    hn::Store(v.y, tag, &columns[1][at]);
    hn::Store(v.z, tag, &columns[2][at]);
}

/// A lamp in each lane.
class LampLanes {
public:
    LampLanes(const LampTable& table, Float u) : table_(table) {
        // The last lamp that begins at or before u.
        Int index = hn::Set(int_tag, -1);
        const Int one = hn::Set(int_tag, 1);
        for (std::size_t i = 0; i < table.lamps.size(); ++i)
            index = index + hn::IfThenElseZero(
                                hn::RebindMask(int_tag, splat(table.cumulative[i]) <= u), one);
        first_ = index * hn::Set(int_tag, int(sizeof(Lamp) / sizeof(float)));
    }

    HWY_INLINE Float get(std::size_t offset) const {
        const auto* floats = reinterpret_cast<const float*>(table_.lamps.data());
        return hn::GatherIndex(tag, floats, first_ + hn::Set(int_tag, int(offset / sizeof(float))));
    }
    HWY_INLINE Vec3 get3(std::size_t offset) const {
        return {get(offset), get(offset + sizeof(float)), get(offset + 2 * sizeof(float))};
    }

private:
    const LampTable& table_;
    Int first_;
};

/// Point of a lamp, and the light from there.
struct Candidate {
    Vec3 end, contribution;
    Float weight;
    Mask any;
};

HWY_INLINE Float fraction_lanes(Float x) { return x - hn::Floor(x); }

/// direct_candidate() of igi.cpp.
HWY_INLINE Candidate candidate(const LampTable& table, const LampSampling& sampling,
                               const LampRequests& r, std::size_t at, std::size_t i) {
    const Float zero = hn::Zero(tag), one = splat(1);
    const Float count = splat(float(sampling.candidates));
    const Float u =
        fraction_lanes(hn::Load(tag, &r.u_place[0][at]) + splat(float(i) * 0.75487766f));
    const Float v =
        fraction_lanes(hn::Load(tag, &r.u_place[1][at]) + splat(float(i) * 0.56984029f));
    const Float stratum = hn::Min((splat(float(i)) + hn::Load(tag, &r.u_choice[0][at])) / count,
                                  splat(0x1.fffffep-1f));
    const LampLanes lamp(table, stratum);

    // Uniform barycentric weights, as sample_triangle() finds them.
    const Float half_u = splat(0.5f) * u, half_v = splat(0.5f) * v;
    const Float offset = half_v - half_u;
    const Mask upper = offset > zero;
    const Float b1 = hn::IfThenElse(upper, half_u, half_u - offset);
    const Float b2 = hn::IfThenElse(upper, half_v + offset, half_v);
    const Vec3 point = lamp.get3(offsetof(Lamp, p0)) * (one - b1 - b2) +
                       lamp.get3(offsetof(Lamp, p1)) * b1 + lamp.get3(offsetof(Lamp, p2)) * b2;

    const Vec3 to = point - load3(r.p, at);
    const Float d2 = dot_lanes(to, to);
    const Float distance = hn::Sqrt(d2);
    const Vec3 wi = to / distance;
    const Float front_cosine = zero - dot_lanes(lamp.get3(offsetof(Lamp, ng)), wi);
    const Mask two_sided = lamp.get(offsetof(Lamp, two_sided)) > zero;
    const Float lamp_cosine = hn::IfThenElse(two_sided, hn::Abs(front_cosine), front_cosine);
    const Float pdf =
        lamp.get(offsetof(Lamp, probability)) * d2 / (lamp.get(offsetof(Lamp, area)) * lamp_cosine);
    const Float cosine = dot_lanes(load3(r.n, at), wi);
    const Mask faces = hn::And(hn::And(d2 > zero, lamp_cosine > zero),
                               hn::And(cosine > zero, dot_lanes(load3(r.ng, at), wi) > zero));

    // Scattered rays find near lamps, too.
    const Mask near = distance < hn::Sqrt(cosine / splat(sampling.max_geometry));
    const Float ratio = hn::Max(cosine, zero) / splat(pi) / (count * pdf);
    const Float share = hn::IfThenElse(near, one / (one + ratio * ratio), one);

    Candidate c;
    const Vec3 off = lamp.get3(offsetof(Lamp, off_front));
    c.end = if_else(front_cosine > zero, point + off, point - off);
    c.contribution =
        lamp.get3(offsetof(Lamp, radiance)) * (cosine / pdf) * (load3(r.throughput, at) * share);
    c.weight = (c.contribution.x + c.contribution.y + c.contribution.z) / splat(3);
    c.any = hn::And(faces, hn::And(c.weight > zero, c.weight < splat(infinity)));
    return c;
}

/// sample_direct() of igi.cpp.
void answer(const LampTable& table, const LampSampling& sampling, std::size_t count,
            LampRequests& r) {
    const Float zero = hn::Zero(tag), one = splat(1);
    for (std::size_t at = 0; at < count; at += hn::Lanes(tag)) {
        Float u = hn::Load(tag, &r.u_choice[1][at]), total = zero, chosen_weight = one;
        Vec3 end{zero, zero, zero}, contribution = end;
        for (std::size_t i = 0; i < sampling.candidates; ++i) {
            const Candidate c = candidate(table, sampling, r, at, i);
            // Reservoir of one, with the same random number stretched again after each decision.
            total = hn::IfThenElse(c.any, total + c.weight, total);
            const Float p = c.weight / total;
            const Mask taken = hn::And(c.any, u < p);
            u = hn::IfThenElse(taken, u / p, hn::IfThenElse(c.any, (u - p) / (one - p), u));
            end = if_else(taken, c.end, end);
            contribution = if_else(taken, c.contribution, contribution);
            chosen_weight = hn::IfThenElse(taken, c.weight, chosen_weight);
        }
        store3(end, r.end, at);
        const Float made_up = total / (chosen_weight * splat(float(sampling.candidates)));
        store3(contribution * made_up, r.e, at);
    }
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace tessera {

HWY_EXPORT(answer);

void sample_lamps(const LampTable& table, const LampSampling& sampling, std::size_t count,
                  LampRequests& requests) {
    HWY_DYNAMIC_DISPATCH(answer)(table, sampling, count, requests);
}

}  // namespace tessera
#endif
