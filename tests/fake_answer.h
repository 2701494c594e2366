// What a worker might answer to a task, made up: depends on nothing but the task.
#pragma once

#include <bit>
#include <random>
#include <vector>

#include "common/tile_codec.h"
#include "server/runs.h"

namespace tessera {

inline TileResult fake_answer(const FrameSpec& spec, const TileTask& task) {
    TileResult result;
    result.task = task;
    result.rays = 10;
    std::mt19937 random(task.tile * 1000 + task.first_pass);
    std::uniform_real_distribution<float> uniform;
    const std::size_t pixels = tile_rect(spec.size, task.tile).pixels();
    for (int c = 0; c < channel_count; ++c) {
        if (!tile_channels(spec).has(Channel(c))) continue;
        for (std::size_t i = 0; i < pixels * std::size_t(floats_per_pixel(Channel(c))); ++i) {
            float value = uniform(random) * float(task.pass_count);
            if (Channel(c) == Channel::normal) value = i % 3 == 2;
            if (Channel(c) == Channel::depth) value = 1;
            if (Channel(c) == Channel::surface) value = std::bit_cast<float>(3u);
            result.data.push_back(value);
        }
    }
    return result;
}

inline Bytes packed(const FrameSpec& spec, const TileResult& result) {
    return pack_tile(tile_channels(spec), tile_rect(spec.size, result.task.tile).pixels(),
                     result.data);
}

/// All tasks of a frame, pass by pass.
inline std::vector<TileTask> all_tasks(const FrameSpec& spec) {
    std::vector<TileTask> out;
    for (std::uint32_t run = 0; run < run_count(spec.settings); ++run)
        for (std::uint32_t tile = 0; tile < tile_count(spec.size); ++tile)
            out.push_back(task_of(spec, run, tile));
    return out;
}

}  // namespace tessera
