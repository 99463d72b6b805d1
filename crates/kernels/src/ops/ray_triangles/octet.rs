//! Eight floats at a time, whatever the width of the CPU's vectors.

use super::WIDTH;
use std::mem::MaybeUninit;

/// Operations on eight floats of one instruction set.
///
/// # Safety
/// Implementations rely on their instruction set, which callers guarantee.
pub unsafe trait Octet: Copy {
    unsafe fn splat(v: f32) -> Self;
    unsafe fn load(v: &[f32; WIDTH]) -> Self;
    unsafe fn store(self, to: &mut [f32; WIDTH]);
    unsafe fn add(self, b: Self) -> Self;
    unsafe fn sub(self, b: Self) -> Self;
    unsafe fn mul(self, b: Self) -> Self;
    unsafe fn div(self, b: Self) -> Self;
    /// The larger one, `b` if either is not a number.
    unsafe fn max(self, b: Self) -> Self;
    /// The smaller one, `b` if either is not a number.
    unsafe fn min(self, b: Self) -> Self;
    /// Bit `i`: whether `self[i] ≤ b[i]`.
    unsafe fn at_most(self, b: Self) -> u32;
    /// Bit `i`: whether `self[i] < b[i]`.
    unsafe fn below(self, b: Self) -> u32;
    /// Whether [`Octet::compress`] is there.
    const COMPRESSES: bool;
    /// Writes the entries of the contents whose bits are set, one after the other but without the nearest, which is returned;
    /// `self` are their distances. Some bit must be set. All of `to` may be overwritten.
    unsafe fn compress(self, _set: u32, _contents: &[u32; WIDTH], _to: &mut [MaybeUninit<Entry>; WIDTH]) -> Entry {
        unreachable!("only where COMPRESSES is true")
    }
}

/// A node or packet in the lower half, and in the upper one the distance of its box, as integers that sort like distances.
pub type Entry = i64;

/// An entry from a distance and what is there.
#[inline(always)]
pub fn entry(distance: f32, content: u32) -> Entry {
    (ordered(distance) as i64) << 32 | content as i64
}

/// An integer that is smaller for smaller numbers.
#[inline(always)]
pub fn ordered(v: f32) -> i32 {
    let bits = v.to_bits() as i32;
    bits ^ (bits >> 31) & i32::MAX
}

/// Plain arrays.
#[derive(Clone, Copy)]
pub struct Plain([f32; WIDTH]);

macro_rules! each {
    ($a:expr, $b:expr, $op:expr) => {
        Plain(std::array::from_fn(|i| $op($a.0[i], $b.0[i])))
    };
}

#[inline(always)]
fn bits(of: impl Fn(usize) -> bool) -> u32 {
    (0..WIDTH).fold(0, |bits, i| bits | (of(i) as u32) << i)
}

// SAFETY: no special instructions.
unsafe impl Octet for Plain {
    const COMPRESSES: bool = false;
    #[inline(always)]
    unsafe fn splat(v: f32) -> Self {
        Plain([v; WIDTH])
    }
    #[inline(always)]
    unsafe fn load(v: &[f32; WIDTH]) -> Self {
        Plain(*v)
    }
    #[inline(always)]
    unsafe fn store(self, to: &mut [f32; WIDTH]) {
        *to = self.0;
    }
    #[inline(always)]
    unsafe fn add(self, b: Self) -> Self {
        each!(self, b, |a: f32, b: f32| a + b)
    }
    #[inline(always)]
    unsafe fn sub(self, b: Self) -> Self {
        each!(self, b, |a: f32, b: f32| a - b)
    }
    #[inline(always)]
    unsafe fn mul(self, b: Self) -> Self {
        each!(self, b, |a: f32, b: f32| a * b)
    }
    #[inline(always)]
    unsafe fn div(self, b: Self) -> Self {
        each!(self, b, |a: f32, b: f32| a / b)
    }
    #[inline(always)]
    unsafe fn max(self, b: Self) -> Self {
        each!(self, b, |a: f32, b: f32| if a > b { a } else { b })
    }
    #[inline(always)]
    unsafe fn min(self, b: Self) -> Self {
        each!(self, b, |a: f32, b: f32| if a < b { a } else { b })
    }
    #[inline(always)]
    unsafe fn at_most(self, b: Self) -> u32 {
        bits(|i| self.0[i] <= b.0[i])
    }
    #[inline(always)]
    unsafe fn below(self, b: Self) -> u32 {
        bits(|i| self.0[i] < b.0[i])
    }
}

