// Rays that share an origin, ours against Embree's best call in one run, one thread:
//   bench_packets [--rounds N] [SCENE...]      (default: office)
// Shadow rays go from 16 VPLs to the points that the 16x16 tiles of a 1024x1024 view see, those
// left out that face away; primary rays to the same tiles. Every eighth tile is traced. Scenes are
// flattened into one object. Embree's scene is of HIGH quality, with and without ROBUST; its rays
// are set up with SIMD and marked coherent, denormals flushed as its manual advises. Printed are
// the best rounds, by the thread's CPU time: others share the machine.
#include <embree3/rtcore.h>
#include <xmmintrin.h>

#include <cstdio>
#include <cstring>
#include <ctime>
#include <memory>
#include <random>
#include <string>

#include "common/check.h"
#include "common/mesh.h"
#include "common/scene_io.h"
#include "worker/ray_offset.h"
#include "worker/tracer.h"

namespace tessera {
namespace {

constexpr int width = 1024, tile = 16, tile_rays = tile * tile, vpl_count = 16;

/// The scene as it is, in two levels.
std::unique_ptr<Tracer> instanced(const SceneBundle& bundle, std::vector<Mesh>& meshes) {
    for (const Object& object : bundle.scene.objects)
        meshes.push_back(decode_mesh(*bundle.blobs.find(bundle.scene.meshes[object.mesh])));
    std::vector<TracerObject> objects;
    for (const Mesh& mesh : meshes) objects.push_back({mesh.positions, mesh.triangles});
    std::vector<TracerInstance> instances;
    for (const Instance& instance : bundle.scene.instances)
        instances.push_back({instance.object, instance.world_from_object});
    return build_tracer(TracerKind::kdtree, objects, instances, 1);
}

Mesh flattened(const SceneBundle& bundle) {
    Mesh out;
    for (const Instance& instance : bundle.scene.instances) {
        const Object& object = bundle.scene.objects[instance.object];
        const Mesh mesh = decode_mesh(*bundle.blobs.find(bundle.scene.meshes[object.mesh]));
        const auto first = std::uint32_t(out.positions.size());
        for (const vec3& p : mesh.positions)
            out.positions.push_back(vec3(instance.world_from_object * vec4(p, 1)));
        for (const uvec3& t : mesh.triangles) out.triangles.push_back(first + t);
    }
    return out;
}

/// Rays of one origin: a tile's to one VPL, or its primary rays.
struct Packet {
    vec3 origin;
    std::vector<vec3> targets;                                   ///< or directions
    alignas(64) float x[tile_rays], y[tile_rays], z[tile_rays];  ///< the same again

