// The gateway between browsers and a server: HTTP for the page, which is compiled in, and a
// WebSocket for each browser's own view.
//
// Sockets live on one thread; each browser's viewer, which waits for the server and traces picks,
// on a thread of its own. Between the two lie bounded queues: a page that talks faster than it is
// listened to is not read from meanwhile, and one that reads slowly gets the newest of everything.
#pragma once

#include <cstddef>
#include <functional>
#include <string>
#include <vector>

#include "client/web_viewer.h"

namespace tessera {

struct WebGatewayConfig {
    WebViewerConfig viewer;
    std::string listen = "127.0.0.1:8080";
    bool beyond_loopback = false;    ///< may listen there
    std::size_t browsers = 16;       ///< views at most
    std::vector<std::string> hosts;  ///< names by which browsers may call us, beside localhost
};

/// Serves until SIGINT or SIGTERM; `listening` is called with the page's URL. Throws UserError when
/// it cannot listen.
void run_web_gateway(const WebGatewayConfig& config,
                     const std::function<void(const std::string& url)>& listening);

}  // namespace tessera
