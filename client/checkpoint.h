// A render that goes on where it was: the sums of a frame in a file, which `tessera render` writes
// now and then and when it is interrupted. It belongs to one scene and one set of settings, and
// says so when it is used for another.
#pragma once

#include <chrono>
#include <filesystem>

#include "client/render_client.h"

namespace tessera {

/// What the bits of a picture depend on.
struct CheckpointKey {
    BlobId scene;
    BlobId settings;  ///< camera, size and the like, and our release; not when to stop

    bool operator==(const CheckpointKey&) const = default;
};
CheckpointKey checkpoint_key(const Scene& scene, const FrameRequest& request);

class Checkpoint {
public:
    Checkpoint(std::filesystem::path file, const CheckpointKey& key, std::chrono::seconds every);

    /// What the file holds; nothing when there is none. Throws UserError when it is damaged or of
    /// another scene or other settings.
    SavedSums load();

    /// Saves what has arrived and asks for more when it is time; to be called while rendering.
    void tick(RenderClient& client);
    /// Saves what there is by now, if the server is there.
    void save_now(RenderClient& client);

private:
    bool save_arrived(RenderClient& client);

    std::filesystem::path file_;
    CheckpointKey key_;
    std::chrono::seconds every_;
    SavedSums loaded_;  ///< without the sums
    std::chrono::steady_clock::time_point asked_;
};

}  // namespace tessera
