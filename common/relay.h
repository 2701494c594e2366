// Meshes and textures from worker to worker: a worker has blobs for others, as it holds them or as
// they come in, and takes from others what the server names another worker for. The server decides
// (server/relay_plan.h); what comes counts by its hash alone, so that nobody need be trusted; and
// what does not come, or comes wrong, is asked of the server.
//
//   this worker                         a peer that the server has named
//   Hello {relay token}          ->
//                                <-     Welcome
//   BlobRequest                  ->
//                                <-     BlobChunk*, while the peer itself gets them; or Refused
//
// Chunks go out one after the other while little waits to be sent, on connections of their own:
// what server and worker have to say to each other never waits for them.
#pragma once

#include <chrono>
#include <deque>
#include <functional>
#include <map>
#include <set>

#include "common/scene_sync.h"

namespace tessera {

/// How long peers may take.
struct RelayPatience {
    using Duration = std::chrono::steady_clock::duration;
    /// For a peer to be reached, and to let us in.
    Duration handshake = std::chrono::seconds(2);
    /// In which a peer that is to send something must send a piece of it. It may have to wait for
    /// its own sender, but hands on what it gets piece by piece.
    Duration silence = std::chrono::seconds(5);
};

class Relay : public std::enable_shared_from_this<Relay> {
public:
    /// Listens on the port (0: any free one) of the address by which the server is reached. Null
    /// where that may not be: without keys on loopback only. Also null, with a warning, where the
    /// port is taken.
    static std::shared_ptr<Relay> listen(Connection& server, const RelayKeys& keys,
                                         std::uint16_t port, const RelayPatience& patience = {});

    Relay(tcp::acceptor acceptor, const RelayKeys& keys, const RelayPatience& patience);

    std::uint16_t port() const { return port_; }

    /// Begins to serve from `receiver` and to feed it. `server` gets the requests for what peers
    /// fail to send; `more` is called when a peer has sent something. An empty token: this server
    /// wants no relays, and nobody is let in.
    void begin(const std::string& token, std::shared_ptr<SceneReceiver> receiver,
               std::shared_ptr<Connection> server, std::function<void()> more);
    /// Takes the blobs, which the receiver has asked for, from the worker that the message names.
    /// Throws ProtocolError for a message that no server sends.
    void pull(const BlobSource& source);
    /// The receiver has got something: those who wait for it get it, too.
    void arrived() { news_.cancel(); }
    /// Ends all connections; nothing is called any more.
    void close();

    /// Of blobs, to others.
    std::uint64_t bytes_sent() const { return bytes_sent_; }

private:
    /// A worker that takes blobs from here.
    struct Taker {
        std::shared_ptr<Connection> connection;
        std::deque<BlobId> wanted;
        bool sending = false;

        explicit Taker(std::shared_ptr<Connection> c) : connection(std::move(c)) {}
    };
    /// A worker that blobs are taken from.
    struct Giver {
        std::uint64_t peer = 0;
        Address address;
        std::shared_ptr<Connection> connection;    ///< null: not let in yet
        std::map<BlobId, std::uint64_t> expected;  ///< bytes of each
        asio::steady_timer deadline;

        Giver(std::uint64_t p, Address a, const asio::any_io_executor& executor)
            : peer(p), address(std::move(a)), deadline(executor) {}
    };

    asio::awaitable<void> accept_takers();
    asio::awaitable<void> serve(std::shared_ptr<Connection> connection);
    asio::awaitable<void> admit(std::shared_ptr<Connection> connection);
    asio::awaitable<void> send_wanted(std::shared_ptr<Taker> taker);
    asio::awaitable<void> send_blob(std::shared_ptr<Connection> to, BlobId id);
    asio::awaitable<void> take_from(std::shared_ptr<Giver> giver);
    asio::awaitable<void> enter(std::shared_ptr<Giver> giver);
    void take(Giver& giver, const Message& message);
    void arm(const std::shared_ptr<Giver>& giver);
    void failed(Giver& giver, const std::string& reason);

    tcp::acceptor acceptor_;
    RelayKeys keys_;
    RelayPatience patience_;
    std::uint16_t port_;
    std::string token_;
    std::shared_ptr<SceneReceiver> receiver_;  ///< null: not begun, or closed
    std::shared_ptr<Connection> server_;
    std::function<void()> more_;
    std::set<std::shared_ptr<Connection>> takers_;
    std::map<std::uint64_t, std::shared_ptr<Giver>> givers_;  ///< by the server's numbers
    asio::steady_timer news_;                                 ///< cancelled when a blob grows
    std::uint64_t bytes_sent_ = 0;
};

}  // namespace tessera
