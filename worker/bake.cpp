#include "worker/bake.h"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <numeric>

#include "common/check.h"
#include "worker/affine.h"

namespace tessera {
namespace {

/// How often each object is used.
std::vector<std::size_t> count_uses(std::span<const TracerObject> objects,
                                    std::span<const TracerInstance> instances) {
    std::vector<std::size_t> uses(objects.size());
    for (const TracerInstance& instance : instances) ++uses[instance.object];
    return uses;
}

/// Where an instance's geometry begins in the baked mesh.
struct Place {
    std::size_t position = 0, triangle = 0;
};

std::size_t whole_runs(std::size_t triangles) {
    return (triangles + TriangleNames::run - 1) / TriangleNames::run * TriangleNames::run;
}

void bake_instance(const TracerObject& object, const TracerInstance& instance, std::uint32_t id,
                   const Place& place, BakedMesh& out) {
    for (std::size_t i = 0; i < object.positions.size(); ++i)
        out.positions[place.position + i] =
            baked_position(instance.world_from_object, object.positions[i]);
    const std::size_t count = object.triangles.size();
    const uvec3 first(std::uint32_t(place.position));
    for (std::size_t i = 0; i < whole_runs(count); ++i)
        out.triangles[place.triangle + i] = i < count ? first + object.triangles[i] : first;
    for (std::size_t i = 0; i < count; i += TriangleNames::run)
        out.names.set(place.triangle + i, {id, std::uint32_t(i)});
}

}  // namespace

std::size_t bakeable_triangles(std::span<const TracerObject> objects,
                               std::span<const TracerInstance> instances) {
    constexpr std::size_t few = 1 << 16;
    constexpr std::size_t too_many = 1 << 27;  // for the links of one narrow tree
    std::size_t unique = 0;
    const std::vector<std::size_t> uses = count_uses(objects, instances);
    for (std::size_t i = 0; i < objects.size(); ++i)
        if (uses[i] > 0) unique += objects[i].triangles.size();
    return std::min(std::max(2 * unique, few), too_many);
}

std::vector<std::uint8_t> choose_baked(std::span<const TracerObject> objects,
                                       std::span<const TracerInstance> instances,
                                       std::size_t most) {
    const std::vector<std::size_t> uses = count_uses(objects, instances);
    std::vector<std::uint32_t> order(objects.size());
    std::iota(order.begin(), order.end(), 0u);
    std::ranges::stable_sort(order, {}, [&](std::uint32_t i) {
        return std::pair(uses[i] > 1, objects[i].triangles.size());
    });
    std::vector<std::uint8_t> is_static(objects.size());
    std::size_t total = 0;
    for (const std::uint32_t i : order) {
        const std::size_t triangles = uses[i] * whole_runs(objects[i].triangles.size());
        if (objects[i].deforms || total + triangles > most) continue;
        total += triangles;
        is_static[i] = true;
    }
    std::vector<std::uint8_t> baked(instances.size());
    for (std::size_t i = 0; i < instances.size(); ++i)
        baked[i] = is_static[instances[i].object] && !instances[i].moves &&
                   inverse_affine(instances[i].world_from_object).has_value();
    return baked;
}

BakedMesh bake(std::span<const TracerObject> objects, std::span<const TracerInstance> instances,
               std::span<const std::uint8_t> baked) {
    CHECK_EQ(instances.size(), baked.size());
    std::vector<Place> places(instances.size());
    Place end;
    for (std::size_t i = 0; i < instances.size(); ++i) {
        places[i] = end;
        if (!baked[i]) continue;
        end.position += objects[instances[i].object].positions.size();
        end.triangle += whole_runs(objects[instances[i].object].triangles.size());
    }
    CHECK(end.position < 1ull << 32 && end.triangle < 1ull << 32);
    BakedMesh out;
    out.positions.resize(end.position);
    out.triangles.resize(end.triangle);
    out.names = TriangleNames(end.triangle);
    tbb::parallel_for(std::size_t(0), instances.size(), [&](std::size_t i) {
        if (baked[i])
            bake_instance(objects[instances[i].object], instances[i], std::uint32_t(i), places[i],
                          out);
    });
    return out;
}

}  // namespace tessera
