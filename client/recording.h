// Sessions as files: what was looked at and changed, and when, in the format of client/edit_json.h.
// Pure but for the file.
#pragma once

#include <string>
#include <vector>

#include "client/edit_json.h"

namespace tessera {

/// Edits that make `before` what `after` is, by name. Vertices that move are left out; `shapes`
/// counts how often they did. An object
/// that has become another one of the same name stays as it was.
struct SceneChanges {
    std::vector<EditOperation> operations;
    int shapes = 0;
};
SceneChanges changes_between(const Scene& before, const Scene& after);

class Recorder {
public:
    /// Of a session that finds the scene so.
    explicit Recorder(const Scene& first) : scene_(first) {}

    /// What is seen now; `seconds` since the beginning never go back.
    void see(double seconds, const Scene& scene);
    void see(double seconds, const Camera& camera);

    const std::vector<TimedEdit>& steps() const { return steps_; }
    /// Changes of vertices that no recording holds: they play from the scene's own file.
    int shapes_left_out() const { return shapes_; }
    /// Throws UserError when the file cannot be written.
    void save(const std::string& file) const;

private:
    TimedEdit& step_at(double seconds);

    Scene scene_;
    std::vector<TimedEdit> steps_;
    int shapes_ = 0;
};

}  // namespace tessera
