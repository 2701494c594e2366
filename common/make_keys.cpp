// A private certificate authority in a few calls of OpenSSL: X.509 v3, keys on the curve P-256.
//
// Certificates name a role, not a host: whoever holds a certificate of this authority for servers
// is the server. So keys are made once, wherever the server will run.
#include <fcntl.h>
#include <fmt/format.h>
#include <openssl/pem.h>
#include <openssl/rand.h>
#include <openssl/x509v3.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <memory>

#include "common/check.h"
#include "common/keys.h"

namespace tessera {
namespace {

namespace fs = std::filesystem;

constexpr long seconds_per_day = 24 * 60 * 60;
constexpr long days_valid = 10 * 365;

struct Free {
    void operator()(EVP_PKEY* p) const { EVP_PKEY_free(p); }
    void operator()(X509* p) const { X509_free(p); }
    void operator()(X509_EXTENSION* p) const { X509_EXTENSION_free(p); }
    void operator()(BIO* p) const { BIO_free(p); }
};
template <class T>
using Owned = std::unique_ptr<T, Free>;

struct Identity {
    Owned<EVP_PKEY> key;
    Owned<X509> certificate;
};

void extend(X509* certificate, X509* issuer, int id, const char* value) {
    X509V3_CTX context;
    X509V3_set_ctx_nodb(&context);
    X509V3_set_ctx(&context, issuer, certificate, nullptr, nullptr, 0);
    const Owned<X509_EXTENSION> extension(X509V3_EXT_conf_nid(nullptr, &context, id, value));
    CHECK(extension && X509_add_ext(certificate, extension.get(), -1) == 1);
}

void set_random_serial(X509* certificate) {
    std::uint64_t serial = 0;
    CHECK(RAND_bytes(reinterpret_cast<unsigned char*>(&serial), sizeof serial) == 1);
    CHECK(ASN1_INTEGER_set_uint64(X509_get_serialNumber(certificate), serial >> 1) == 1);
}

/// A key and its certificate, signed by `authority`, or by itself as an authority. `usage`: what it
/// proves, in the words of OpenSSL's extendedKeyUsage.
Identity make_identity(const char* common_name, const char* usage, const Identity* authority) {
    Identity out{Owned<EVP_PKEY>(EVP_EC_gen("P-256")), Owned<X509>(X509_new())};
    X509* const certificate = out.certificate.get();
    CHECK(out.key && certificate);
    CHECK(X509_set_version(certificate, X509_VERSION_3) == 1);
    set_random_serial(certificate);
    // A day back: clocks differ.
    X509_gmtime_adj(X509_getm_notBefore(certificate), -seconds_per_day);
    X509_time_adj_ex(X509_getm_notAfter(certificate), int(days_valid), 0, nullptr);
    X509_NAME* const name = X509_get_subject_name(certificate);
    CHECK(X509_NAME_add_entry_by_txt(name, "CN", MBSTRING_UTF8,
                                     reinterpret_cast<const unsigned char*>(common_name), -1, -1,
                                     0) == 1);
    CHECK(X509_set_pubkey(certificate, out.key.get()) == 1);
    X509* const issuer = authority ? authority->certificate.get() : certificate;
    CHECK(X509_set_issuer_name(certificate, X509_get_subject_name(issuer)) == 1);
    extend(certificate, issuer, NID_subject_key_identifier, "hash");
    extend(certificate, issuer, NID_basic_constraints,
           authority ? "critical,CA:FALSE" : "critical,CA:TRUE,pathlen:0");
    if (authority) {
        extend(certificate, issuer, NID_authority_key_identifier, "keyid:always");
        extend(certificate, issuer, NID_key_usage, "critical,digitalSignature");
        extend(certificate, issuer, NID_ext_key_usage, usage);
    } else {
        extend(certificate, issuer, NID_key_usage, "critical,keyCertSign,cRLSign");
    }
    const Identity& signer = authority ? *authority : out;
    CHECK(X509_sign(certificate, signer.key.get(), EVP_sha256()) > 0);
    return out;
}

template <class Write>
std::string pem(const Write& write) {
    const Owned<BIO> memory(BIO_new(BIO_s_mem()));
    CHECK(memory && write(memory.get()) == 1);
    char* text = nullptr;
    const long size = BIO_get_mem_data(memory.get(), &text);
    return {text, std::size_t(size)};
}

std::string pem_of(X509* certificate) {
    return pem([&](BIO* out) { return PEM_write_bio_X509(out, certificate); });
}
std::string pem_of(EVP_PKEY* key) {
    return pem([&](BIO* out) {
        return PEM_write_bio_PKCS8PrivateKey(out, key, nullptr, nullptr, 0, nullptr, nullptr);
    });
}

/// Only its owner may read the file, from its first byte on.
void write_private(const fs::path& file, const std::string& text) {
    const int fd = ::open(file.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
    const bool written = fd >= 0 && ::write(fd, text.data(), text.size()) == ssize_t(text.size());
    const int error = errno;
    if (fd >= 0) ::close(fd);
    if (!written) throw UserError(fmt::format("{}: {}", file.string(), std::strerror(error)));
}

void write_identity(const fs::path& folder, const Identity& identity) {
    write_private(folder / "certificate.crt", pem_of(identity.certificate.get()));
    write_private(folder / "private.key", pem_of(identity.key.get()));
}

fs::path make_folder(const fs::path& folder) {
    std::error_code error;
    if (!fs::create_directory(folder, error))
        throw UserError(fmt::format("{}: {}; name a folder that does not exist yet",
                                    folder.string(), error ? error.message() : "exists already"));
    fs::permissions(folder, fs::perms::owner_all);
    return folder;
}

}  // namespace

void make_keys(const fs::path& folder) {
    const Identity authority = make_identity("tessera authority", "", nullptr);
    const std::string trusted = pem_of(authority.certificate.get());
    make_folder(folder);
    write_identity(make_folder(folder / "authority"), authority);
    std::string tokens;
    for (const char* role : grant_names) {
        const fs::path own = make_folder(folder / role);
        const std::string token = random_token();
        tokens += fmt::format("{} {}\n", role, token);
        write_private(own / "authority.crt", trusted);
        write_private(own / "token", token + "\n");
    }
    write_identity(folder / "worker", make_identity(worker_common_name, "clientAuth", &authority));
    const fs::path server = make_folder(folder / "server");
    write_private(server / "authority.crt", trusted);
    write_private(server / "tokens", tokens);
    write_identity(server, make_identity(server_common_name, "serverAuth", &authority));
}

}  // namespace tessera
