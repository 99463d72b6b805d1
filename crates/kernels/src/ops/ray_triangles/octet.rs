//! Eight floats at a time, whatever the width of the CPU's vectors.

use super::WIDTH;

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
pub use x86::Avx2;

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{Octet, WIDTH};
    use std::arch::x86_64::*;

    /// 256-bit vectors.
    #[derive(Clone, Copy)]
    pub struct Avx2(__m256);

    // SAFETY: callers guarantee AVX2.
    #[allow(unused_unsafe)]
    unsafe impl Octet for Avx2 {
        #[inline(always)]
        unsafe fn splat(v: f32) -> Self {
            // SAFETY: see the impl.
            Avx2(unsafe { _mm256_set1_ps(v) })
        }
        #[inline(always)]
        unsafe fn load(v: &[f32; WIDTH]) -> Self {
            // SAFETY: see the impl.
            Avx2(unsafe { _mm256_loadu_ps(v.as_ptr()) })
        }
        #[inline(always)]
        unsafe fn store(self, to: &mut [f32; WIDTH]) {
            // SAFETY: see the impl.
            unsafe { _mm256_storeu_ps(to.as_mut_ptr(), self.0) }
        }
        #[inline(always)]
        unsafe fn add(self, b: Self) -> Self {
            // SAFETY: see the impl.
            Avx2(unsafe { _mm256_add_ps(self.0, b.0) })
        }
        #[inline(always)]
        unsafe fn sub(self, b: Self) -> Self {
            // SAFETY: see the impl.
            Avx2(unsafe { _mm256_sub_ps(self.0, b.0) })
        }
        #[inline(always)]
        unsafe fn mul(self, b: Self) -> Self {
            // SAFETY: see the impl.
            Avx2(unsafe { _mm256_mul_ps(self.0, b.0) })
        }
        #[inline(always)]
        unsafe fn div(self, b: Self) -> Self {
            // SAFETY: see the impl.
            Avx2(unsafe { _mm256_div_ps(self.0, b.0) })
        }
        #[inline(always)]
        unsafe fn max(self, b: Self) -> Self {
            // SAFETY: see the impl.
            Avx2(unsafe { _mm256_max_ps(self.0, b.0) })
        }
        #[inline(always)]
        unsafe fn min(self, b: Self) -> Self {
            // SAFETY: see the impl.
            Avx2(unsafe { _mm256_min_ps(self.0, b.0) })
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
