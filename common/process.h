// The life of a process among its relatives.
#pragma once

#include <sys/types.h>

#include <cstdint>

namespace tessera {

/// Kills this process (SIGKILL) when its parent ends, however that happens, or now if it has ended.
/// `parent` is what the parent itself takes for its number: to ask the kernel is to ask too late,
/// if the parent ended before. The kernel takes the death of the *thread* that started this process
/// for the parent's: a program that starts such children does so from a thread that outlives them.
void end_with_parent(pid_t parent);

/// Memory of this process that is resident, in bytes.
std::uint64_t resident_bytes();

}  // namespace tessera