    void finish() {
        for (std::size_t i = 0; i < targets.size(); ++i)
            x[i] = targets[i].x, y[i] = targets[i].y, z[i] = targets[i].z;
    }
};

struct Work {
    std::vector<Packet> shadow, primary;
    std::size_t shadow_rays = 0, primary_rays = 0;
};

struct Point {
    vec3 p{0}, n{0};
    bool valid = false;
};

Point point_of(const Mesh& mesh, const Tracer& tracer, const Ray& ray) {
    const Hit hit = tracer.closest_hit(ray);
    if (!hit.valid()) return {};
    const uvec3& t = mesh.triangles[hit.triangle];
    vec3 n = normalize(cross(mesh.positions[t.y] - mesh.positions[t.x],
                             mesh.positions[t.z] - mesh.positions[t.x]));
    if (dot(n, ray.dir) > 0) n = -n;
    const float scale = std::max(magnitude(tracer.bounds().lo), magnitude(tracer.bounds().hi));
    return {offset_point(ray.org + hit.t * ray.dir, n, n, scale), n, true};
}

std::vector<Point> make_vpls(const Mesh& mesh, const Tracer& tracer, const Camera& camera) {
    std::mt19937 random(1);
    std::uniform_real_distribution<float> uniform(-1, 1);
    const auto direction = [&] {
        const float z = uniform(random), phi = pi * uniform(random);
        const float r = std::sqrt(1 - z * z);
        return vec3(r * std::cos(phi), r * std::sin(phi), z);
    };
    std::vector<Point> vpls;
    while (vpls.size() < vpl_count) {
        const Point first = point_of(mesh, tracer, {camera.eye, 0, direction(), infinity});
        if (!first.valid) continue;
        vec3 dir = direction();
        if (dot(dir, first.n) < 0) dir = -dir;
        const Point second = point_of(mesh, tracer, {first.p, 0, dir, infinity});
        if (second.valid) vpls.push_back(second);
    }
    return vpls;
}

Work make_work(const Mesh& mesh, const Tracer& tracer, const Camera& camera) {
    const vec3 forward = normalize(camera.at - camera.eye);
    const float half = std::tan(glm::radians(camera.fov_y) / 2);
    const vec3 right = half * normalize(cross(forward, camera.up));
    const vec3 up = cross(right, forward);
    const std::vector<Point> vpls = make_vpls(mesh, tracer, camera);
    Work work;
    for (int t = 0; t < width / tile * (width / tile); t += 8) {
        Packet primary;
        primary.origin = camera.eye;
        std::vector<Point> points;
        for (int i = 0; i < tile_rays; ++i) {
            // 4x4 pixels after 4x4 pixels.
            const int x = t % (width / tile) * tile + i / 16 % 4 * 4 + i % 4;
            const int y = t / (width / tile) * tile + i / 64 * 4 + i % 16 / 4;
            const auto ndc = [](int p) { return (float(p) + 0.5f) * 2 / width - 1; };
            const vec3 dir = forward + ndc(x) * right - ndc(y) * up;
            primary.targets.push_back(dir);
            const Point point = point_of(mesh, tracer, {camera.eye, 0, dir, infinity});
            if (point.valid) points.push_back(point);
        }
        primary.finish();
        work.primary_rays += primary.targets.size();
        work.primary.push_back(primary);
        for (const Point& vpl : vpls) {
            Packet shadow;
            shadow.origin = vpl.p;
            for (const Point& point : points)
                if (dot(vpl.p - point.p, point.n) > 0 && dot(point.p - vpl.p, vpl.n) > 0)
                    shadow.targets.push_back(point.p);
            shadow.finish();
            work.shadow_rays += shadow.targets.size();
            if (!shadow.targets.empty()) work.shadow.push_back(shadow);
        }
    }
    return work;
}

/// One Embree scene and its ways to trace.
class Embree {
public:
    Embree(const Mesh& mesh, bool robust) {
        device_ = rtcNewDevice("threads=1");
        scene_ = rtcNewScene(device_);
        rtcSetSceneBuildQuality(scene_, RTC_BUILD_QUALITY_HIGH);
        if (robust) rtcSetSceneFlags(scene_, RTC_SCENE_FLAG_ROBUST);
        const RTCGeometry geometry = rtcNewGeometry(device_, RTC_GEOMETRY_TYPE_TRIANGLE);
        std::memcpy(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                                            12, mesh.positions.size()),
                    mesh.positions.data(), mesh.positions.size() * 12);
        std::memcpy(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                                            12, mesh.triangles.size()),
                    mesh.triangles.data(), mesh.triangles.size() * 12);
        rtcCommitGeometry(geometry);
        rtcAttachGeometry(scene_, geometry);
        rtcReleaseGeometry(geometry);
        rtcCommitScene(scene_);
    }
    ~Embree() {
        rtcReleaseScene(scene_);
        rtcReleaseDevice(device_);
    }
    Embree(const Embree&) = delete;

    void occluded1(const Packet& p, std::uint8_t* out) const {
        RTCIntersectContext context = coherent();
        for (std::size_t i = 0; i < p.targets.size(); ++i) {
            const vec3 d = p.targets[i] - p.origin;
            RTCRay ray{p.origin.x, p.origin.y, p.origin.z, 0, d.x, d.y, d.z, 0, 1, ~0u, 0, 0};
            rtcOccluded1(scene_, &context, &ray);
            out[i] = ray.tfar < 0;
        }
    }

    __attribute__((target("avx512f"))) void occluded16(const Packet& p, std::uint8_t* out) const {
        RTCIntersectContext context = coherent();
        alignas(64) int valid[16];
        RTCRay16 rays;
        for (std::size_t first = 0; first < p.targets.size(); first += 16) {
            fill(rays, p, first, p.origin, 1);
            const int left = int(p.targets.size() - first);
            for (int i = 0; i < 16; ++i) valid[i] = i < left ? -1 : 0;
            rtcOccluded16(valid, scene_, &context, &rays);
            for (int i = 0; i < std::min(left, 16); ++i)
                out[first + std::size_t(i)] = rays.tfar[i] < 0;
        }
    }

