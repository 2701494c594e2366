#include "client/local_cluster.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <poll.h>
#include <signal.h>
#include <spawn.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstring>
#include <filesystem>
#include <thread>

#include "common/check.h"

extern char** environ;

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

constexpr std::chrono::seconds start_timeout{10};  // a cold start from a slow disk
constexpr std::chrono::seconds stop_timeout{2};

std::filesystem::path find_program(std::filesystem::path folder, const std::string& program) {
    if (folder.empty()) folder = std::filesystem::read_symlink("/proc/self/exe").parent_path();
    if (!std::filesystem::exists(folder / program))
        throw UserError(
            fmt::format("{} is missing: it belongs beside tessera", (folder / program).string()));
    return folder / program;
}

std::string worker_name(int i) { return fmt::format("worker-{}", i + 1); }

std::vector<char*> pointers(std::vector<std::string>& strings) {
    std::vector<char*> out;
    for (std::string& s : strings) out.push_back(s.data());
    out.push_back(nullptr);
    return out;
}

/// The parent's environment with the cluster's token, which so never shows on a command line; keys
/// are for other servers.
std::vector<std::string> environment_with(const std::string& token) {
    std::vector<std::string> out{"TESSERA_TOKEN=" + token};
    for (char** entry = environ; *entry; ++entry)
        if (!std::string_view(*entry).starts_with("TESSERA_TOKEN=") &&
            !std::string_view(*entry).starts_with("TESSERA_KEYS="))
            out.emplace_back(*entry);
    return out;
}

std::string describe_end(int wait_status) {
    if (WIFSIGNALED(wait_status))
        return fmt::format("was ended by signal {} ({})", WTERMSIG(wait_status),
                           strsignal(WTERMSIG(wait_status)));
    return fmt::format("ended with status {}", WEXITSTATUS(wait_status));
}

int milliseconds_until(Clock::time_point deadline) {
    const auto left = std::chrono::ceil<std::chrono::milliseconds>(deadline - Clock::now());
    return std::max(0, int(left.count()));
}

/// Whether the child process has ended by `deadline`; it still has to be reaped.
bool wait_for_end(pid_t pid, Clock::time_point deadline) {
    const int fd = int(syscall(SYS_pidfd_open, pid, 0));
    if (fd < 0) return true;
    pollfd wait{.fd = fd, .events = POLLIN, .revents = 0};
    const bool ended = poll(&wait, 1, milliseconds_until(deadline)) == 1;
    close(fd);
    return ended;
}

/// Reads from `fd` up to the end of the first line; what arrived when the time is over otherwise.
std::string read_line(int fd, Clock::time_point deadline) {
    std::string line;
    for (;;) {
        pollfd wait{.fd = fd, .events = POLLIN, .revents = 0};
        if (poll(&wait, 1, milliseconds_until(deadline)) <= 0) return line;
        char c = 0;
        if (read(fd, &c, 1) != 1 || c == '\n') return line;
        line += c;
    }
}

}  // namespace

LocalCluster::LocalCluster(const LocalClusterConfig& config)
    : config_(config), token_(random_token()), address_("127.0.0.1:0") {
    children_.push_back({.pid = 0, .name = "server", .server = true, .ended = {}});
    start_server();

    for (int i = 0; i < config.workers; ++i)
        children_.push_back(
            {.pid = start_worker(i), .name = worker_name(i), .server = false, .ended = {}});
}

LocalCluster::~LocalCluster() { stop(); }

std::vector<std::string> LocalCluster::with_keys(std::vector<std::string> arguments,
                                                 const char* role) const {
    if (!config_.keys.empty())
        arguments.insert(arguments.end(), {"--keys", (config_.keys / role).string()});
    return arguments;
}

pid_t LocalCluster::start_worker(int i) {
    const int cores = std::max(1, int(std::thread::hardware_concurrency()));
    const int threads =
        config_.threads > 0 ? config_.threads : std::max(1, cores / config_.workers);
    const std::string server = config_.route ? config_.route(i, address_) : address_;
    const std::string own_pid = std::to_string(getpid());
    std::vector<std::string> arguments{
        "--server",     server,  "--threads",       std::to_string(threads), "--name",
        worker_name(i), "--log", config_.log_level, "--exit-with-parent",    own_pid};
    if (!config_.plugins.empty()) arguments.insert(arguments.end(), {"--plugins", config_.plugins});
    if (!config_.blob_cache.empty())
        arguments.insert(arguments.end(), {"--blob-cache", config_.blob_cache.string()});
    return spawn("tessera-worker", with_keys(std::move(arguments), "worker"), STDERR_FILENO);
}

