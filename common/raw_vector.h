// A vector whose elements are not touched before they are written: by many threads, say. It begins
// with a cache line.
#pragma once

#include <algorithm>
#include <cstddef>
#include <memory>
#include <new>
#include <vector>

namespace tessera {

template <class T>
struct RawAllocator : std::allocator<T> {
    template <class U>
    struct rebind {
        using other = RawAllocator<U>;
    };
    static constexpr std::align_val_t alignment{std::max<std::size_t>(64, alignof(T))};

    T* allocate(std::size_t count) {
        return static_cast<T*>(::operator new(count * sizeof(T), alignment));
    }
    void deallocate(T* place, std::size_t) { ::operator delete(place, alignment); }

    template <class U>
    void construct(U* place) {
        ::new (static_cast<void*>(place)) U;  // no parentheses: plain data stays as it is
    }
    template <class U, class... Args>
    void construct(U* place, Args&&... args) {
        std::construct_at(place, std::forward<Args>(args)...);
    }
};

/// For plain data: resize() leaves new elements without a value.
template <class T>
using RawVector = std::vector<T, RawAllocator<T>>;

}  // namespace tessera
