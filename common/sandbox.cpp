#include "common/sandbox.h"

#include <linux/audit.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <cerrno>
#include <cstddef>
#include <iterator>
#include <vector>

namespace tessera {
namespace {

#if defined(__x86_64__)
constexpr std::uint32_t architecture = AUDIT_ARCH_X86_64;
#elif defined(__aarch64__)
constexpr std::uint32_t architecture = AUDIT_ARCH_AARCH64;
#else
constexpr std::uint32_t architecture = 0;
#endif

/// Numbers from here on are another set of system calls on x86-64 (x32), for the same purposes.
constexpr std::uint32_t first_foreign_call = 0x40000000;

constexpr std::uint32_t forbidden[] = {
    SYS_socket,   SYS_socketpair, SYS_connect,           SYS_bind,           SYS_execve,
    SYS_execveat, SYS_ptrace,     SYS_process_vm_readv,  SYS_kill,           SYS_tkill,
    SYS_bpf,      SYS_keyctl,     SYS_process_vm_writev, SYS_io_uring_setup, SYS_mount,
    SYS_unshare,  SYS_setns,      SYS_pidfd_getfd};

void set_limit(int resource, rlim_t soft, rlim_t hard) {
    const rlimit limit{.rlim_cur = soft, .rlim_max = hard};
    setrlimit(__rlimit_resource(resource), &limit);
}

sock_filter load(std::size_t offset) {
    return BPF_STMT(BPF_LD | BPF_W | BPF_ABS, std::uint32_t(offset));
}
/// Skips this many instructions when the comparison holds, or else.
sock_filter jump(std::uint16_t comparison, std::uint32_t value, std::uint8_t if_true,
                 std::uint8_t if_false) {
    return BPF_JUMP(std::uint16_t(BPF_JMP | comparison | BPF_K), value, if_true, if_false);
}
sock_filter result(std::uint32_t value) { return BPF_STMT(BPF_RET | BPF_K, value); }

}  // namespace

void bound_resources(std::uint64_t memory_bytes, unsigned seconds) {
    if (address_space_can_be_bounded) set_limit(RLIMIT_AS, memory_bytes, memory_bytes);
    set_limit(RLIMIT_CPU, seconds, seconds + 1);
    set_limit(RLIMIT_CORE, 0, 0);
    alarm(2 * seconds);
}

bool renounce_network_and_programs() {
    if (architecture == 0) return false;
    constexpr std::uint8_t count = std::size(forbidden);
    std::vector<sock_filter> program = {
        load(offsetof(seccomp_data, arch)), jump(BPF_JEQ, architecture, 1, 0),
        result(SECCOMP_RET_KILL_PROCESS), load(offsetof(seccomp_data, nr)),
        jump(BPF_JGE, first_foreign_call, count + 1, 0)};
    for (std::uint8_t i = 0; i < count; ++i)
        program.push_back(jump(BPF_JEQ, forbidden[i], std::uint8_t(count - i), 0));
    program.push_back(result(SECCOMP_RET_ALLOW));
    program.push_back(result(SECCOMP_RET_ERRNO | EPERM));
    const sock_fprog filter{.len = static_cast<unsigned short>(program.size()),
                            .filter = program.data()};
    return prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0 &&
           prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &filter) == 0;
}

}  // namespace tessera
