#include "worker/light_tree.h"

#include <numeric>

namespace tessera {
namespace {

/// Cosine of max(0, a - b) for angles in [0, pi], given as cosines.
float cos_difference(float cos_a, float cos_b) {
    if (cos_a >= cos_b) return 1;
    const auto sine = [](float c) { return std::sqrt(std::max(0.0f, 1 - c * c)); };
    return cos_a * cos_b + sine(cos_a) * sine(cos_b);
}

/// Cosine of the smallest angle around `a.axis` that holds both cones; the axis stays.
float cos_cover(const LightBounds& a, const vec3& axis, const LightBounds& b) {
    const float angle = std::acos(std::clamp(dot(axis, b.axis), -1.0f, 1.0f)) +
                        std::acos(std::clamp(b.cos_spread, -1.0f, 1.0f));
    return std::min(a.cos_spread, angle >= pi ? -1.0f : std::cos(angle));
}

LightBounds join(const LightBounds& a, const LightBounds& b) {
    LightBounds sum = a;
    sum.box.add(b.box);
    sum.power = a.power + b.power;
    const vec3 middle = a.axis * a.power + b.axis * b.power;
    const float length_squared = dot(middle, middle);
    if (!(length_squared > 0) || std::min(a.cos_spread, b.cos_spread) <= -1) {
        sum.cos_spread = -1;
        return sum;
    }
    sum.axis = middle / std::sqrt(length_squared);
    sum.cos_spread = 1;
    sum.cos_spread = cos_cover(sum, sum.axis, a);
    sum.cos_spread = cos_cover(sum, sum.axis, b);
    return sum;
}

/// About the irradiance that the lights send to `p`; zero only where none can shine.
float importance(const LightBounds& b, const vec3& p) {
    const vec3 to = p - b.box.centre();
    const float radius_squared = 0.25f * dot(b.box.extent(), b.box.extent());
    const float d2 = std::max(dot(to, to), 1e-30f);
    float cosine = 1;
    if (d2 > radius_squared && b.cos_spread > -1) {
        // The angle of emission, less what the normals and the lights' places may make of it.
        const float cos_axis = dot(b.axis, to) / std::sqrt(d2);
        const float cos_extent = std::sqrt(1 - radius_squared / d2);
        cosine = cos_difference(cos_difference(cos_axis, b.cos_spread), cos_extent);
    }
    return cosine > 0 ? b.power * cosine / std::max(d2, radius_squared) : 0;
}

}  // namespace

LightTree::LightTree(std::span<const LightBounds> lights) {
    if (lights.empty()) return;
    std::vector<std::uint32_t> order(lights.size());
    std::iota(order.begin(), order.end(), 0u);
    leaf_of_light_.resize(lights.size());
    nodes_.reserve(2 * lights.size());
    nodes_.emplace_back();
    build(0, order, lights);
}

void LightTree::build(std::uint32_t node, std::span<std::uint32_t> order,
                      std::span<const LightBounds> lights) {
    if (order.size() == 1) {
        nodes_[node].bounds = lights[order[0]];
        nodes_[node].light = order[0];
        leaf_of_light_[order[0]] = node;
        return;
    }
    Box centres;
    for (const std::uint32_t i : order) centres.add(lights[i].box.centre());
    const vec3 extent = centres.extent();
    const int axis = extent.x >= extent.y && extent.x >= extent.z ? 0
                     : extent.y >= extent.z                       ? 1
                                                                  : 2;
    const auto half = order.begin() + std::ptrdiff_t(order.size() / 2);
    std::nth_element(order.begin(), half, order.end(), [&](std::uint32_t a, std::uint32_t b) {
        const float ca = lights[a].box.centre()[axis], cb = lights[b].box.centre()[axis];
        return ca < cb || (ca == cb && a < b);
    });
    const auto child = std::uint32_t(nodes_.size());
    nodes_.resize(nodes_.size() + 2);
    nodes_[node].child = child;
    nodes_[child].parent = nodes_[child + 1].parent = node;
    build(child, order.first(order.size() / 2), lights);
    build(child + 1, order.subspan(order.size() / 2), lights);
    nodes_[node].bounds = join(nodes_[child].bounds, nodes_[child + 1].bounds);
}

std::vector<std::uint32_t> LightTree::order() const {
    std::vector<std::uint32_t> lights, open;
    if (!empty()) open.push_back(0);
    while (!open.empty()) {
        const Node& node = nodes_[open.back()];
        open.pop_back();
        if (node.child == 0)
            lights.push_back(node.light);
        else
            open.insert(open.end(), {node.child + 1, node.child});
    }
    return lights;
}

LightTree LightTree::without(std::span<const std::uint32_t> lights) const {
    LightTree rest = *this;
    for (const std::uint32_t light : lights) rest.nodes_[leaf_of_light_[light]].bounds.power = 0;
    // Children come after their parents. The other bounds may stay larger than need be.
    for (std::size_t i = nodes_.size(); i-- > 0;) {
        Node& node = rest.nodes_[i];
        if (node.child != 0)
            node.bounds.power =
                rest.nodes_[node.child].bounds.power + rest.nodes_[node.child + 1].bounds.power;
    }
    return rest;
}

/// NaN when neither can shine.
float LightTree::chance_of_first(std::uint32_t child, const vec3& p) const {
    const float first = importance(nodes_[child].bounds, p);
    return first / (first + importance(nodes_[child + 1].bounds, p));
}

std::optional<Distribution::Choice> LightTree::sample(const vec3& p, float u) const {
    Distribution::Choice choice{.index = 0, .probability = 1, .u = u};
    std::uint32_t node = 0;
    while (nodes_[node].child != 0) {
        const std::uint32_t child = nodes_[node].child;
        const float first = chance_of_first(child, p);
        if (!(first >= 0)) return {};
        const bool take_first = choice.u < first;
        const float chance = take_first ? first : 1 - first;
        choice.u = std::min((take_first ? choice.u : choice.u - first) / chance, 0x1.fffffep-1f);
        choice.probability *= chance;
        node = take_first ? child : child + 1;
    }
    choice.index = nodes_[node].light;
    return choice;
}

float LightTree::probability(const vec3& p, std::uint32_t index) const {
    float probability = 1;
    for (std::uint32_t node = leaf_of_light_[index]; node != 0; node = nodes_[node].parent) {
        const std::uint32_t child = nodes_[nodes_[node].parent].child;
        const float first = chance_of_first(child, p);
        probability *= node == child ? first : 1 - first;
    }
    return probability >= 0 ? probability : 0;
}

}  // namespace tessera
