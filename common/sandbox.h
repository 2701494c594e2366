// What a process gives up before it reads what a stranger has written.
#pragma once

#include <cstdint>

namespace tessera {

/// Bounds this process for good: address space (not under the address sanitizer, which needs all of
/// it), CPU time (SIGXCPU at the end), twice that until SIGALRM, no core dumps.
void bound_resources(std::uint64_t memory_bytes, unsigned seconds);

/// From now on this process makes no sockets, starts no programs and meddles with no other process:
/// such system calls fail with EPERM. By seccomp, which needs no privileges. Returns false where
/// the kernel does not offer it (or on a processor that this is not written for).
bool renounce_network_and_programs();

}  // namespace tessera
