//! One source for every vector width: kernels are generic over [`Lane`], compiled once per
//! instruction set, and chosen at run time.

use std::cell::Cell;
use std::sync::atomic::{AtomicU8, Ordering};

/// An instruction set that the kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// Plain Rust on arrays of eight floats; the compiler vectorizes it for the base target.
    Portable = 1,
    /// AVX2 with FMA, 8 floats.
    Avx2 = 2,
    /// AVX-512 (F, DQ, BW, VL), 16 floats.
    Avx512 = 3,
    /// NEON, 4 floats; every 64-bit ARM has it.
    Neon = 4,
}

impl Level {
    pub fn name(self) -> &'static str {
        match self {
            Level::Portable => "portable",
            Level::Avx2 => "avx2",
            Level::Avx512 => "avx512",
            Level::Neon => "neon",
        }
    }

    /// Whether this machine can run the level.
    pub fn is_available(self) -> bool {
        match self {
            Level::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512vl")
                    && Level::Avx2.is_available()
            }
            #[cfg(target_arch = "aarch64")]
            Level::Neon => true,
            _ => false,
        }
    }

    /// The levels that this machine can run, slowest first.
    pub fn available() -> Vec<Level> {
        [Level::Portable, Level::Avx2, Level::Avx512, Level::Neon].into_iter().filter(|l| l.is_available()).collect()
    }
}

static ACTIVE: AtomicU8 = AtomicU8::new(0);

thread_local! {
    static FORCED: Cell<Option<Level>> = const { Cell::new(None) };
}

/// The level in use: the best available, or what `DIORAMA_SIMD` or [`with_level`] says.
pub fn level() -> Level {
    if let Some(level) = FORCED.get() {
        return level;
    }
    match ACTIVE.load(Ordering::Relaxed) {
        1 => Level::Portable,
        2 => Level::Avx2,
        3 => Level::Avx512,
        4 => Level::Neon,
        _ => {
            let best = *Level::available().last().unwrap_or(&Level::Portable);
            let wanted = std::env::var("DIORAMA_SIMD").ok();
            let chosen = wanted.and_then(|w| Level::available().into_iter().find(|l| l.name() == w)).unwrap_or(best);
            ACTIVE.store(chosen as u8, Ordering::Relaxed);
            chosen
        }
    }
}

/// Runs `work` with `level` in every kernel that this thread calls; other threads keep theirs.
///
/// # Panics
/// When this machine cannot run it.
pub fn with_level<R>(level: Level, work: impl FnOnce() -> R) -> R {
    assert!(level.is_available(), "this CPU has no {}", level.name());
    let before = FORCED.replace(Some(level));
    let result = work();
    FORCED.set(before);
    result
}

