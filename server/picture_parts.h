// Pictures and channels in the form in which they travel to viewers.
#pragma once

#include <vector>

#include "server/live_view.h"

namespace tessera {

struct PicturePart {
    PictureChunk whole;  ///< offset 0
    Payload pixels;
};

/// The picture and spec.extra.
std::vector<PicturePart> parts_of(const FinishedFrame& frame);
/// The channel that the view shows.
PicturePart part_of(const LivePicture& picture, int jpeg_quality);

Message chunk_of(const PicturePart& part, std::size_t offset);

}  // namespace tessera
