// Turns Ctrl-C and termination requests into a value to ask for, so that every exit runs its
// destructors.
#pragma once

namespace tessera {

/// Thrown where a command gives up because of a signal; main exits with 128 + signal.
struct Interrupted {
    int signal;
};

class Interrupt {
public:
    /// From here on SIGINT, SIGTERM and SIGHUP no longer end the process. Construct before any
    /// thread.
    Interrupt();
    ~Interrupt();
    Interrupt(const Interrupt&) = delete;
    Interrupt& operator=(const Interrupt&) = delete;

    /// Throws Interrupted once a signal has arrived.
    void check();

private:
    int fd_;
};

}  // namespace tessera