    __attribute__((target("avx512f"))) void occluded_stream(const Packet& p,
                                                            std::uint8_t* out) const {
        RTCIntersectContext context = coherent();
        // The stream's arrays are whole.
        alignas(64) static float f[12][tile_rays];
        const std::size_t n = p.targets.size();
        for (std::size_t i = 0; i < n; ++i) {
            f[0][i] = p.origin.x, f[1][i] = p.origin.y, f[2][i] = p.origin.z, f[3][i] = 0;
            f[4][i] = p.x[i] - p.origin.x, f[5][i] = p.y[i] - p.origin.y;
            f[6][i] = p.z[i] - p.origin.z, f[7][i] = 0, f[8][i] = 1;
            reinterpret_cast<unsigned*>(f[9])[i] = ~0u;
            f[10][i] = f[11][i] = 0;
        }
        const auto u = [&](int k) { return reinterpret_cast<unsigned*>(f[k]); };
        const RTCRayNp soa{f[0], f[1], f[2], f[3], f[4],  f[5],
                           f[6], f[7], f[8], u(9), u(10), u(11)};
        rtcOccludedNp(scene_, &context, &soa, unsigned(n));
        for (std::size_t i = 0; i < n; ++i) out[i] = f[8][i] < 0;
    }

    __attribute__((target("avx512f"))) void intersect16(const Packet& p, Hit* out) const {
        RTCIntersectContext context = coherent();
        alignas(64) int valid[16];
        RTCRayHit16 query;
        for (std::size_t first = 0; first < p.targets.size(); first += 16) {
            fill(query.ray, p, first, vec3(0), infinity);
            for (int i = 0; i < 16; ++i) {
                query.ray.org_x[i] = p.origin.x, query.ray.org_y[i] = p.origin.y;
                query.ray.org_z[i] = p.origin.z;
                valid[i] = -1;
                query.hit.geomID[i] = query.hit.instID[0][i] = RTC_INVALID_GEOMETRY_ID;
            }
            rtcIntersect16(valid, scene_, &context, &query);
            for (int i = 0; i < 16; ++i) {
                Hit& hit = out[first + std::size_t(i)];
                hit = {query.ray.tfar[i], query.hit.u[i], query.hit.v[i], query.hit.geomID[i],
                       query.hit.primID[i]};
            }
        }
    }

private:
    static RTCIntersectContext coherent() {
        RTCIntersectContext context;
        rtcInitIntersectContext(&context);
        context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
        return context;
    }

    /// Directions are p's points less `from`.
    __attribute__((target("avx512f"))) static void fill(RTCRay16& rays, const Packet& p,
                                                        std::size_t first, const vec3& from,
                                                        float tfar) {
        for (std::size_t i = 0; i < 16; ++i) {
            rays.org_x[i] = p.origin.x, rays.org_y[i] = p.origin.y, rays.org_z[i] = p.origin.z;
            rays.dir_x[i] = p.x[first + i] - from.x, rays.dir_y[i] = p.y[first + i] - from.y;
            rays.dir_z[i] = p.z[first + i] - from.z;
            rays.tnear[i] = 0, rays.tfar[i] = tfar, rays.time[i] = 0, rays.mask[i] = ~0u;
            rays.id[i] = rays.flags[i] = 0;
        }
    }

    RTCDevice device_;
    RTCScene scene_;
};

double cpu_seconds() {
    timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return double(t.tv_sec) + 1e-9 * double(t.tv_nsec);
}

/// Mray/s of the best round of `run(packet, out)` over all packets; `results` holds the last
/// round's.
template <class Result, class Run>
double rate(const std::vector<Packet>& packets, std::size_t rays, int rounds,
            std::vector<Result>& results, Run&& run) {
    results.resize(rays + tile_rays);
    std::vector<double> rates;
    for (int round = 0; round < rounds; ++round) {
        const double start = cpu_seconds();
        std::size_t at = 0;
        for (const Packet& p : packets) {
            run(p, &results[at]);
            at += p.targets.size();
        }
        rates.push_back(double(rays) / (cpu_seconds() - start) * 1e-6);
    }
    results.resize(rays);
    return *std::ranges::max_element(rates);
}

template <class Run>
auto with_flush_to_zero(Run&& run) {
    const unsigned mode = _mm_getcsr();
    _mm_setcsr(mode | 0x8040);
    const auto result = run();
    _mm_setcsr(mode);
    return result;
}

