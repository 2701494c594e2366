#include "worker/bench/trace_bench.h"

#include <fmt/format.h>

#include <nlohmann/json.hpp>
#include <optional>

#include "common/check.h"
#include "worker/bench/bench_scene.h"
#include "worker/bench/embree_query.h"
#include "worker/bench/judge.h"
#include "worker/bench/measure.h"
#include "worker/ray_offset.h"

namespace tessera {
namespace {

constexpr int tile_side = 16;
constexpr int tile_pixels = tile_side * tile_side;

/// What a ray of the view meets.
struct SurfacePoint {
    vec3 p{0};
    vec3 ng{0};  ///< unit, towards where the ray came from; zero when it met nothing

    bool valid() const { return ng != vec3(0); }
};

struct RayKind {
    const char* name;
    RayUse use;
    EmbreeCall plain;  ///< Embree's call for such rays, as its users know it
    /// Blocks are long enough to warm the caches up, and short enough to take turns.
    int tiles_per_block;
};

enum KindIndex { primary, vpl_shadow, bounce, bounce_occlusion };
constexpr RayKind kinds[] = {
    {"primary", {.occlusion = false, .coherent = true}, EmbreeCall::packets16, 64},
    {"vpl_shadow", {.occlusion = true, .coherent = true}, EmbreeCall::packets16, 16},
    {"bounce", {.occlusion = false, .coherent = false}, EmbreeCall::single, 64},
    {"bounce_occlusion", {.occlusion = true, .coherent = false}, EmbreeCall::single, 64},
};

/// What our packets take of a group of shadow rays.
struct ShadowGroup {
    std::size_t tile = 0;  ///< of the block
    std::uint32_t emitter = 0;
    RayMask wanted{};  ///< the group's rays in their order
};

/// Rays that are traced in one turn.
struct Block {
    std::vector<Ray> rays;
    std::vector<RayGroup> groups;
    std::vector<ShadowGroup> shadow_groups;      ///< of vpl_shadow, for each group
    std::vector<std::vector<vec3>> tile_points;  ///< of vpl_shadow, for each tile
    std::vector<vec3> dirs;                      ///< of primary, for each ray

    void begin_group() { groups.push_back({std::uint32_t(rays.size()), 0}); }
    void add(const Ray& ray) {
        rays.push_back(ray);
        ++groups.back().count;
    }
};

struct Answers {
    std::vector<Hit> hits;
    std::vector<std::uint8_t> blocked;

    void resize(std::size_t count) {
        hits.resize(count);
        blocked.resize(count);
    }
};

/// Seconds of each repetition: ours, Embree's best call's and its plain one's.
struct Times {
    std::vector<double> ours, embree, plain;
};

struct Mismatches {
    std::uint64_t rays = 0;
    std::uint64_t judged = 0;      ///< brute force takes its time: the first few only
    std::uint64_t ours_wrong = 0;  ///< of the judged
    std::uint64_t embree_wrong = 0;
};
constexpr std::uint64_t judged_at_most = 50;

BenchScene load(const std::string& name, const TraceBenchConfig& config) {
    BenchScene scene = load_bench_scene(name);
    if (config.flatten) scene.geometry = flattened(scene.geometry);
    return scene;
}

/// One scene seen from its camera, and all rays that follow from it.
class TraceBench {
public:
    TraceBench(const std::string& scene, const TraceBenchConfig& config)
        : config_(config),
          scene_(load(scene, config)),
          ours_(scene_.build_ours(1, config.builder)),
          embree_(scene_.build_embree(1)),
          caches_(std::size_t(config.vpls)) {
        const Box bounds = ours_->bounds();
        scale_ = std::max(magnitude(bounds.lo), magnitude(bounds.hi));
        diagonal_ = length(bounds.extent());
        see();
        place_emitters();
    }

    nlohmann::json run(KindIndex kind);

private:
    int tiles() const { return config_.view * config_.view / tile_pixels; }

    void see();
    void place_emitters();
    SurfacePoint surface_point(const Ray& ray, const Hit& hit) const;
    vec3 tile_dir(int tile, int pixel) const;
    std::vector<vec3> shadow_ends(int tile) const;
    Ray bounce_ray(const SurfacePoint& from, Random& random) const;

