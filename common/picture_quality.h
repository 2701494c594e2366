// How good pictures that change may be, so that they come in time over the link that there is: the
// law by which server and web gateway choose the quality of their JPEG files. Pure.
#pragma once

namespace tessera {

/// Of 100, as libjpeg counts.
inline constexpr int best_jpeg_quality = 90;
inline constexpr int worst_jpeg_quality = 25;

/// The quality of the next picture. `transfer_seconds`: that the last one, of quality `now`, spent
/// on the way beyond what an empty message does, whose way there and back takes
/// `round_trip_seconds`.
int next_jpeg_quality(int now, double transfer_seconds, double round_trip_seconds);

}  // namespace tessera
