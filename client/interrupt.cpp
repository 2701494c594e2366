#include "client/interrupt.h"

#include <signal.h>
#include <sys/signalfd.h>
#include <unistd.h>

#include "common/check.h"

namespace tessera {

Interrupt::Interrupt() {
    sigset_t set;
    sigemptyset(&set);
    for (const int signal : {SIGINT, SIGTERM, SIGHUP}) sigaddset(&set, signal);
    CHECK(sigprocmask(SIG_BLOCK, &set, nullptr) == 0);
    fd_ = signalfd(-1, &set, SFD_NONBLOCK | SFD_CLOEXEC);
    CHECK(fd_ >= 0);
}

Interrupt::~Interrupt() { close(fd_); }

void Interrupt::check() {
    signalfd_siginfo info;
    if (read(fd_, &info, sizeof info) == sizeof info) throw Interrupted{int(info.ssi_signo)};
}

}  // namespace tessera