    Block make_block(KindIndex kind, int first_tile) const;
    void add_tile(Block& block, KindIndex kind, int tile) const;
    void add_shadow_rays(Block& block, std::uint32_t emitter, int tile) const;

    double time_ours(KindIndex kind, const Block& block, Answers& answers);
    double time_shadows(const Block& block, Answers& answers);
    double time_embree(EmbreeQuery& query, const Block& block);
    RayUse embree_use(KindIndex kind) const;
    EmbreeCall best_call(KindIndex kind);
    void compare(KindIndex kind, const Block& block, const Answers& ours, const EmbreeQuery& embree,
                 Mismatches& mismatches) const;

    TraceBenchConfig config_;
    BenchScene scene_;
    std::unique_ptr<Tracer> ours_;
    std::unique_ptr<EmbreeScene> embree_;
    float scale_ = 1, diagonal_ = 1;
    std::vector<SurfacePoint> points_;  ///< of every pixel, tile by tile
    std::vector<SurfacePoint> emitters_;
    std::vector<OccluderCache> caches_;  ///< of every emitter
};

/// Pixels of a tile go by blocks of 4 x 4, which lie close together.
vec3 TraceBench::tile_dir(int tile, int pixel) const {
    const int tiles_across = config_.view / tile_side;
    const int block = pixel / 16, k = pixel % 16;
    const int x = tile % tiles_across * tile_side + block % 4 * 4 + k % 4;
    const int y = tile / tiles_across * tile_side + block / 4 * 4 + k / 4;
    return view_dir(scene_.camera, config_.view, x, y);
}

SurfacePoint TraceBench::surface_point(const Ray& ray, const Hit& hit) const {
    if (!hit.valid()) return {};
    const TracerInstance& instance = scene_.geometry.instances[hit.instance];
    const Mesh& mesh = scene_.geometry.meshes[instance.object];
    const auto corner = [&](int k) {
        const vec3& p = mesh.positions[mesh.triangles[hit.triangle][k]];
        return vec3(instance.world_from_object * vec4(p, 1));
    };
    const vec3 ng = normalize(cross(corner(1) - corner(0), corner(2) - corner(0)));
    return {ray.org + hit.t * ray.dir, dot(ng, ray.dir) > 0 ? -ng : ng};
}

/// Finds what the view sees.
void TraceBench::see() {
    std::vector<vec3> dirs(tile_pixels);
    std::vector<Hit> hits(tile_pixels);
    const vec3 eye = scene_.camera.eye;
    for (int tile = 0; tile < tiles(); ++tile) {
        for (int i = 0; i < tile_pixels; ++i) dirs[i] = tile_dir(tile, i);
        ours_->closest_from(eye, dirs, hits);
        for (int i = 0; i < tile_pixels; ++i)
            points_.push_back(surface_point({eye, 0, dirs[i], infinity}, hits[i]));
    }
    if (std::ranges::none_of(points_, &SurfacePoint::valid))
        throw UserError(fmt::format("{}: the camera sees nothing; bench trace needs a view",
                                    scene_.geometry.name));
}

/// A VPL lies where a diffuse walk of two steps from a visible point arrives: on surfaces that see
/// the scene, near and far, as a light's own walks leave them.
void TraceBench::place_emitters() {
    Random random(1);
    while (emitters_.size() < std::size_t(config_.vpls)) {
        SurfacePoint point = points_[random() % points_.size()];
        for (int step = 0; step < 2 && point.valid(); ++step) {
            const Ray ray = bounce_ray(point, random);
            const SurfacePoint next = surface_point(ray, ours_->closest_hit(ray));
            if (next.valid()) point = next;  // a walk that leaves the scene ends before
        }
        if (!point.valid()) continue;
        point.p = offset_point(point.p, point.ng, point.ng, scale_);
        emitters_.push_back(point);
    }
}

/// Cosine-distributed around the normal.
Ray TraceBench::bounce_ray(const SurfacePoint& from, Random& random) const {
    const float r2 = uniform(random, 0, 1), phi = uniform(random, 0, 2 * pi);
    const float r = std::sqrt(r2);
    const vec3 local(r * std::cos(phi), r * std::sin(phi), std::sqrt(1 - r2));
    return {offset_point(from.p, from.ng, from.ng, scale_), 0,
            Frame(from.ng).world_from_local(local), infinity};
}

/// To the points of the tile, the block's latest, that face the VPL and that it faces.
void TraceBench::add_shadow_rays(Block& block, std::uint32_t emitter, int tile) const {
    const SurfacePoint& vpl = emitters_[emitter];
    block.begin_group();
    ShadowGroup group{block.tile_points.size() - 1, emitter, {}};
    for (int i = 0; i < tile_pixels; ++i) {
        const SurfacePoint& point = points_[std::size_t(tile) * tile_pixels + std::size_t(i)];
        const vec3 dir = block.tile_points.back()[std::size_t(i)] - vpl.p;
        if (!point.valid() || !(dot(dir, vpl.ng) > 0 && dot(dir, point.ng) < 0)) continue;
        block.add({vpl.p, 0, dir, 1});
        set(group.wanted, std::size_t(i));
    }
    block.shadow_groups.push_back(group);
}

/// Where shadow rays to the tile's points end; NaN where there are none.
std::vector<vec3> TraceBench::shadow_ends(int tile) const {
    std::vector<vec3> ends;
    for (int i = 0; i < tile_pixels; ++i) {
        const SurfacePoint& point = points_[std::size_t(tile) * tile_pixels + std::size_t(i)];
        ends.push_back(point.valid() ? offset_point(point.p, point.ng, point.ng, scale_)
                                     : vec3(std::numeric_limits<float>::quiet_NaN()));
    }
    return ends;
}

void TraceBench::add_tile(Block& block, KindIndex kind, int tile) const {
    if (kind == vpl_shadow) {
        block.tile_points.push_back(shadow_ends(tile));
        for (std::uint32_t i = 0; i < emitters_.size(); ++i) add_shadow_rays(block, i, tile);
        return;
    }
    block.begin_group();
    Random random{std::uint32_t(tile)};
    for (int i = 0; i < tile_pixels; ++i) {
        if (kind == primary) {
            block.dirs.push_back(tile_dir(tile, i));
            block.add({scene_.camera.eye, 0, block.dirs.back(), infinity});
            continue;
        }
        const SurfacePoint& point = points_[std::size_t(tile) * tile_pixels + std::size_t(i)];
        if (!point.valid()) continue;
        Ray ray = bounce_ray(point, random);
        if (kind == bounce_occlusion) ray.tmax = diagonal_ / 3;
        block.add(ray);
    }
}

Block TraceBench::make_block(KindIndex kind, int first_tile) const {
    Block block;
    const int end = std::min(tiles(), first_tile + kinds[kind].tiles_per_block);
    for (int tile = first_tile; tile < end; ++tile) add_tile(block, kind, tile);
    return block;
}

double TraceBench::time_ours(KindIndex kind, const Block& block, Answers& answers) {
    if (kind == vpl_shadow) return time_shadows(block, answers);
    const std::span<Hit> hits(answers.hits);
    const std::span<std::uint8_t> blocked(answers.blocked);
    const double start = thread_seconds();
    for (const auto& [first, count] : block.groups) {
        if (kind == primary)
            ours_->closest_from(scene_.camera.eye, std::span(block.dirs).subspan(first, count),
                                hits.subspan(first, count));
        else if (kind == bounce)
            ours_->closest_hits(std::span(block.rays).subspan(first, count),
                                hits.subspan(first, count));
        else
            ours_->occluded(std::span(block.rays).subspan(first, count),
                            blocked.subspan(first, count));
    }
    return thread_seconds() - start;
}

double TraceBench::time_shadows(const Block& block, Answers& answers) {
    std::vector<RayMask> masks(block.groups.size());
    const double start = thread_seconds();
    std::optional<Targets> targets;
    for (std::size_t g = 0; g < block.groups.size(); ++g) {
        const auto& [tile, emitter, wanted] = block.shadow_groups[g];
        if (emitter == 0) targets.emplace(block.tile_points[tile]);
        masks[g] = ours_->occluded_from(emitters_[emitter].p, *targets, wanted, &caches_[emitter]);
    }
    const double seconds = thread_seconds() - start;
    auto flag = answers.blocked.begin();
    for (std::size_t g = 0; g < block.groups.size(); ++g)
        for (std::size_t i = 0; i < tile_pixels; ++i)
            if (has(block.shadow_groups[g].wanted, i)) *flag++ = has(masks[g], i);
    return seconds;
}

/// Embree's structures are filled outside the measured time; ours starts from points.
double TraceBench::time_embree(EmbreeQuery& query, const Block& block) {
    query.load(block.rays, block.groups);
    const double start = thread_seconds();
    query.run(embree_->root());
    return thread_seconds() - start;
}

/// Embree 3.13.5 runs for ever on some coherent packets of shadow rays through instances (seen in
/// the Cornell box): there it is not told that they are coherent. Elsewhere, told so, it misses
/// some that go through the middle of a triangle (in `building`).
RayUse TraceBench::embree_use(KindIndex kind) const {
    RayUse use = kinds[kind].use;
    if (config_.incoherent || (use.occlusion && !embree_->is_single())) use.coherent = false;
    return use;
}

/// Tries each of Embree's calls on a part of the rays.
EmbreeCall TraceBench::best_call(KindIndex kind) {
    double seconds[std::size(embree_calls)] = {};
    const int step = std::max(1, tiles() / kinds[kind].tiles_per_block / 16);
    for (int block_index = 0; block_index * kinds[kind].tiles_per_block < tiles();
         block_index += step) {
        const Block block = make_block(kind, block_index * kinds[kind].tiles_per_block);
        for (const EmbreeCall call : embree_calls) {
            EmbreeQuery query(call, embree_use(kind));
            // Twice, so that none pays for the others' cold caches.
            time_embree(query, block);
            seconds[int(call)] += time_embree(query, block);
        }
    }
    return embree_calls[std::ranges::min_element(seconds) - std::begin(seconds)];
}

void TraceBench::compare(KindIndex kind, const Block& block, const Answers& ours,
                         const EmbreeQuery& embree, Mismatches& mismatches) const {
    const bool occlusion = kinds[kind].use.occlusion;
    for (std::size_t i = 0; i < block.rays.size(); ++i) {
        const EmbreeQuery::Answer theirs = embree.answer(i);
        const Hit& hit = ours.hits[i];
        const bool is_hit = occlusion ? ours.blocked[i] != 0 : hit.valid();
        const bool same_t =
            occlusion || !is_hit || std::abs(hit.t - theirs.t) <= 1e-4f * hit.t + 1e-6f * diagonal_;
        if (is_hit == theirs.hit && same_t) continue;
        ++mismatches.rays;
        if (mismatches.judged == judged_at_most) continue;
        ++mismatches.judged;
        const Verdict verdict = judge(scene_.geometry, block.rays[i]);
        const auto wrong = [&](bool is_blocked, float t) {
            if (occlusion) return !verdict.allows(is_blocked);
            return !verdict.allows({.t = t, .instance = is_blocked ? 0 : no_instance});
        };
        mismatches.ours_wrong += wrong(is_hit, hit.t);
        mismatches.embree_wrong += wrong(theirs.hit, theirs.t);
    }
}

nlohmann::json TraceBench::run(KindIndex kind) {
    const RayKind& of_kind = kinds[kind];
    const EmbreeCall call = best_call(kind);
    EmbreeQuery query(call, embree_use(kind)), plain_query(of_kind.plain, embree_use(kind));
    Answers answers;
    Times times;
    Mismatches mismatches;
    std::uint64_t rays = 0;
    for (int repetition = 0; repetition < config_.repetitions; ++repetition) {
        double ours = 0, embree = 0, plain = 0;
        for (int tile = 0; tile < tiles(); tile += of_kind.tiles_per_block) {
            const Block block = make_block(kind, tile);
            answers.resize(block.rays.size());
            // Who comes second finds the caches warm with the other's data: take turns in that too.
            if (repetition % 2 == 0) ours += time_ours(kind, block, answers);
            embree += time_embree(query, block);
            plain += time_embree(plain_query, block);
            if (repetition % 2 == 1) ours += time_ours(kind, block, answers);
            if (repetition > 0) continue;
            compare(kind, block, answers, query, mismatches);
            rays += block.rays.size();
        }
        times.ours.push_back(ours);
        times.embree.push_back(embree);
        times.plain.push_back(plain);
    }

    std::vector<double> ratios, plain_ratios;
    for (std::size_t i = 0; i < times.ours.size(); ++i) {
        ratios.push_back(times.embree[i] / times.ours[i]);
        plain_ratios.push_back(times.plain[i] / times.ours[i]);
    }
    const Spread ours = spread_of(times.ours), embree = spread_of(times.embree),
                 ratio = spread_of(ratios);
    const double triangles = std::max(1.0, double(scene_.triangles()));
    return {{"scene", scene_.geometry.name},
            {"triangles", scene_.triangles()},
            {"rays", of_kind.name},
            {"ray_count", rays},
            {"ours_mrays_per_s", 1e-6 * double(rays) / ours.median},
            {"ours_spread", ours.relative()},
            {"embree_mrays_per_s", 1e-6 * double(rays) / embree.median},
            {"embree_spread", embree.relative()},
            {"embree_call", name_of(call, of_kind.use.occlusion)},
            {"ratio", ratio.median},
            {"spread", ratio.relative()},
            {"embree_plain_call", name_of(of_kind.plain, of_kind.use.occlusion)},
            {"ratio_to_plain", spread_of(plain_ratios).median},
            {"mismatches", mismatches.rays},
            {"judged", mismatches.judged},
            {"ours_wrong", mismatches.ours_wrong},
            {"embree_wrong", mismatches.embree_wrong},
            {"bytes_per_triangle", double(ours_->memory_bytes()) / triangles},
            {"embree_bytes_per_triangle", double(embree_->memory_bytes()) / triangles}};
}

void print_row(const nlohmann::json& r) {
    const auto count = [&](const char* field) { return r[field].get<std::uint64_t>(); };
    const auto number = [&](const char* field) { return r[field].get<double>(); };
    fmt::print(
        "{:<14} {:<16} {:>8.2f} {:>8.2f} {:<12} {:>6.2f} {:>5.1f}% {:>6.2f} {:>7} {:>6} {:>6} "
        "{:>6} {:>6.0f} {:>6.0f}\n",
        r["scene"].get<std::string>(), r["rays"].get<std::string>(), number("ours_mrays_per_s"),
        number("embree_mrays_per_s"), r["embree_call"].get<std::string>(), number("ratio"),
        100 * number("spread"), number("ratio_to_plain"), count("mismatches"), count("judged"),
        count("ours_wrong"), count("embree_wrong"), number("bytes_per_triangle"),
        number("embree_bytes_per_triangle"));
    std::fflush(stdout);
}

}  // namespace

std::vector<std::string> ray_kind_names() {
    std::vector<std::string> names;
    for (const RayKind& kind : kinds) names.push_back(kind.name);
    return names;
}

nlohmann::json bench_trace(const std::vector<std::string>& scenes, const TraceBenchConfig& config) {
    CHECK_EQ(config.view % (4 * tile_side), 0);
    fmt::print(
        "One thread, Mrays/s, median of {} runs; ratio with its spread (MAD), to Embree's best\n"
        "call and to its plain one: 16 rays where they have one origin, else single rays. Of the\n"
        "rays whose answers differ the first are judged in double. Bytes are those of a triangle.\n"
        "{:<14} {:<16} {:>8} {:>8} {:<12} {:>6} {:>6} {:>6} {:>7} {:>6} {:>6} {:>6} {:>6} {:>6}\n",
        config.repetitions, "scene", "rays", "ours", "Embree", "its call", "ratio", "+-", "plain",
        "differ", "judged", "wrong", "its", "bytes", "Embree");
    nlohmann::json results = nlohmann::json::array();
    for (const std::string& scene : scenes) {
        TraceBench bench(scene, config);
        for (const KindIndex kind : {primary, vpl_shadow, bounce, bounce_occlusion}) {
            if (!std::ranges::count(config.kinds, kinds[kind].name)) continue;
            results.push_back(bench.run(kind));
            print_row(results.back());
        }
    }
    return results;
}

}  // namespace tessera
