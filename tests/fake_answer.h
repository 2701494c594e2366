// What a worker might answer to a task, made up: depends on nothing but the task, and a quarter's
// answer is a quarter of its tile's.
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
    const Rect tile = tile_rect(spec.size, task.tile), part = rect_of(spec.size, task);
    for (int c = 0; c < channel_count; ++c) {
        if (!tile_channels(spec).has(Channel(c))) continue;
        const int floats = floats_per_pixel(Channel(c));
        for (int i = 0; i < int(tile.pixels()) * floats; ++i) {
            float value = uniform(random) * float(task.pass_count);
            if (Channel(c) == Channel::normal) value = i % 3 == 2;
            if (Channel(c) == Channel::depth) value = 1;
            if (Channel(c) == Channel::surface) value = std::bit_cast<float>(3u);
            const int x = tile.x0 + i / floats % tile.width();
            const int y = tile.y0 + i / floats / tile.width();
            if (x >= part.x0 && x < part.x1 && y >= part.y0 && y < part.y1)
                result.data.push_back(value);
        }
    }
    return result;
}

inline Bytes packed(const FrameSpec& spec, const TileResult& result) {
    return pack_tile(tile_channels(spec), rect_of(spec.size, result.task).pixels(), result.data);
}

/// All tasks of a frame, pass by pass.
inline std::vector<TileTask> all_tasks(const FrameSpec& spec) {
    std::vector<TileTask> out;
    for (std::uint32_t run = 0; run < run_count(spec.settings); ++run)
        for (std::uint32_t tile = 0; tile < tile_count(spec.size); ++tile)
            out.push_back(task_of(spec, run, tile));
    return out;
}

/// The same picture, with some tiles in quarters.
template <class Random>
std::vector<TileTask> cut_some(const FrameSpec& spec, const std::vector<TileTask>& tasks,
                               Random& random) {
    std::vector<TileTask> out;
    for (TileTask task : tasks) {
        const bool cut = can_be_cut(spec.size, task.tile) && random() % 2 == 0;
        for (task.part = cut; task.part <= (cut ? quarters : 0); ++task.part) out.push_back(task);
    }
    return out;
}

}  // namespace tessera
