#include "worker/kernels.h"

#include <fmt/format.h>

#include <array>
#include <cstdlib>
#include <string_view>
#include <utility>

#include "common/check.h"

// SSSE3 and the later AVX-512 add nothing that the kernels use.
#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_AVX3_DL)
// Highway mistrusts GCC 12.2 with its plain target for a bug in 16-bit products (GCC 106322), of
// which the kernels have none; the tests run this target like the others.
#define HWY_BROKEN_EMU128 0
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "worker/kernels.cpp"
#include "hwy/foreach_target.h"
// foreach_target.h comes first.
#include "hwy/highway.h"
#include "worker/primary-inl.h"
#include "worker/shadow-inl.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

constexpr Kernels<W> table{closest_hits, occluded, occluded_from, closest_from};

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace tessera {
namespace {

struct IsaName {
    Isa isa;
    std::string_view name;
    std::int64_t targets;  ///< Highway's, any of which will do
    int width;
};

// The best last.
constexpr IsaName isa_names[] = {{Isa::scalar, "scalar", HWY_STATIC_TARGET, 4},
#if HWY_ARCH_X86
                                 {Isa::sse4, "sse4", HWY_SSE4, 4},
                                 {Isa::avx2, "avx2", HWY_AVX2, 8},
                                 {Isa::avx512, "avx512", HWY_AVX3, 16}
#endif
};

bool runs(const IsaName& isa) {
    return isa.isa == Isa::scalar || (hwy::SupportedTargets() & isa.targets) != 0;
}

}  // namespace

Isa chosen_isa() {
    const char* const wanted = std::getenv("TESSERA_SIMD");
    Isa best = Isa::scalar;
    std::string names;
    for (const IsaName& isa : isa_names) {
        if (!runs(isa)) continue;
        if (wanted && isa.name == wanted) return isa.isa;
        best = isa.isa;
        names += fmt::format(" {}", isa.name);
    }
    if (wanted)
        throw UserError(fmt::format("TESSERA_SIMD={}: this machine runs{}; unset it for the best",
                                    wanted, names));
    return best;
}

int width_of(Isa isa) { return isa_names[int(isa)].width; }

template <>
const Kernels<4>& kernels([[maybe_unused]] Isa isa) {
#if HWY_ARCH_X86
    if (isa == Isa::sse4) return N_SSE4::table;
#endif
    return HWY_STATIC_DISPATCH(table);
}

#if HWY_ARCH_X86
template <>
const Kernels<8>& kernels(Isa) {
    return N_AVX2::table;
}

template <>
const Kernels<16>& kernels(Isa) {
    return N_AVX3::table;
}
#endif

}  // namespace tessera
#endif
