// What CUDA C++ takes for granted, for kernels compiled by the machine's own C++ compiler. Every unit of a cube is a
// fiber; those of a cube take turns, and a barrier is where they yield.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

struct uint3 {
    unsigned x, y, z;
};

namespace cuda_on_cpu {
struct Place {
    uint3 thread, block, block_dim, grid_dim;
};
// Set by the driver before it runs a unit.
inline thread_local Place place;
inline thread_local char *shared_memory;
// A barrier of the unit's 32 neighbours, or of its whole cube.
inline thread_local void (*wait_for)(bool whole_cube);

template <class... A, size_t... I> void call(void (*f)(A...), void **p, std::index_sequence<I...>) {
    f(*static_cast<std::remove_const_t<std::remove_reference_t<A>> *>(p[I])...);
}
template <class... A> void call(void (*f)(A...), void **p) { call(f, p, std::index_sequence_for<A...>()); }

inline float atomic_add(float *at, float v) {
    auto bits = reinterpret_cast<uint32_t *>(at);
    uint32_t old = __atomic_load_n(bits, __ATOMIC_RELAXED), next;
    float was;
    do {
        std::memcpy(&was, &old, 4);
        float sum = was + v;
        std::memcpy(&next, &sum, 4);
    } while (!__atomic_compare_exchange_n(bits, &old, next, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED));
    return was;
}
inline uint32_t atomic_add(uint32_t *at, uint32_t v) { return __atomic_fetch_add(at, v, __ATOMIC_RELAXED); }
inline uint32_t atomic_or(uint32_t *at, uint32_t v) { return __atomic_fetch_or(at, v, __ATOMIC_RELAXED); }
inline uint32_t atomic_and(uint32_t *at, uint32_t v) { return __atomic_fetch_and(at, v, __ATOMIC_RELAXED); }
inline uint32_t atomic_exch(uint32_t *at, uint32_t v) { return __atomic_exchange_n(at, v, __ATOMIC_RELAXED); }
inline uint32_t atomic_max(uint32_t *at, uint32_t v) {
    uint32_t old = __atomic_load_n(at, __ATOMIC_RELAXED);
    while (old < v && !__atomic_compare_exchange_n(at, &old, v, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
    }
    return old;
}
inline uint32_t atomic_min(uint32_t *at, uint32_t v) {
    uint32_t old = __atomic_load_n(at, __ATOMIC_RELAXED);
    while (old > v && !__atomic_compare_exchange_n(at, &old, v, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
    }
    return old;
}
inline uint32_t atomic_cas(uint32_t *at, uint32_t compare, uint32_t v) {
    __atomic_compare_exchange_n(at, &compare, v, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED);
    return compare;
}
} // namespace cuda_on_cpu

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __grid_constant__
#define __align__(n)
#define threadIdx (cuda_on_cpu::place.thread)
#define blockIdx (cuda_on_cpu::place.block)
#define blockDim (cuda_on_cpu::place.block_dim)
#define gridDim (cuda_on_cpu::place.grid_dim)
inline void __syncthreads() { cuda_on_cpu::wait_for(true); }
inline void __syncwarp() { cuda_on_cpu::wait_for(false); }
inline void __threadfence() {}

using std::max;
using std::min;
inline unsigned __umulhi(unsigned a, unsigned b) { return (uint64_t(a) * b) >> 32; }
inline float __expf(float x) { return expf(x); }
inline float __logf(float x) { return logf(x); }
inline float __sinf(float x) { return sinf(x); }
inline float __cosf(float x) { return cosf(x); }
inline float __powf(float x, float y) { return powf(x, y); }
inline float __fdividef(float a, float b) { return a / b; }
inline float __frcp_rn(float a) { return 1.0f / a; }
inline float __fsqrt_rn(float a) { return sqrtf(a); }
inline float __frsqrt_rn(float a) { return 1.0f / sqrtf(a); }
inline float rsqrtf(float a) { return 1.0f / sqrtf(a); }
inline float __saturatef(float a) { return fminf(fmaxf(a, 0.0f), 1.0f); }
inline int __popc(unsigned v) { return __builtin_popcount(v); }
inline int __clz(unsigned v) { return v ? __builtin_clz(v) : 32; }
inline int __ffs(unsigned v) { return __builtin_ffs(v); }
inline unsigned __brev(unsigned v) {
    unsigned r = 0;
    for (int i = 0; i < 32; i++, v >>= 1) r = r << 1 | (v & 1);
    return r;
}
inline unsigned __float_as_uint(float f) { unsigned u; std::memcpy(&u, &f, 4); return u; }
inline float __uint_as_float(unsigned u) { float f; std::memcpy(&f, &u, 4); return f; }
