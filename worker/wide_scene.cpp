#include "worker/wide_scene.h"

#include <tbb/parallel_for.h>
#include <tbb/parallel_reduce.h>
#include <tbb/task_arena.h>

#include <array>
#include <atomic>
#include <numeric>

#include "common/check.h"
#include "worker/bvh.h"
#include "worker/clip.h"
#include "worker/kdtree.h"

namespace tessera {
namespace {

// Rays are as fast in trees from 0.5 to 4; the leanest is smallest and soonest built.
constexpr KdCosts object_costs{.traversal = 1, .intersection = 0.25f};

Triangle triangle_of(const TracerObject& object, std::uint32_t i) {
    const uvec3& v = object.triangles[i];
    return {object.positions[v.x], object.positions[v.y], object.positions[v.z], i};
}

/// Bounds of all triangles that can be hit.
RawVector<BoxRef> triangle_refs(const TracerObject& object) {
    constexpr std::uint32_t none = ~0u;
    RawVector<BoxRef> refs(object.triangles.size());
    std::atomic<bool> complete = true;
    tbb::parallel_for(std::uint32_t(0), std::uint32_t(refs.size()), [&](std::uint32_t i) {
        const Triangle t = triangle_of(object, i);
        const bool sound = !is_degenerate(t);
        refs[i] = {min(t.a, min(t.b, t.c)), sound ? i : none, max(t.a, max(t.b, t.c)), 0};
        if (!sound) complete = false;
    });
    if (!complete) std::erase_if(refs, [](const BoxRef& ref) { return ref.item == none; });
    return refs;
}

BoxTree kd_boxes(const TracerObject& object, std::uint32_t leaf_size) {
    const ClippedBounds clipped = [&](std::uint32_t i, const Box& cell) {
        const Triangle triangle = triangle_of(object, i);
        return is_degenerate(triangle) ? Box{} : clipped_bounds(triangle, cell);
    };
    const auto count = std::uint32_t(object.triangles.size());
    return boxes_of(build_kdtree(count, clipped, object_costs), clipped, leaf_size);
}

/// World bounds of an instance, widened by what rounding can move a ray that is transformed into
/// the object's space.
Box instance_bounds(const Box& object_bounds, const mat4& world_from_object) {
    Box box = transformed(object_bounds, world_from_object);
    if (box.empty()) return box;
    const vec3 scale = max(abs(box.lo), abs(box.hi));
    const vec3 margin(0x1p-19f * max_component(scale));
    return {box.lo - margin, box.hi + margin};
}

BoxRef finite(const Box& box, std::uint32_t item) {
    const vec3 most(std::numeric_limits<float>::max());
    return {clamp(box.lo, -most, most), item, clamp(box.hi, -most, most), 0};
}

/// Which triangles stand in the lanes of which block. Small leaves share blocks: to test a few
/// triangles more costs nothing, and what is full takes less memory.
template <int width>
class LeafLanes {
public:
    WideLink add(std::span<const std::uint32_t> items) {
        const std::size_t count = (items.size() + width - 1) / width;
        std::size_t block = blocks(), fullest = 0;
        for (std::size_t i = block - std::min(block, nearby); i < blocks(); ++i) {
            if (counts_[i] + items.size() > width || counts_[i] < fullest) continue;
            block = i;
            fullest = counts_[i];
        }
        if (block == blocks()) {
            counts_.resize(block + count, 0);
            lanes_.resize(counts_.size() * width);
        }
        for (std::size_t i = 0; i < items.size(); ++i) {
            const std::size_t at = block + i / width;
            lanes_[at * width + counts_[at]++] = items[i];
        }
        return WideLink::leaf(std::uint32_t(block), std::uint32_t(count));
    }

    std::size_t blocks() const { return counts_.size(); }
    std::span<const std::uint32_t> of(std::size_t block) const {
        return std::span(lanes_).subspan(block * width, counts_[block]);
    }

private:
    static constexpr std::size_t nearby = 16;  ///< so far apart may leaves share

