#include "client/link_model.h"

#include <algorithm>
#include <cmath>

#include "common/random_number.h"

namespace tessera {
namespace {

constexpr double packet_bytes = 1460;  // what Ethernet leaves of 1500
/// A sender that hears nothing waits so long at least, in Linux. What is lost between others is
/// sent again sooner: this model is the worse case.
constexpr double retransmission_timeout = 0.2;

}  // namespace

float LinkModel::draw() { return random_unit(config_.seed * 0x9e3779b9u + drawn_++); }

double LinkModel::arrival(double now, std::size_t bytes) {
    const double wire =
        config_.bits_per_second > 0 ? 8 * double(bytes) / config_.bits_per_second : 0;
    idle_from_ = std::max(idle_from_, now) + wire;
    double arrival = idle_from_ + config_.delay + config_.jitter * double(draw());
    const double all_through = std::pow(1 - config_.loss, std::ceil(double(bytes) / packet_bytes));
    if (double(draw()) >= all_through) arrival += retransmission_timeout;
    last_arrival_ = std::max(last_arrival_, arrival);
    return last_arrival_;
}

}  // namespace tessera
