#include "common/keys.h"

#include <fmt/format.h>
#include <sys/random.h>
#include <sys/stat.h>

#include <algorithm>
#include <boost/asio/ssl/context.hpp>
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <fstream>

#include "common/blob.h"
#include "common/check.h"

namespace tessera {
namespace {

namespace fs = std::filesystem;
namespace ssl = boost::asio::ssl;
using boost::system::error_code;

/// A private key that others can read proves nothing.
void check_private(const fs::path& file) {
    struct stat status {};
    if (::stat(file.c_str(), &status) != 0)
        throw UserError(fmt::format("{}: {}; name a folder that `tessera keys` made", file.string(),
                                    std::strerror(errno)));
    if (status.st_mode & (S_IRGRP | S_IROTH))
        throw UserError(fmt::format("{}: others may read it; take that away: chmod 600 {}",
                                    file.string(), file.string()));
}

std::ifstream open_private(const fs::path& file) {
    check_private(file);
    std::ifstream in(file);
    if (!in) throw UserError(fmt::format("{}: cannot be read", file.string()));
    return in;
}

std::string read_token(const fs::path& file) {
    std::string token;
    if (!(open_private(file) >> token))
        throw UserError(fmt::format("{}: holds no token; make new keys", file.string()));
    return token;
}

std::map<std::string, Grant> read_tokens(const fs::path& file) {
    std::map<std::string, Grant> out;
    std::ifstream in = open_private(file);
    for (std::string role, token; in >> role >> token;) {
        const auto found = std::find(std::begin(grant_names), std::end(grant_names), role);
        if (found == std::end(grant_names))
            throw UserError(
                fmt::format("{}: there is no role '{}'; each line is a role (worker, "
                            "viewer, editor) and its token",
                            file.string(), role));
        out[token] = Grant(found - std::begin(grant_names));
    }
    if (out.empty()) throw UserError(fmt::format("{}: holds no tokens", file.string()));
    return out;
}

}  // namespace

Tls::Tls(const fs::path& folder, Side side)
    : side_(side),
      context_(std::make_shared<ssl::context>(side == Side::server ? ssl::context::tls_server
                                                                   : ssl::context::tls_client)) {
    SSL_CTX_set_min_proto_version(context_->native_handle(), TLS1_3_VERSION);
    const auto use = [&](const char* name, auto load) {
        const fs::path file = folder / name;
        error_code error;
        load(file.string(), error);
        if (error)
            throw UserError(fmt::format("{}: {}; name a folder that `tessera keys` made",
                                        file.string(), error.message()));
    };
    use("authority.crt",
        [&](const std::string& file, error_code& e) { context_->load_verify_file(file, e); });
    if (side == Side::server || fs::exists(folder / "certificate.crt")) {
        check_private(folder / "private.key");
        use("certificate.crt", [&](const std::string& file, error_code& e) {
            context_->use_certificate_chain_file(file, e);
        });
        use("private.key", [&](const std::string& file, error_code& e) {
            context_->use_private_key_file(file, ssl::context::pem, e);
        });
    }
    // The certificate that proves a worker to the server proves it to other workers, too.
    if (side == Side::peer) SSL_CTX_set_purpose(context_->native_handle(), X509_PURPOSE_SSL_CLIENT);
    // OpenSSL also checks that the peer's certificate is made for its side. A viewer has none; that
    // a worker has one the server asks after its Hello.
    context_->set_verify_mode(ssl::verify_peer);
}

Credentials load_credentials(fs::path folder) {
    const auto environment = [](const char* name) {
        const char* value = std::getenv(name);
        return std::string(value ? value : "");
    };
    if (folder.empty()) folder = environment("TESSERA_KEYS");
    if (folder.empty()) return {environment("TESSERA_TOKEN"), nullptr};
    Credentials out{read_token(folder / "token"),
                    std::make_shared<const Tls>(folder, Tls::Side::client)};
    if (fs::exists(folder / "certificate.crt"))
        out.relay = {std::make_shared<const Tls>(folder, Tls::Side::server),
                     std::make_shared<const Tls>(folder, Tls::Side::peer)};
    return out;
}

ServerKeys load_server_keys(const fs::path& folder) {
    return {read_tokens(folder / "tokens"), std::make_shared<const Tls>(folder, Tls::Side::server)};
}

bool same_token(const std::string& a, const std::string& b) {
    const auto digest = [](const std::string& s) {
        return blob_id(std::as_bytes(std::span(s))).digest;
    };
    const auto da = digest(a), db = digest(b);
    unsigned difference = 0;
    for (std::size_t i = 0; i < da.size(); ++i) difference |= unsigned(da[i] ^ db[i]);
    return difference == 0;
}

std::string random_token() {
    std::uint8_t bytes[32];
    CHECK(getrandom(bytes, sizeof bytes, 0) == sizeof bytes);
    std::string token;
    for (const std::uint8_t byte : bytes) token += fmt::format("{:02x}", byte);
    return token;
}

}  // namespace tessera
