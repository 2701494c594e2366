// How fast TCP finds the way to a peer, as the kernel measures it (tcp_info). Apart from
// connection.h, because the headers of kernel and C library that name it exclude each other.
#pragma once

namespace tessera {

struct LinkSpeed {
    double bytes_per_second = 0;    ///< delivered when there was something to deliver; 0: not known
    double round_trip_seconds = 0;  ///< the least of late, which no queue has made longer
};

/// Of a connected TCP socket; all zero where the kernel does not tell.
LinkSpeed link_speed(int socket);

}  // namespace tessera
