// The master: listens, lets peers in, and owns their sessions. One thread runs its io_context,
// which makes that the strand of all state; only folding and tone mapping happen elsewhere.
#pragma once

#include <chrono>
#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <string>

#include "common/keys.h"
#include "server/limits.h"
#include "server/metrics_endpoint.h"
#include "server/render_farm.h"
#include "server/scene_writer.h"
#include "server/viewer_session.h"
#include "server/worker_session.h"

namespace tessera {

struct ServerConfig {
    std::string listen = "127.0.0.1:7411";  ///< host:port; port 0 takes a free one
    /// The folder `server` that make_keys() made: peers speak TLS and have one of its tokens.
    /// Empty: plain TCP, on loopback only.
    std::filesystem::path keys;
    /// Without keys what peers must prove to know; empty: anybody may come in.
    std::string token;
    /// Where open scenes outlive the server; empty: they do not.
    std::filesystem::path journal = {};
    unsigned fold_threads = 2;
    std::string metrics = {};  ///< host:port of Prometheus' endpoint; empty: none
    /// Whether workers get meshes and textures from one another.
    RelayMode relays = RelayMode::automatic;
    std::filesystem::path trace = {};  ///< file for the timeline of the last frame; empty: none
    Limits limits = {};
    std::chrono::milliseconds handshake_deadline{5000};
};

class Server {
public:
    /// Listens at once, and opens the scenes of its journal. Throws UserError naming the address or
    /// file and what to do.
    Server(asio::io_context& io, const ServerConfig& config);

    /// A scene that every viewer may use; it takes the place of one of that name that is open
    /// already. Before `start`. Throws UserError, also when it is beyond the limits.
    void add_scene(const std::string& name, const SceneBundle& bundle);
    bool holds_scene(const std::string& name) const { return scenes_.find_open(name) != nullptr; }

    /// "host:port", with the port that was taken.
    std::string address() const;

    /// Accepts peers from now on, while the io_context runs.
    void start();
    /// Closes everything; the io_context then runs out of work.
    void stop();

private:
    asio::awaitable<void> accept_peers();
    void turn_away(tcp::socket socket);
    asio::awaitable<void> serve(tcp::socket socket);
    asio::awaitable<Hello> handshake(std::shared_ptr<Connection> connection);
    std::string objection(const Hello& hello, const std::string& peer_name) const;
    std::string objection_to_token(const Hello& hello, const std::string& peer_name) const;
    bool may_edit(const Hello& hello) const;
    Status status() const;

    ServerConfig config_;
    std::optional<ServerKeys> keys_;
    asio::io_context& io_;
    tcp::acceptor acceptor_;
    std::chrono::steady_clock::time_point started_;
    SceneStore scenes_;
    RenderFarm farm_;
    std::optional<SceneWriter> writer_;
    std::optional<MetricsEndpoint> metrics_;
    std::uint64_t last_peer_ = 0;
    std::string relay_token_;  ///< what workers show one another; empty: they do not relay
    std::map<std::uint64_t, std::shared_ptr<Connection>> connections_;  ///< all that are open
    std::size_t strangers_ = 0;
    std::uint32_t viewers_ = 0;
};

}  // namespace tessera
