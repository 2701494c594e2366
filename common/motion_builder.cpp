#include "common/motion_builder.h"

namespace tessera {
namespace {

std::int32_t add_track(Motion& motion, const Beat& beat, std::uint32_t components,
                       const std::function<std::vector<float>(float)>& at) {
    Track track{.components = components, .times = {}, .values = {}};
    for (int key = 0; key <= beat.times * beat.keys; ++key) {
        track.times.push_back(float(beat.period * key / beat.keys));
        const std::vector<float> value = at(float(key % beat.keys) / float(beat.keys));
        track.values.insert(track.values.end(), value.begin(), value.end());
    }
    motion.tracks.push_back(std::move(track));
    return std::int32_t(motion.tracks.size()) - 1;
}

}  // namespace

std::int32_t add_translations(Motion& motion, const Beat& beat,
                              const std::function<vec3(float)>& at) {
    return add_track(motion, beat, 3, [&](float part) {
        const vec3 v = at(part);
        return std::vector<float>{v.x, v.y, v.z};
    });
}

std::int32_t add_rotations(Motion& motion, const Beat& beat,
                           const std::function<glm::quat(float)>& at) {
    return add_track(motion, beat, 4, [&](float part) {
        const glm::quat q = at(part);
        return std::vector<float>{q.x, q.y, q.z, q.w};
    });
}

std::int32_t add_weights(Motion& motion, const Beat& beat,
                         const std::function<std::vector<float>(float)>& at) {
    return add_track(motion, beat, std::uint32_t(at(0).size()), at);
}

std::uint32_t add_node(Motion& motion, MotionNode node) {
    motion.nodes.push_back(std::move(node));
    return std::uint32_t(motion.nodes.size() - 1);
}

void carry(SceneBundle& bundle, std::uint32_t instance, std::uint32_t node) {
    const Instance& carried = bundle.scene.instances[instance];
    bundle.motion.instances.push_back({carried.name, node, glm::dmat4(carried.world_from_object)});
}

}  // namespace tessera
