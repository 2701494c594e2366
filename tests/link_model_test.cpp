// Laws of a link, and of the relay that is made of two.
#include "client/link_model.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "client/fault_proxy.h"

namespace tessera {
namespace {

struct Sent {
    double at;
    std::size_t bytes;
    double arrival;
};

std::vector<Sent> traffic(const LinkConfig& config, unsigned seed) {
    std::mt19937 random(seed);
    LinkModel link(config);
    std::vector<Sent> sent;
    double now = 0;
    for (int i = 0; i < 2000; ++i) {
        now += std::exponential_distribution<>(1000)(random);
        const std::size_t bytes = 1 + random() % 65536;
        sent.push_back({now, bytes, link.arrival(now, bytes)});
    }
    return sent;
}

TEST(LinkModel, keeps_order_delay_and_bandwidth) {
    for (unsigned seed = 1; seed <= 20; ++seed) {
        const LinkConfig config{.delay = 0.01 * seed,
                                .jitter = 0.003,
                                .bits_per_second = 1e8,
                                .loss = seed % 2 ? 0.001 : 0.0,
                                .seed = seed};
        const std::vector<Sent> sent = traffic(config, seed);
        double bytes = 0;
        for (std::size_t i = 0; i < sent.size(); ++i) {
            bytes += double(sent[i].bytes);
            const double wire = 8 * double(sent[i].bytes) / config.bits_per_second;
            EXPECT_GE(sent[i].arrival, sent[i].at + wire + config.delay);
            EXPECT_GE(sent[i].arrival, sent[0].at + 8 * bytes / config.bits_per_second);
            EXPECT_GE(sent[i].arrival, sent[i > 0 ? i - 1 : 0].arrival);
        }
    }
}

TEST(LinkModel, repeats_itself) {
    const LinkConfig config{.delay = 0.01, .jitter = 0.02, .bits_per_second = 0, .loss = 0.01};
    const std::vector<Sent> once = traffic(config, 1), again = traffic(config, 1);
    for (std::size_t i = 0; i < once.size(); ++i) EXPECT_EQ(once[i].arrival, again[i].arrival);
}

TEST(LinkModel, loses_the_share_that_it_is_told) {
    LinkModel link({.delay = 0, .jitter = 0, .bits_per_second = 0, .loss = 0.1});
    constexpr int packets = 20000;
    int late = 0;
    for (int i = 0; i < packets; ++i) late += link.arrival(i, 1460) > i;
    EXPECT_NEAR(double(late) / packets, 0.1, 5 * std::sqrt(0.1 * 0.9 / packets));
}

TEST(FaultProxy, passes_all_bytes_and_the_end_of_them) {
    asio::io_context io;
    tcp::acceptor acceptor(io, {asio::ip::address_v4::loopback(), 0});
    FaultProxy proxy({"127.0.0.1", std::to_string(acceptor.local_endpoint().port())},
                     {.delay = 0.002, .jitter = 0.001, .bits_per_second = 1e9, .loss = 0.001});
    const Address address = parse_address(proxy.address());
    tcp::socket client(io);
    client.connect({asio::ip::address_v4::loopback(), std::uint16_t(std::stoi(address.port))});
    tcp::socket server = acceptor.accept();
    for (tcp::socket* from : {&client, &server}) {
        tcp::socket& to = from == &client ? server : client;
        std::mt19937 random(7);
        std::vector<unsigned char> sent(200'000), received(sent.size());
        for (unsigned char& byte : sent) byte = static_cast<unsigned char>(random());
        asio::write(*from, asio::buffer(sent));
        asio::read(to, asio::buffer(received));
        EXPECT_EQ(sent, received);
    }
    client.close();
    char byte = 0;
    boost::system::error_code error;
    server.read_some(asio::buffer(&byte, 1), error);
    EXPECT_EQ(error, asio::error::eof);
}

}  // namespace
}  // namespace tessera
