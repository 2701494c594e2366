#include "worker/tracer.h"

#include "common/check.h"
#include "worker/embree_tracer.h"

namespace tessera {

std::unique_ptr<Tracer> build_tracer(TracerKind, std::vector<TracerObject> objects,
                                     std::vector<TracerInstance> instances, int threads) {
    CHECK(threads > 0);
    for (const TracerInstance& instance : instances) CHECK(instance.object < objects.size());
    return build_embree_tracer(objects, instances, threads);
}

}  // namespace tessera