void LocalCluster::restart_worker(int i) {
    Child& worker = children_.at(std::size_t(i) + 1);
    end(worker);
    worker.pid = start_worker(i);
    worker.ended.reset();
}

void LocalCluster::start_server() {
    std::vector<std::string> arguments = config_.scenes;
    arguments.insert(arguments.end(),
                     {"--listen", address_, "--log", config_.log_level, "--relays", config_.relays,
                      "--exit-with-parent", std::to_string(getpid())});
    if (!config_.journal.empty())
        arguments.insert(arguments.end(), {"--journal", config_.journal.string()});
    if (!config_.trace.empty()) arguments.insert(arguments.end(), {"--trace", config_.trace});
    int out[2];
    if (pipe2(out, O_CLOEXEC) != 0) throw UserError("cannot make a pipe for the embedded server");
    Child& server = children_.front();
    server.pid = spawn("tessera-server", with_keys(arguments, "server"), out[1]);
    server.ended.reset();
    close(out[1]);
    const std::string line = read_line(out[0], Clock::now() + start_timeout);
    close(out[0]);
    constexpr std::string_view greeting = "listening on ";
    if (!line.starts_with(greeting)) {
        stop();
        throw UserError("the embedded server did not start; its log above says why");
    }
    address_ = line.substr(greeting.size());
}

void LocalCluster::kill_server() { end(children_.front()); }

void LocalCluster::end(Child& child) {
    if (child.ended) return;
    kill(child.pid, SIGKILL);
    int status = 0;
    waitpid(child.pid, &status, 0);
    child.ended = status;
}

Credentials LocalCluster::credentials_of(const char* role) const {
    if (config_.keys.empty()) return {token_, nullptr};
    return load_credentials(config_.keys / role);
}

pid_t LocalCluster::spawn(const std::string& program, const std::vector<std::string>& arguments,
                          int stdout_fd) {
    const std::string path = find_program(config_.programs, program).string();
    std::vector<std::string> argv_strings{path};
    argv_strings.insert(argv_strings.end(), arguments.begin(), arguments.end());
    std::vector<std::string> environment = environment_with(token_);

    posix_spawn_file_actions_t actions;
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_addopen(&actions, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
    posix_spawn_file_actions_adddup2(&actions, stdout_fd, STDOUT_FILENO);
    // A process group of its own keeps the terminal's Ctrl-C for the client, which then ends its
    // children.
    posix_spawnattr_t attributes;
    posix_spawnattr_init(&attributes);
    sigset_t none;
    sigemptyset(&none);
    posix_spawnattr_setsigmask(&attributes, &none);
    posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETPGROUP | POSIX_SPAWN_SETSIGMASK);

    pid_t pid = 0;
    const int error = posix_spawn(&pid, path.c_str(), &actions, &attributes,
                                  pointers(argv_strings).data(), pointers(environment).data());
    posix_spawnattr_destroy(&attributes);
    posix_spawn_file_actions_destroy(&actions);
    if (error != 0) {
        stop();
        throw UserError(fmt::format("cannot start {}: {}", path, std::strerror(error)));
    }
    return pid;
}

std::vector<pid_t> LocalCluster::workers() const {
    std::vector<pid_t> out;
    for (const Child& child : children_)
        if (!child.server && !child.ended) out.push_back(child.pid);
    return out;
}

void LocalCluster::reap() {
    for (Child& child : children_) {
        int status = 0;
        if (!child.ended && waitpid(child.pid, &status, WNOHANG) == child.pid) child.ended = status;
    }
}

void LocalCluster::check_alive() {
    reap();
    const auto gone = [](const Child& child) { return child.ended.has_value(); };
    for (const Child& child : children_)
        if (child.server && gone(child))
            throw UserError(fmt::format("the embedded server {}", describe_end(*child.ended)));
    if (children_.size() > 1 && std::all_of(children_.begin() + 1, children_.end(), gone))
        throw UserError(fmt::format("every embedded worker is gone; the last one {}",
                                    describe_end(*children_.back().ended)));
}

void LocalCluster::stop() {
    // Workers first: they would take the server's end for a lost connection.
    const auto deadline = Clock::now() + stop_timeout;
    std::stable_partition(children_.begin(), children_.end(),
                          [](const Child& child) { return !child.server; });
    for (const Child& child : children_)
        if (!child.ended && !child.server) kill(child.pid, SIGTERM);
    for (const Child& child : children_) {
        if (child.ended || child.pid == 0) continue;
        if (child.server) kill(child.pid, SIGTERM);
        if (!wait_for_end(child.pid, deadline)) kill(child.pid, SIGKILL);
        waitpid(child.pid, nullptr, 0);
    }
    children_.clear();
}

}  // namespace tessera
