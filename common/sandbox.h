// What a process gives up before it reads what a stranger has written.
#pragma once

#include <cstdint>

namespace tessera {

// Sanitizers need all address space there is.
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
inline constexpr bool address_space_can_be_bounded = false;
#elif defined(__has_feature)
inline constexpr bool address_space_can_be_bounded =
    !(__has_feature(address_sanitizer) || __has_feature(thread_sanitizer));
#else
inline constexpr bool address_space_can_be_bounded = true;
#endif

/// Bounds this process for good: address space (where it can be), CPU time (SIGXCPU at the end),
/// twice that until SIGALRM, no core dumps.
void bound_resources(std::uint64_t memory_bytes, unsigned seconds);

/// From now on this process makes no sockets, starts no programs and meddles with no other process:
/// such system calls fail with EPERM. By seccomp, which needs no privileges. Returns false where
/// the kernel does not offer it (or on a processor that this is not written for).
bool renounce_network_and_programs();

}  // namespace tessera
