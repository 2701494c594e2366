// What a peer proves itself with, as `tessera keys` lays it out: a folder for each role.
//
//   authority.crt     whom the folder's owner trusts: the private authority's certificate
//   certificate.crt   who the owner is, signed by the authority (server and workers)
//   private.key       what proves it
//   token             what the owner's Hello says; the server's folder has `tokens` instead, a line
//                     "ROLE TOKEN" for each role
//
// Without keys peers speak plain TCP, which is for loopback only.
#pragma once

#include <cstdint>
#include <filesystem>
#include <map>
#include <memory>
#include <string>

namespace boost::asio::ssl {
class context;
}

namespace tessera {

/// What a token allows. Editors may do what viewers may, and change scenes.
enum class Grant : std::uint8_t { worker, viewer, editor };

inline constexpr const char* grant_names[] = {"worker", "viewer", "editor"};

/// Common names of the certificates that prove a peer's role.
inline constexpr const char* server_common_name = "tessera-server";
inline constexpr const char* worker_common_name = "tessera-worker";

/// Certificates ready for use, TLS 1.3 only. Any number of connections share one.
class Tls {
public:
    /// A peer is a worker who comes to another one, and expects a worker's certificate.
    enum class Side : std::uint8_t { server, client, peer };

    /// Reads the folder's certificates. Throws UserError naming the file and what to do, also when
    /// others than its owner may read the private key.
    Tls(const std::filesystem::path& folder, Side side);

    Side side() const { return side_; }
    boost::asio::ssl::context& context() const { return *context_; }

private:
    Side side_;
    std::shared_ptr<boost::asio::ssl::context> context_;
};

/// Of workers towards one another: a side each, both null: plain TCP.
struct RelayKeys {
    std::shared_ptr<const Tls> accept;
    std::shared_ptr<const Tls> connect;
};

/// A worker's or viewer's side.
struct Credentials {
    std::string token;               ///< empty: none
    std::shared_ptr<const Tls> tls;  ///< null: plain TCP
    RelayKeys relay{};               ///< a worker's
};

/// Of the folder, or where that is empty of the folder that TESSERA_KEYS names, or else the token
/// of TESSERA_TOKEN: never of a command line, where others could read it. Throws UserError.
Credentials load_credentials(std::filesystem::path folder = {});

/// The server's side.
struct ServerKeys {
    std::map<std::string, Grant> tokens;
    std::shared_ptr<const Tls> tls;
};
ServerKeys load_server_keys(const std::filesystem::path& folder);

/// Makes a private authority and the folders server, worker, editor and viewer in `folder`, which
/// must not exist yet. Throws UserError.
void make_keys(const std::filesystem::path& folder);

/// Takes the same time wherever the tokens differ and however long they are.
bool same_token(const std::string& a, const std::string& b);

/// 256 random bits from the kernel, in hexadecimal.
std::string random_token();

}  // namespace tessera
