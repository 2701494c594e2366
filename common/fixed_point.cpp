#include "common/fixed_point.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <stdexcept>

namespace tessera {
namespace {

constexpr unsigned most_bits = 24;

std::size_t packed_bytes(const PackedPoints& points) {
    return (points.count * (points.bits.x + points.bits.y + points.bits.z) + 7) / 8;
}

/// Bits in a row, the lowest of each number first.
class BitWriter {
public:
    explicit BitWriter(std::vector<std::byte>& out) : out_(out) {}
    ~BitWriter() {
        if (held_ > 0) out_.push_back(std::byte(pending_));
    }
    BitWriter(const BitWriter&) = delete;

    void put(std::uint32_t value, unsigned bits) {
        pending_ |= std::uint64_t(value) << held_;
        for (held_ += bits; held_ >= 8; held_ -= 8, pending_ >>= 8)
            out_.push_back(std::byte(pending_));
    }

private:
    std::vector<std::byte>& out_;
    std::uint64_t pending_ = 0;
    unsigned held_ = 0;
};

class BitReader {
public:
    explicit BitReader(std::span<const std::byte> in) : in_(in) {}

    std::uint32_t take(unsigned bits) {
        for (; held_ < bits; held_ += 8) pending_ |= std::uint64_t(in_[next_++]) << held_;
        const auto value = std::uint32_t(pending_ & ((std::uint64_t(1) << bits) - 1));
        pending_ >>= bits;
        held_ -= bits;
        return value;
    }

private:
    std::span<const std::byte> in_;
    std::size_t next_ = 0;
    std::uint64_t pending_ = 0;
    unsigned held_ = 0;
};

}  // namespace

PackedPoints pack(std::span<const vec3> points, float error) {
    PackedPoints out{.count = points.size(), .packed = {}};
    Box bounds;
    for (const vec3& p : points) bounds.add(p);
    if (!points.empty()) out.lo = bounds.lo;

    // As many steps as the error asks for.
    for (int axis = 0; axis < 3 && !points.empty(); ++axis) {
        const float extent = bounds.hi[axis] - bounds.lo[axis];
        const float steps = std::clamp(std::ceil(0.5f * extent / error), 1.0f, 16777215.0f);
        out.bits[axis] = std::min(unsigned(std::bit_width(std::uint32_t(steps))), most_bits);
        out.step[axis] = extent / float((1u << out.bits[axis]) - 1);
    }

    out.packed.reserve(packed_bytes(out));
    {
        BitWriter writer(out.packed);
        for (const vec3& p : points)
            for (int axis = 0; axis < 3; ++axis) {
                const float most = float((1u << out.bits[axis]) - 1);
                const float at =
                    out.step[axis] > 0 ? std::round((p[axis] - out.lo[axis]) / out.step[axis]) : 0;
                writer.put(std::uint32_t(std::clamp(at, 0.0f, most)), out.bits[axis]);
            }
    }
    const std::vector<vec3> again = unpack(out);
    for (std::size_t i = 0; i < points.size(); ++i)
        out.error = std::max(out.error, max_component(abs(again[i] - points[i])));
    return out;
}

std::vector<vec3> unpack(const PackedPoints& points) {
    for (int axis = 0; axis < 3; ++axis)
        if (points.bits[axis] < 1 || points.bits[axis] > most_bits)
            throw std::runtime_error("points of so many bits are not known");
    if (points.count > 8 * points.packed.size() || packed_bytes(points) != points.packed.size())
        throw std::runtime_error("points and their bytes disagree");
    BitReader reader(points.packed);
    std::vector<vec3> out(points.count);
    for (vec3& p : out)
        for (int axis = 0; axis < 3; ++axis)
            p[axis] = points.lo[axis] + points.step[axis] * float(reader.take(points.bits[axis]));
    return out;
}

}  // namespace tessera
