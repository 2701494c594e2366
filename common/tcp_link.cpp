#include "common/tcp_link.h"

#include <linux/tcp.h>
#include <netinet/in.h>
#include <sys/socket.h>

namespace tessera {

LinkSpeed link_speed(int socket) {
    tcp_info info{};
    socklen_t size = sizeof info;
    if (::getsockopt(socket, IPPROTO_TCP, TCP_INFO, &info, &size) != 0) return {};
    return {.bytes_per_second = double(info.tcpi_delivery_rate),
            .round_trip_seconds = 1e-6 * double(info.tcpi_min_rtt)};
}

}  // namespace tessera
