// The embedded default: a server and workers as child processes on loopback, on an ephemeral port
// and with a random token. The same programs as on a cluster, and gone when this object is, however
// it ends: the children also end by themselves when this process dies.
#pragma once

#include <sys/types.h>

#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "common/keys.h"

namespace tessera {

struct LocalClusterConfig {
    int workers = 1;
    int threads = 0;  ///< render threads of each worker; 0: this machine's cores shared out
    std::string relays = "auto";            ///< of the server, --relays
    std::filesystem::path blob_cache = {};  ///< folder that the workers share; empty: none
    std::string plugins = {};               ///< folder of the workers' shader plug-ins; empty: none
    std::string log_level = "warning";
    std::string trace = {};  ///< file for the timeline of the last frame; empty: none
    /// Where worker i, from 0, is to find the server at the given address; empty: there.
    std::function<std::string(int, const std::string&)> route = {};
    std::vector<std::string> scenes{};  ///< that the server holds
    std::filesystem::path journal{};    ///< of the server; empty: none
    std::filesystem::path keys = {};    ///< as make_keys() made them: TLS; empty: a token alone
    std::filesystem::path
        programs;  ///< where tessera-server and -worker lie; empty: beside this one
};

class LocalCluster {
public:
    /// Starts the processes. Throws UserError when a program is missing or does not start.
    explicit LocalCluster(const LocalClusterConfig& config);
    ~LocalCluster();
    LocalCluster(const LocalCluster&) = delete;
    LocalCluster& operator=(const LocalCluster&) = delete;

    const std::string& address() const { return address_; }
    /// Of an editor, and of further workers.
    Credentials credentials() const { return credentials_of("editor"); }
    Credentials worker_credentials() const { return credentials_of("worker"); }

    /// Worker processes, for tests that hurt them.
    std::vector<pid_t> workers() const;
    /// Ends worker i, from 0, with SIGKILL, and starts it again.
    void restart_worker(int i);
    /// The server's process, to be watched.
    pid_t server() const { return children_.front().pid; }

    /// Ends the server with SIGKILL; what it has not written is lost.
    void kill_server();
    /// Starts it again, at the same address, once it has been killed.
    void start_server();

    /// Throws UserError saying how it ended when the server, or every worker, has ended by itself.
    void check_alive();

private:
    struct Child {
        pid_t pid = 0;
        std::string name;
        bool server = false;
        std::optional<int> ended;  ///< wait status
    };
    Credentials credentials_of(const char* role) const;
    std::vector<std::string> with_keys(std::vector<std::string> arguments, const char* role) const;
    pid_t spawn(const std::string& program, const std::vector<std::string>& arguments,
                int stdout_fd);
    pid_t start_worker(int i);
    void end(Child& child);
    void reap();
    void stop();

    LocalClusterConfig config_;
    std::string token_;
    std::string address_;
    std::vector<Child> children_;
};

}  // namespace tessera
