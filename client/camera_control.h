// How a viewer moves: turning around a point, panning, flying, coming nearer. Pure: a camera and a
// gesture in, a camera out. Gestures are in parts of the picture's height, so that they feel the
// same in any window; no gesture makes a camera that looks nowhere or along its own up direction.
#pragma once

#include <optional>

#include "common/scene.h"

namespace tessera {

/// Turns the eye around the point looked at.
Camera orbited(const Camera& camera, const vec2& drag);
/// Turns the view around the eye.
Camera turned(const Camera& camera, const vec2& drag);
/// Moves eye and point together, so that the point stays under the pointer.
Camera panned(const Camera& camera, const vec2& drag);
/// Goes that many times nearer to the point looked at; less than 1 goes away.
Camera approached(const Camera& camera, float factor);
/// Moves by (right, up, forward) metres.
Camera flown(const Camera& camera, const vec3& by);

/// The ray through a point of the picture: (0, 0) is its centre, (0, 1) the middle of its upper
/// edge. `dir` is a unit vector.
Ray eye_ray(const Camera& camera, const vec2& point);
/// Where the ray to `p` goes through the picture; nothing when `p` is behind the eye.
std::optional<vec2> projected(const Camera& camera, const vec3& p);

}  // namespace tessera