#[cfg(target_arch = "x86_64")]
pub use x86::{Avx2, Avx512};

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{Entry, Octet, WIDTH};
    use std::arch::x86_64::*;
    use std::mem::MaybeUninit;

    /// 256-bit vectors, with the instructions that AVX-512 has for them or without.
    #[derive(Clone, Copy)]
    pub struct Eight<const AVX512: bool>(__m256);

    pub type Avx2 = Eight<false>;
    pub type Avx512 = Eight<true>;

    // SAFETY: callers guarantee AVX2, and AVX-512 (F, DQ, BW, VL) if so marked.
    #[allow(unused_unsafe)]
    unsafe impl<const AVX512: bool> Octet for Eight<AVX512> {
        const COMPRESSES: bool = AVX512;
        #[inline(always)]
        unsafe fn compress(self, set: u32, contents: &[u32; WIDTH], to: &mut [MaybeUninit<Entry>; WIDTH]) -> Entry {
            let set = set as u8;
            // SAFETY: see the impl; `contents` and `to` have eight elements.
            unsafe {
                let bits = _mm256_castps_si256(self.0);
                let flip = _mm256_and_si256(_mm256_srai_epi32::<31>(bits), _mm256_set1_epi32(i32::MAX));
                let distances = _mm512_cvtepi32_epi64(_mm256_xor_si256(bits, flip));
                let contents = _mm512_cvtepu32_epi64(_mm256_loadu_si256(contents.as_ptr().cast()));
                let entries = _mm512_or_si512(_mm512_slli_epi64::<32>(distances), contents);
                let nearest = _mm512_mask_reduce_min_epi64(set, entries);
                let others = set & _mm512_cmpneq_epi64_mask(entries, _mm512_set1_epi64(nearest));
                _mm512_storeu_si512(to.as_mut_ptr().cast(), _mm512_maskz_compress_epi64(others, entries));
                nearest
            }
        }
        #[inline(always)]
        unsafe fn splat(v: f32) -> Self {
            // SAFETY: see the impl.
            Eight(unsafe { _mm256_set1_ps(v) })
        }
        #[inline(always)]
        unsafe fn load(v: &[f32; WIDTH]) -> Self {
            // SAFETY: see the impl.
            Eight(unsafe { _mm256_loadu_ps(v.as_ptr()) })
        }
        #[inline(always)]
        unsafe fn store(self, to: &mut [f32; WIDTH]) {
            // SAFETY: see the impl.
            unsafe { _mm256_storeu_ps(to.as_mut_ptr(), self.0) }
        }
        #[inline(always)]
        unsafe fn add(self, b: Self) -> Self {
            // SAFETY: see the impl.
            Eight(unsafe { _mm256_add_ps(self.0, b.0) })
        }
        #[inline(always)]
        unsafe fn sub(self, b: Self) -> Self {
            // SAFETY: see the impl.
            Eight(unsafe { _mm256_sub_ps(self.0, b.0) })
        }
        #[inline(always)]
        unsafe fn mul(self, b: Self) -> Self {
            // SAFETY: see the impl.
            Eight(unsafe { _mm256_mul_ps(self.0, b.0) })
        }
        #[inline(always)]
        unsafe fn div(self, b: Self) -> Self {
            // SAFETY: see the impl.
            Eight(unsafe { _mm256_div_ps(self.0, b.0) })
        }
        #[inline(always)]
        unsafe fn max(self, b: Self) -> Self {
            // SAFETY: see the impl.
            Eight(unsafe { _mm256_max_ps(self.0, b.0) })
        }
        #[inline(always)]
        unsafe fn min(self, b: Self) -> Self {
            // SAFETY: see the impl.
            Eight(unsafe { _mm256_min_ps(self.0, b.0) })
        }
        #[inline(always)]
        unsafe fn at_most(self, b: Self) -> u32 {
            // SAFETY: see the impl.
            unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(self.0, b.0)) as u32 }
        }
        #[inline(always)]
        unsafe fn below(self, b: Self) -> u32 {
            // SAFETY: see the impl.
            unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, b.0)) as u32 }
        }
    }
}