    RawVector<std::uint32_t> lanes_;
    std::vector<std::uint8_t> counts_;
};

/// Over boxes that are worth a lane each.
template <int width>
WideTree<width> top_tree(const RawVector<BoxRef>& refs) {
    std::vector<WideNode<width>> lowest;  // their lanes are the items
    const WideCosts costs{.node = 1, .block = 1, .block_size = width, .max_blocks = 1};
    const auto make_leaf = [&](std::span<const std::uint32_t> items) {
        WideNode<width> node;
        for (int i = 0; i < int(items.size()); ++i) {
            const BoxRef& ref = refs[items[i]];
            node.set_child(i, {ref.lo, ref.hi}, WideLink::leaf(ref.item, 1));
        }
        lowest.push_back(node);
        return WideLink::leaf(std::uint32_t(lowest.size()) - 1, 1);
    };
    WideTree<width> tree = collapse<width>(
        build_bvh(refs, {.block_size = width, .leaf_size = width}), costs, make_leaf);
    const auto offset = std::uint32_t(tree.nodes.size());
    for (WideNode<width>& node : tree.nodes)
        for (WideLink& link : node.children)
            if (link.is_leaf()) link = WideLink::node(offset + link.first());
    tree.nodes.insert(tree.nodes.end(), lowest.begin(), lowest.end());
    return tree;
}

}  // namespace

Box bounds_of(const TracerObject& object) {
    return tbb::parallel_reduce(
        tbb::blocked_range<std::uint32_t>(0, std::uint32_t(object.triangles.size())), Box(),
        [&](const auto& part, Box box) {
            for (std::uint32_t i = part.begin(); i < part.end(); ++i) {
                const Triangle t = triangle_of(object, i);
                if (is_degenerate(t)) continue;
                for (const vec3& p : {t.a, t.b, t.c}) box.add(p);
            }
            return box;
        },
        [](Box a, const Box& b) {
            a.add(b);
            return a;
        });
}

template <int width>
void LateObject<width>::build() {
    std::call_once(once_, [&] {
        object_ = tbb::task_arena(threads_).execute(
            [&] { return build_object<width>(source_, TreeBuilder::quick); });
        built_.store(true, std::memory_order_release);
    });
}

template <int width>
WideObject<width> build_object(const TracerObject& object, TreeBuilder builder) {
    const std::uint32_t leaf_size = builder == TreeBuilder::quick ? width : width / 2;
    const BoxTree tree =
        builder == TreeBuilder::kdtree
            ? kd_boxes(object, width)
            : build_bvh(triangle_refs(object), {.block_size = width, .leaf_size = leaf_size});
    WideObject<width> out;
    LeafLanes<width> lanes;
    out.tree =
        collapse<width>(tree, {.node = 1, .block = 2, .block_size = width},
                        [&](std::span<const std::uint32_t> items) { return lanes.add(items); });
    CHECK(lanes.blocks() <= WideLink::max_first);
    out.blocks.resize(lanes.blocks());
    tbb::parallel_for(std::size_t(0), out.blocks.size(), [&](std::size_t block) {
        const auto items = lanes.of(block);
        std::array<Triangle, width> triangles{};
        std::ranges::transform(items, triangles.begin(),
                               [&](std::uint32_t i) { return triangle_of(object, i); });
        out.blocks[block] = TriangleBlock<width>::of(std::span(triangles).first(items.size()));
    });
    return out;
}

template <int width>
void build_top(WideScene<width>& scene, std::span<const TracerInstance> instances,
               std::span<const std::uint8_t> baked) {
    constexpr std::uint32_t none = ~0u;
    constexpr std::size_t task_instances = 128;
    RawVector<BoxRef> refs(instances.size());
    scene.instances.resize(instances.size());
    const auto place = [&](std::size_t i) {
        const auto& [object, world_from_object, moves] = instances[i];
        const auto inverse = inverse_affine(world_from_object);
        const Box box = instance_bounds(scene.objects[object]->tree.bounds, world_from_object);
        const bool is_baked = !baked.empty() && baked[i];
        refs[i] = finite(box, inverse && !box.empty() && !is_baked ? 0 : none);
        if (inverse) scene.instances[i] = {object, std::uint32_t(i), *inverse};
    };
    tbb::parallel_for(tbb::blocked_range<std::size_t>(0, refs.size(), task_instances),
                      [&](const auto& part) {
                          for (std::size_t i = part.begin(); i < part.end(); ++i) place(i);
                      });

    const Box& of_baked = scene.objects.empty() ? Box() : scene.objects.back()->tree.bounds;
    if (!baked.empty() && !of_baked.empty()) {
        refs.push_back(finite(of_baked, 0));
        scene.instances.push_back({std::uint32_t(scene.objects.size() - 1), baked_instance, {}});
    }

    // Those that can be hit move up.
    std::uint32_t count = 0;
    for (std::size_t i = 0; i < refs.size(); ++i) {
        if (refs[i].item == none) continue;
        refs[count] = refs[i];
        refs[count].item = count;
        scene.instances[count++] = scene.instances[i];
    }
    CHECK(count <= WideLink::max_first);
    refs.resize(count);
    scene.instances.resize(count);
    scene.top = top_tree<width>(refs);
    scene.items.resize(count);
    std::iota(scene.items.begin(), scene.items.end(), 0u);
}

template class LateObject<4>;
template class LateObject<8>;
template class LateObject<16>;
template WideObject<4> build_object(const TracerObject&, TreeBuilder);
template WideObject<8> build_object(const TracerObject&, TreeBuilder);
template WideObject<16> build_object(const TracerObject&, TreeBuilder);
template void build_top(WideScene<4>&, std::span<const TracerInstance>,
                        std::span<const std::uint8_t>);
template void build_top(WideScene<8>&, std::span<const TracerInstance>,
                        std::span<const std::uint8_t>);
template void build_top(WideScene<16>&, std::span<const TracerInstance>,
                        std::span<const std::uint8_t>);

}  // namespace tessera