void bench(const std::string& name, int rounds) {
    const SceneBundle bundle = load_scene(name).bundle;
    const Mesh mesh = flattened(bundle);
    const auto tracer =
        build_tracer(TracerKind::kdtree, {{mesh.positions, mesh.triangles}}, {{0, mat4(1)}}, 1);
    Camera camera;
    if (!bundle.scene.cameras.empty()) {
        camera = bundle.scene.cameras[0];
    } else {
        const Box bounds = tracer->bounds();
        camera.eye = bounds.lo + bounds.extent() * vec3(0.3f, 0.45f, 0.55f);
        camera.at = bounds.centre();
        camera.fov_y = 90;
    }
    const Work work = make_work(mesh, *tracer, camera);

    std::vector<std::uint8_t> ours_blocked, singles, blocked;
    std::vector<Hit> ours_hits, hits;
    // One cache for each VPL, as a renderer has.
    std::vector<std::pair<vec3, OccluderCache>> caches;
    const auto cache_of = [&](const vec3& origin) {
        for (auto& [place, cache] : caches)
            if (place == origin) return &cache;
        return &caches.emplace_back(origin, OccluderCache{}).second;
    };
    caches.reserve(vpl_count);
    const double shadow = rate(
        work.shadow, work.shadow_rays, rounds, ours_blocked,
        [&](const Packet& p, std::uint8_t* out) {
            tracer->occluded_from(p.origin, p.targets, {out, p.targets.size()}, cache_of(p.origin));
        });
    rate(work.shadow, work.shadow_rays, 1, singles, [&](const Packet& p, std::uint8_t* out) {
        for (std::size_t i = 0; i < p.targets.size(); ++i)
            out[i] = tracer->occluded({p.origin, 0, p.targets[i] - p.origin, 1});
    });
    std::vector<Mesh> meshes;
    const auto two_levels = instanced(bundle, meshes);
    const double shadow_two_levels = rate(
        work.shadow, work.shadow_rays, rounds, blocked, [&](const Packet& p, std::uint8_t* out) {
            two_levels->occluded_from(p.origin, p.targets, {out, p.targets.size()}, nullptr);
        });
    const double primary =
        rate(work.primary, work.primary_rays, rounds, ours_hits, [&](const Packet& p, Hit* out) {
            tracer->closest_from(p.origin, p.targets, {out, p.targets.size()});
        });
    const auto differ = [](const auto& a, const auto& b, auto&& equal) {
        std::size_t count = 0;
        for (std::size_t i = 0; i < a.size(); ++i) count += !equal(a[i], b[i]);
        return count;
    };
    std::printf("%s: %zu triangles, %zu shadow rays (%zu blocked), %zu differ from single rays\n",
                name.c_str(), mesh.triangles.size(), work.shadow_rays,
                std::size_t(std::count(singles.begin(), singles.end(), 1)),
                differ(ours_blocked, singles, std::equal_to()));
    std::printf("  ours shadow %.1f, in two levels %.1f, primary %.1f Mray/s\n", shadow,
                shadow_two_levels, primary);
    for (const bool robust : {false}) {
        const Embree embree(mesh, robust);
        double best = 0;
        const auto run = [&](const char* what, auto&& call) {
            const double r = with_flush_to_zero([&] {
                return rate(work.shadow, work.shadow_rays, rounds, blocked,
                            [&](const Packet& p, std::uint8_t* out) { call(p, out); });
            });
            best = std::max(best, r);
            std::printf(" %s %.1f", what, r);
        };
        std::printf("  Embree%s shadow:", robust ? " ROBUST" : "");
        run("16", [&](auto&... a) { embree.occluded16(a...); });
        run("stream", [&](auto&... a) { embree.occluded_stream(a...); });
        run("1", [&](auto&... a) { embree.occluded1(a...); });
        const std::size_t wrong = differ(blocked, ours_blocked, std::equal_to());
        const double r16 = with_flush_to_zero([&] {
            return rate(work.primary, work.primary_rays, rounds, hits,
                        [&](const Packet& p, Hit* out) { embree.intersect16(p, out); });
        });
        const std::size_t wrong_hits = differ(hits, ours_hits, [](const Hit& a, const Hit& b) {
            return a.valid() == b.valid() && (!a.valid() || std::abs(a.t - b.t) <= 1e-4f * b.t);
        });
        std::printf("  primary: 16 %.1f | ratio shadow %.2f primary %.2f, mismatches %zu and %zu\n",
                    r16, shadow / best, primary / r16, wrong, wrong_hits);
    }
}

}  // namespace
}  // namespace tessera

int main(int argc, char** argv) {
    std::vector<std::string> scenes;
    int rounds = 5;
    for (int i = 1; i < argc; ++i) {
        if (std::strcmp(argv[i], "--rounds") == 0 && i + 1 < argc)
            rounds = std::atoi(argv[++i]);
        else
            scenes.push_back(argv[i]);
    }
    if (scenes.empty()) scenes = {"office"};
    try {
        for (const std::string& scene : scenes) tessera::bench(scene, std::max(rounds, 1));
    } catch (const tessera::UserError& error) {
        std::fprintf(stderr, "%s\n", error.what());
        return 1;
    }
}
