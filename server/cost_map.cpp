#include "server/cost_map.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace tessera {
namespace {

/// Views that are remembered: as many viewers can be served in turn without mixing them up.
constexpr std::size_t most_entries = 8;
/// Costs are sorted by their power of sqrt(2).
constexpr int most_levels = 64;

int level(float cost) {
    const float halves = 2 * std::log2(std::max(cost, 1e-9f));
    return std::clamp(most_levels / 2 - int(std::floor(halves)), 0, most_levels - 1);
}

bool alike(const FrameSpec& a, const FrameSpec& b) {
    return a.scene == b.scene && a.size == b.size && a.settings.integrator == b.settings.integrator;
}

float distance(const Camera& a, const Camera& b) {
    return length(a.eye - b.eye) + length(a.at - b.at);
}

}  // namespace

void CostMap::measure(std::uint32_t tile, float cost) { measured_[tile] = std::max(cost, 1e-9f); }

std::vector<std::uint32_t> CostMap::order() const {
    std::vector<std::uint32_t> order(measured_.size());
    std::iota(order.begin(), order.end(), 0u);
    if (predicted_.empty()) return order;
    // A counting sort: keeps the order among equals.
    std::vector<std::uint32_t> begin(most_levels + 1);
    for (const float cost : predicted_) ++begin[std::size_t(level(cost)) + 1];
    std::partial_sum(begin.begin(), begin.end(), begin.begin());
    for (std::uint32_t tile = 0; tile < predicted_.size(); ++tile)
        order[begin[std::size_t(level(predicted_[tile]))]++] = tile;
    return order;
}

std::vector<float> CostMap::learnt() const {
    double sum = 0;
    for (const float cost : measured_) {
        if (cost == 0) return {};
        sum += cost;
    }
    std::vector<float> out = measured_;
    for (float& cost : out) cost *= float(double(out.size()) / sum);
    return out;
}

void CostMemory::keep(const FrameSpec& spec, const CostMap& costs) {
    std::vector<float> learnt = costs.learnt();
    if (learnt.empty()) return;
    std::erase_if(entries_, [&](const Entry& e) {
        return alike(e.spec, spec) && e.spec.camera == spec.camera;
    });
    entries_.push_front({spec, std::move(learnt)});
    if (entries_.size() > most_entries) entries_.pop_back();
}

CostMap CostMemory::recall(const FrameSpec& spec) const {
    const Entry* nearest = nullptr;
    for (const Entry& entry : entries_) {
        if (!alike(entry.spec, spec)) continue;
        if (!nearest ||
            distance(entry.spec.camera, spec.camera) < distance(nearest->spec.camera, spec.camera))
            nearest = &entry;
    }
    return nearest ? CostMap(nearest->costs) : CostMap(tile_count(spec.size));
}

}  // namespace tessera
