#include "worker/tracer.h"

#include "common/check.h"
#include "worker/embree_tracer.h"
#include "worker/kdtree_tracer.h"

namespace tessera {

std::unique_ptr<Tracer> build_tracer(TracerKind kind, std::vector<TracerObject> objects,
                                     std::vector<TracerInstance> instances, int threads) {
    CHECK(threads > 0);
    for (const TracerInstance& instance : instances) CHECK(instance.object < objects.size());
    switch (kind) {
        case TracerKind::kdtree:
            return build_kdtree_tracer(objects, instances, threads);
        case TracerKind::embree:
            return build_embree_tracer(objects, instances, threads);
    }
    CHECK(!"a tracer kind");
    return nullptr;
}

}  // namespace tessera
