// Renders tiles of one scene version: geometry built, lights collected, virtual point lights made
// per frame and pass. Knows no sockets and no clock beyond the timing of its own work.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "common/scene.h"
#include "common/tile.h"
#include "worker/shaders.h"

namespace tessera {

/// What the scene needs, decided once when it is loaded (DESIGN.md, section 9): one sentence for
/// each feature modelled or left out, for logs and statistics.
struct ScenePlan {
    std::vector<std::string> modelled;
    std::vector<std::string> left_out;
};

struct RendererConfig {
    int threads = 1;  ///< for building; render() is called from as many threads as the caller likes
    std::shared_ptr<const ShaderTable> shaders = built_in_shaders();
};

class Renderer {
public:
    /// Decodes meshes and textures. Takes over from `before`, of an earlier version of the scene or
    /// null, whatever did not change, and gives the same pictures as without it; needs it no longer
    /// afterwards. Throws std::runtime_error naming a blob that is missing or broken.
    Renderer(const Scene& scene, const BlobStore& blobs, const RendererConfig& config,
             const Renderer* before = nullptr);
    ~Renderer();

    const ScenePlan& plan() const;
    /// Seconds spent building tracers so far.
    double build_seconds() const;

    /// Builds the tracer, so that frames which use it begin at once; others build theirs then.
    void prepare(TracerKind tracer);
    /// Makes ready for tasks of `spec`; may be called again for a frame already begun. Thread-safe.
    void begin_frame(const FrameSpec& spec);
    /// Drops what begin_frame made. Tasks of that frame still running finish safely.
    void end_frame(std::uint64_t frame);
    /// Renders one task of a frame begun before, bit for bit the same on every call. Thread-safe.
    /// Returns nothing when the frame has ended or was never begun.
    std::optional<TileResult> render(const TileTask& task) const;

private:
    struct State;
    std::unique_ptr<State> state_;
};

}  // namespace tessera