/// A vector of floats. Methods must be inlined into a function compiled for the instruction set.
///
/// # Safety
/// Every method may only run on a CPU that has the set; pointers must be valid for `N` floats.
#[allow(clippy::missing_safety_doc)] // stated once, above
pub unsafe trait Lane: Copy {
    const N: usize;
    type V: Copy;
    unsafe fn splat(x: f32) -> Self::V;
    unsafe fn load(p: *const f32) -> Self::V;
    unsafe fn store(p: *mut f32, v: Self::V);
    /// `a * b + c`
    unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    unsafe fn max(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn sub(a: Self::V, b: Self::V) -> Self::V;
    /// `v`, computed by now: keeps the compiler from mixing what comes before with what comes after.
    unsafe fn settle(v: Self::V) -> Self::V;
    /// The even and the odd ones of the floats of `a`, then `b`.
    unsafe fn pairs(a: Self::V, b: Self::V) -> (Self::V, Self::V);
    /// The even and the odd ones of `2 N` floats.
    #[inline(always)]
    unsafe fn load_pairs(p: *const f32) -> (Self::V, Self::V) {
        // SAFETY: the caller guarantees that many readable floats.
        unsafe { Self::pairs(Self::load(p), Self::load(p.add(Self::N))) }
    }
    /// `2 N` floats, of `even` and `odd` in turns.
    unsafe fn store_pairs(p: *mut f32, even: Self::V, odd: Self::V);
}

/// Plain arrays.
#[derive(Clone, Copy)]
pub struct Plain;

// SAFETY: no special instructions.
unsafe impl Lane for Plain {
    const N: usize = 8;
    type V = [f32; 8];
    #[inline(always)]
    unsafe fn splat(x: f32) -> [f32; 8] {
        [x; 8]
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> [f32; 8] {
        // SAFETY: the caller guarantees eight readable floats.
        unsafe { p.cast::<[f32; 8]>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn store(p: *mut f32, v: [f32; 8]) {
        // SAFETY: the caller guarantees eight writable floats.
        unsafe { p.cast::<[f32; 8]>().write_unaligned(v) }
    }
    #[inline(always)]
    unsafe fn fma(a: [f32; 8], b: [f32; 8], c: [f32; 8]) -> [f32; 8] {
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    unsafe fn max(a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        std::array::from_fn(|i| if a[i] > b[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    unsafe fn add(a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        std::array::from_fn(|i| a[i] + b[i])
    }
    #[inline(always)]
    unsafe fn sub(a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        std::array::from_fn(|i| a[i] - b[i])
    }
    #[inline(always)]
    unsafe fn settle(v: [f32; 8]) -> [f32; 8] {
        v
    }
    #[inline(always)]
    unsafe fn pairs(a: [f32; 8], b: [f32; 8]) -> ([f32; 8], [f32; 8]) {
        let at = |i: usize| if i < 8 { a[i] } else { b[i - 8] };
        (std::array::from_fn(|i| at(2 * i)), std::array::from_fn(|i| at(2 * i + 1)))
    }
    #[inline(always)]
    unsafe fn store_pairs(p: *mut f32, even: [f32; 8], odd: [f32; 8]) {
        let all: [[f32; 2]; 8] = std::array::from_fn(|i| [even[i], odd[i]]);
        // SAFETY: the caller guarantees sixteen writable floats.
        unsafe { p.cast::<[[f32; 2]; 8]>().write_unaligned(all) }
    }
}

#[cfg(target_arch = "x86_64")]
pub use x86::{Avx2, Avx512};

#[cfg(target_arch = "aarch64")]
pub use arm::Neon;

#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! lane {
    ($(#[$doc:meta])* $name:ident, $n:literal, $v:ty, $set:ident, $load:ident, $store:ident, $fma:expr, $max:ident,
     $add:ident, $sub:ident, $settle:ident, $pairs:ident, $store_pairs:ident) => {
        $(#[$doc])*
        #[derive(Clone, Copy)]
        pub struct $name;
        // SAFETY: callers uphold the trait's contract: right CPU, valid pointers.
        #[allow(unused_unsafe)]
        unsafe impl Lane for $name {
            const N: usize = $n;
            type V = $v;
            #[inline(always)]
            unsafe fn splat(x: f32) -> $v {
                // SAFETY: see the impl.
                unsafe { $set(x) }
            }
            #[inline(always)]
            unsafe fn load(p: *const f32) -> $v {
                // SAFETY: see the impl.
                unsafe { $load(p) }
            }
            #[inline(always)]
            unsafe fn store(p: *mut f32, v: $v) {
                // SAFETY: see the impl.
                unsafe { $store(p, v) }
            }
            #[inline(always)]
            unsafe fn fma(a: $v, b: $v, c: $v) -> $v {
                // SAFETY: see the impl.
                unsafe { ($fma)(a, b, c) }
            }
            #[inline(always)]
            unsafe fn max(a: $v, b: $v) -> $v {
                // SAFETY: see the impl.
                unsafe { $max(a, b) }
            }
            #[inline(always)]
            unsafe fn add(a: $v, b: $v) -> $v {
                // SAFETY: see the impl.
                unsafe { $add(a, b) }
            }
            #[inline(always)]
            unsafe fn sub(a: $v, b: $v) -> $v {
                // SAFETY: see the impl.
                unsafe { $sub(a, b) }
            }
            #[inline(always)]
            unsafe fn settle(v: $v) -> $v {
                // SAFETY: see the impl.
                unsafe { $settle(v) }
            }
            #[inline(always)]
            unsafe fn pairs(a: $v, b: $v) -> ($v, $v) {
                // SAFETY: see the impl.
                unsafe { $pairs(a, b) }
            }
            #[inline(always)]
            unsafe fn store_pairs(p: *mut f32, even: $v, odd: $v) {
                // SAFETY: see the impl.
                unsafe { $store_pairs(p, even, odd) }
            }
        }
    };
}

#[cfg(target_arch = "aarch64")]
mod arm {
    use super::Lane;
    use std::arch::aarch64::*;

    lane!(
        /// 128-bit vectors.
        Neon, 4, float32x4_t, vdupq_n_f32, vld1q_f32, vst1q_f32, |a, b, c| vfmaq_f32(c, a, b), vmaxq_f32,
        vaddq_f32, vsubq_f32, settle, pairs, store_pairs
    );

    #[inline(always)]
    unsafe fn settle(mut v: float32x4_t) -> float32x4_t {
        // SAFETY: no instruction.
        unsafe { std::arch::asm!("/* {v:v} */", v = inout(vreg) v, options(nomem, nostack, preserves_flags)) };
        v
    }

    #[inline(always)]
    unsafe fn pairs(a: float32x4_t, b: float32x4_t) -> (float32x4_t, float32x4_t) {
        // SAFETY: as `Lane` states.
        unsafe { (vuzp1q_f32(a, b), vuzp2q_f32(a, b)) }
    }

    #[inline(always)]
    unsafe fn store_pairs(p: *mut f32, even: float32x4_t, odd: float32x4_t) {
        // SAFETY: as `Lane` states.
        unsafe { vst2q_f32(p, float32x4x2_t(even, odd)) }
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::Lane;
    use std::arch::x86_64::*;

    lane!(
        /// 256-bit vectors.
        Avx2, 8, __m256, _mm256_set1_ps, _mm256_loadu_ps, _mm256_storeu_ps, _mm256_fmadd_ps, _mm256_max_ps,
        _mm256_add_ps, _mm256_sub_ps, settle_256, pairs_256, store_pairs_256
    );
    lane!(
        /// 512-bit vectors.
        Avx512, 16, __m512, _mm512_set1_ps, _mm512_loadu_ps, _mm512_storeu_ps, _mm512_fmadd_ps, _mm512_max_ps,
        _mm512_add_ps, _mm512_sub_ps, settle_512, pairs_512, store_pairs_512
    );

    #[inline]
    #[target_feature(enable = "avx2")]
    fn settle_256(mut v: __m256) -> __m256 {
        // SAFETY: no instruction.
        unsafe { std::arch::asm!("/* {v} */", v = inout(ymm_reg) v, options(nomem, nostack, preserves_flags)) };
        v
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn settle_512(mut v: __m512) -> __m512 {
        // SAFETY: no instruction.
        unsafe { std::arch::asm!("/* {v} */", v = inout(zmm_reg) v, options(nomem, nostack, preserves_flags)) };
        v
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn pairs_256(a: __m256, b: __m256) -> (__m256, __m256) {
        // The halves of both come in turns, and are put in order.
        let order = |v| _mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(_mm256_castps_pd(v)));
        (order(_mm256_shuffle_ps::<0b10_00_10_00>(a, b)), order(_mm256_shuffle_ps::<0b11_01_11_01>(a, b)))
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    unsafe fn store_pairs_256(p: *mut f32, even: __m256, odd: __m256) {
        let (low, high) = (_mm256_unpacklo_ps(even, odd), _mm256_unpackhi_ps(even, odd));
        // SAFETY: as `Lane` states.
        unsafe {
            _mm256_storeu_ps(p, _mm256_permute2f128_ps::<0x20>(low, high));
            _mm256_storeu_ps(p.add(8), _mm256_permute2f128_ps::<0x31>(low, high));
        }
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn pairs_512(a: __m512, b: __m512) -> (__m512, __m512) {
        let even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
        let odd = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
        (_mm512_permutex2var_ps(a, even, b), _mm512_permutex2var_ps(a, odd, b))
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    unsafe fn store_pairs_512(p: *mut f32, even: __m512, odd: __m512) {
        let low = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
        let high = _mm512_setr_epi32(8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
        // SAFETY: as `Lane` states.
        unsafe {
            _mm512_storeu_ps(p, _mm512_permutex2var_ps(even, low, odd));
            _mm512_storeu_ps(p.add(16), _mm512_permutex2var_ps(even, high, odd));
        }
    }
}

/// Prefetches floats that will be read some thousand cycles later; a hint that changes no result.
#[inline(always)]
pub fn fetch_later(first: *const f32, floats: usize) {
    #[cfg(target_arch = "x86_64")]
    for line in (0..floats).step_by(16) {
        use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
        // SAFETY: a hint, which may name any address; the set belongs to the architecture.
        unsafe { _mm_prefetch::<_MM_HINT_T1>(first.wrapping_add(line).cast::<i8>()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (first, floats);
}

/// Prefetches floats that are about to be read and written.
#[inline(always)]
pub fn fetch_now(first: *const f32, floats: usize) {
    #[cfg(target_arch = "x86_64")]
    for line in (0..floats).step_by(16) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: as above.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(first.wrapping_add(line).cast::<i8>()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (first, floats);
}

/// Prefetches floats that are about to be written.
#[inline]
pub fn fetch_to_write(first: *mut f32, floats: usize) {
    #[cfg(target_arch = "x86_64")]
    for line in (0..floats + 15).step_by(16) {
        use std::arch::x86_64::{_MM_HINT_ET0, _mm_prefetch};
        // SAFETY: as above.
        unsafe { _mm_prefetch::<_MM_HINT_ET0>(first.wrapping_add(line.min(floats)).cast::<i8>()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (first, floats);
}
