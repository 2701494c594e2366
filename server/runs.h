// How the passes of a frame are cut into runs: what one task traces of its tile. Scheduler and
// assembler count in runs; the last run of a frame may be shorter.
#pragma once

#include <algorithm>
#include <optional>

#include "common/tile.h"

namespace tessera {

inline std::uint32_t run_count(const RenderSettings& s) {
    return (s.passes + passes_per_task(s) - 1) / passes_per_task(s);
}

inline std::uint32_t passes_of_run(const RenderSettings& s, std::uint32_t run) {
    return std::min(passes_per_task(s), s.passes - run * passes_per_task(s));
}

inline TileTask task_of(const FrameSpec& spec, std::uint32_t run, std::uint32_t tile,
                        std::uint32_t part = 0) {
    return {.frame = spec.frame,
            .tile = tile,
            .first_pass = run * passes_per_task(spec.settings),
            .pass_count = passes_of_run(spec.settings, run),
            .part = part};
}

/// The run that `task` belongs to; nothing when the frame has no such task.
inline std::optional<std::uint32_t> run_of(const FrameSpec& spec, const TileTask& task) {
    const std::uint32_t run = task.first_pass / passes_per_task(spec.settings);
    if (run >= run_count(spec.settings) || task.tile >= tile_count(spec.size)) return std::nullopt;
    if (task.part > (can_be_cut(spec.size, task.tile) ? quarters : 0)) return std::nullopt;
    if (task != task_of(spec, run, task.tile, task.part)) return std::nullopt;
    return run;
}

}  // namespace tessera
