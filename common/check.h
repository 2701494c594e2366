// Three kinds of fault, never mixed:
//   our bug            CHECK, CHECK_EQ: print the values and abort the process that holds the bug
//   the peer's fault   throw ProtocolError (common/messages.h): closes that session only
//   the user's fault   throw UserError: a message that names the file, line or flag and what to do
#pragma once

#include <cstdio>
#include <cstdlib>
#include <sstream>
#include <stdexcept>
#include <string>

namespace tessera {

/// What the user gave cannot be used; `what()` names the file, line or flag and says what to do.
struct UserError : std::runtime_error {
    using std::runtime_error::runtime_error;
};

[[noreturn]] inline void check_failed(const char* file, int line, const std::string& what) {
    std::fprintf(stderr, "%s:%d: internal error: %s\n", file, line, what.c_str());
    std::abort();
}

template <class A, class B>
std::string describe_pair(const char* text, const A& a, const B& b) {
    std::ostringstream out;
    out << text << " (" << a << " against " << b << ")";
    return out.str();
}

}  // namespace tessera

#define CHECK(condition)                                                           \
    do {                                                                           \
        if (!(condition)) ::tessera::check_failed(__FILE__, __LINE__, #condition); \
    } while (false)

#define CHECK_EQ(a, b)                                                             \
    do {                                                                           \
        if (!((a) == (b)))                                                         \
            ::tessera::check_failed(__FILE__, __LINE__,                            \
                                    ::tessera::describe_pair(#a " == " #b, a, b)); \
    } while (false)

#ifdef NDEBUG
#define DCHECK(condition) \
    do {                  \
    } while (false)
#else
#define DCHECK(condition) CHECK(condition)
#endif
