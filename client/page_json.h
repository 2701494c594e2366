// What a page says about its view, from JSON: see client/web_viewer.h. Whatever strangers write,
// the view that comes out of it is one that the protocol allows. Pure; fuzzed.
#pragma once

#include <nlohmann/json_fwd.hpp>
#include <stdexcept>

#include "common/messages.h"

namespace tessera {

/// What the page says makes no sense: ends the service of that page and no other.
struct PageError : std::runtime_error {
    using std::runtime_error::runtime_error;
};

/// Changes what of `view` the page decides. Throws PageError or nlohmann::json::exception; the view
/// then is as it was.
void read_view(const nlohmann::json& json, View& view);

/// A time, 0 to a day. Throws as read_view does.
double read_seconds(const nlohmann::json& json);

struct PagePick {
    vec2 point{0};  ///< (0, 1): the middle of the upper edge
    std::uint32_t number = 0;
};
/// Throws as read_view does.
PagePick read_pick(const nlohmann::json& message);

}  // namespace tessera
