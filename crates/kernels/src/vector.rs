//! Functions of one number for loops that are compiled once per instruction set, with fused multiply-add (`F`) where the set has it.
//! The functions of [`math`](crate::math) stay apart, because the losses of fields repeat bit for bit.

/// Compiles a function once per instruction set and chooses at run time; `F` tells the body whether multiply-add is one instruction.
macro_rules! vectorized {
    ($(#[$m:meta])* $vis:vis fn $name:ident<const $f:ident>($($arg:ident: $t:ty),* $(,)?) $(-> $ret:ty)? $body:block) => {
        $(#[$m])*
        $vis fn $name($($arg: $t),*) $(-> $ret)? {
            #[inline(always)]
            fn body<const $f: bool>($($arg: $t),*) $(-> $ret)? $body
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl,avx2,fma")]
            fn avx512($($arg: $t),*) $(-> $ret)? {
                body::<true>($($arg),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            fn avx2($($arg: $t),*) $(-> $ret)? {
                body::<true>($($arg),*)
            }
            match $crate::simd::level() {
                // SAFETY: `level()` only names sets that this CPU has.
                #[cfg(target_arch = "x86_64")]
                $crate::simd::Level::Avx512 => unsafe { avx512($($arg),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                $crate::simd::Level::Avx2 => unsafe { avx2($($arg),*) },
                #[cfg(target_arch = "aarch64")]
                $crate::simd::Level::Neon => body::<true>($($arg),*),
                _ => body::<false>($($arg),*),
            }
        }
    };
}
pub(crate) use vectorized;

/// Compiles a function that is generic over the [`Lane`](crate::simd::Lane) `$l` once per instruction set and chooses at run time.
macro_rules! by_lanes {
    ($(#[$m:meta])* $vis:vis unsafe fn $name:ident<$l:ident>($($arg:ident: $t:ty),* $(,)?) $body:block) => {
        $(#[$m])*
        $vis unsafe fn $name($($arg: $t),*) {
            #[inline(always)]
            unsafe fn body<$l: $crate::simd::Lane>($($arg: $t),*) {
                // SAFETY: as the caller of the outer function vouches.
                unsafe { $body }
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl,avx2,fma")]
            unsafe fn avx512($($arg: $t),*) {
                // SAFETY: compiled for the set.
                unsafe { body::<$crate::simd::Avx512>($($arg),*) }
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            unsafe fn avx2($($arg: $t),*) {
                // SAFETY: compiled for the set.
                unsafe { body::<$crate::simd::Avx2>($($arg),*) }
            }
            // SAFETY: `level()` only names sets that this CPU has.
            unsafe {
                match $crate::simd::level() {
                    #[cfg(target_arch = "x86_64")]
                    $crate::simd::Level::Avx512 => avx512($($arg),*),
                    #[cfg(target_arch = "x86_64")]
                    $crate::simd::Level::Avx2 => avx2($($arg),*),
                    #[cfg(target_arch = "aarch64")]
                    $crate::simd::Level::Neon => body::<$crate::simd::Neon>($($arg),*),
                    _ => body::<$crate::simd::Plain>($($arg),*),
                }
            }
        }
    };
}
pub(crate) use by_lanes;

/// `a b + c`
#[inline(always)]
pub(crate) fn fma<const F: bool>(a: f32, b: f32, c: f32) -> f32 {
    // A call of the C library where there is no such instruction.
    if F { a.mul_add(b, c) } else { a * b + c }
}

/// `Σ coefficients[i] xⁱ`
#[inline(always)]
fn polynomial<const F: bool, const N: usize>(x: f32, coefficients: [f32; N]) -> f32 {
    let mut sum = coefficients[N - 1];
    let mut i = N - 1;
    while i > 0 {
        i -= 1;
        sum = fma::<F>(sum, x, coefficients[i]);
    }
    sum
}

/// `x` within `−bound..=bound`; NaN stays.
#[inline(always)]
fn within(x: f32, bound: f32) -> f32 {
    let x = if x > bound { bound } else { x };
    if x < -bound { -bound } else { x }
}

/// `quotient` where `|x|` is below `bound`, else 1 with the sign of x, exactly, since slopes multiply what is missing to 1.
#[inline(always)]
fn saturated(x: f32, bound: f32, quotient: f32) -> f32 {
    let y = if x >= bound { 1.0 } else { within(quotient, 1.0) };
    if x <= -bound { -1.0 } else { y }
}

/// `eˣ` to about 2e-7: 0 below −87.3, that of 88.3 above it.
#[inline(always)]
pub(crate) fn exp<const F: bool>(x: f32) -> f32 {
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    // Adding 1.5 · 2²³ rounds to an integer, which then stands in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let y = if x > 88.3 { 88.3 } else { x };
    let y = if y < -87.3 { -87.3 } else { y };
    let z = fma::<F>(y, std::f32::consts::LOG2_E, ROUND);
    let n = z - ROUND;
    let r = fma::<F>(n, -LN2_LOW, fma::<F>(n, -LN2_HIGH, y));
    let p = polynomial::<F, 8>(r, [1.0, 1.0, 0.5, 1.0 / 6.0, 1.0 / 24.0, 1.0 / 120.0, 1.0 / 720.0, 1.0 / 5040.0]);
    let power = f32::from_bits((z.to_bits() << 23).wrapping_add(127 << 23));
    if x < -87.3 { 0.0 } else { p * power }
}

/// `1 / (1 + e⁻ˣ)`
#[inline(always)]
pub(crate) fn sigmoid<const F: bool>(x: f32) -> f32 {
    1.0 / (1.0 + exp::<F>(-x))
}

/// `tanh x` to 3e-7: a quotient of polynomials, fitted on 0..=9 to 1.3e-9.
#[inline(always)]
pub(crate) fn tanh<const F: bool>(x: f32) -> f32 {
    let y = within(x, 9.0);
    let s = y * y;
    let over = polynomial::<F, 6>(s, [1.0, 0.136_808_5, 3.869_499_5e-3, 2.803_114e-5, 3.064_211_5e-8, -1.224_594_2e-11]);
    let under = polynomial::<F, 5>(s, [1.0, 0.470_141_82, 2.725_012_6e-2, 3.940_698_4e-4, 1.289_023_1e-6]);
    saturated(x, 9.0, y * over / under)
}

/// `erf x` to 4e-7: a quotient of polynomials, fitted on 0..=3.9 to 1.8e-8.
#[inline(always)]
fn erf<const F: bool>(x: f32) -> f32 {
    let y = within(x, 3.9);
    let s = y * y;
    let over =
        polynomial::<F, 6>(s, [std::f32::consts::FRAC_2_SQRT_PI, 0.189_668_02, 5.266_819e-2, 3.738_385e-3, 2.850_609_5e-4, 2.066_435_3e-6]);
    let under = polynomial::<F, 6>(s, [1.0, 0.501_421_7, 0.113_819_404, 1.491_435_4e-2, 1.157_381_8e-3, 3.826_955e-5]);
    saturated(x, 3.9, y * over / under)
}

/// The normal distribution's `Φ(x)`.
#[inline(always)]
pub(crate) fn normal<const F: bool>(x: f32) -> f32 {
    fma::<F>(0.5, erf::<F>(x * std::f32::consts::FRAC_1_SQRT_2), 0.5)
}

/// `ln(1 + e)` for `e` in 0..=1: `2 artanh(e / (2 + e))`.
#[inline(always)]
pub(crate) fn ln_1p<const F: bool>(e: f32) -> f32 {
    let z = e / (2.0 + e);
    let series = [1.0, 1.0 / 3.0, 1.0 / 5.0, 1.0 / 7.0, 1.0 / 9.0, 1.0 / 11.0, 1.0 / 13.0, 1.0 / 15.0];
    2.0 * z * polynomial::<F, 8>(z * z, series)
}

/// Floats from which on a result is written past the caches, which could not hold it anyway.
pub(crate) const LARGE: usize = 1 << 23;

/// Copies to memory that is not read into the caches first. [`fence`] must follow before other threads read it.
pub(crate) fn stream(from: &[f32], to: &mut [f32]) {
    assert_eq!(from.len(), to.len());
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_mm_loadu_ps, _mm_stream_ps};
        let head = to.as_ptr().align_offset(16).min(to.len());
        to[..head].copy_from_slice(&from[..head]);
        let (from, to) = (&from[head..], &mut to[head..]);
        let whole = to.len() / 4 * 4;
        for i in (0..whole).step_by(4) {
            // SAFETY: four floats from i on exist in both; `to` begins at a multiple of 16 bytes; the set belongs to the architecture.
            unsafe { _mm_stream_ps(to.as_mut_ptr().add(i), _mm_loadu_ps(from.as_ptr().add(i))) };
        }
        to[whole..].copy_from_slice(&from[whole..]);
    }
    #[cfg(not(target_arch = "x86_64"))]
    to.copy_from_slice(from);
}

/// Orders what [`stream`] wrote before what this thread writes next.
pub(crate) fn fence() {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: the set belongs to the architecture.
    unsafe {
        std::arch::x86_64::_mm_sfence();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::activation::reference;
    use crate::simd::{Level, with_level};

    vectorized! {
        fn all<const F>(x: f32) -> [f32; 5] {
            [exp::<F>(x), sigmoid::<F>(x), tanh::<F>(x), normal::<F>(x), ln_1p::<F>(exp::<F>(-x.abs()))]
        }
    }

    #[test]
    fn they_match_f64_on_every_level() {
        for level in Level::available() {
            for i in -9000..9000 {
                let x = i as f32 * 0.0097;
                let [exp, sigmoid, tanh, normal, ln_1p] = with_level(level, || all(x)).map(|v| v as f64);
                let x = x as f64;
                assert!((exp - x.exp()).abs() <= 4e-7 * x.exp(), "exp {x}: {exp}");
                assert!((sigmoid - 1.0 / (1.0 + (-x).exp())).abs() < 3e-7, "sigmoid {x}: {sigmoid}");
                assert!((tanh - x.tanh()).abs() <= 4e-7 * x.tanh().abs(), "tanh {x}: {tanh}");
                let want = 0.5 + 0.5 * reference::erf(x / 2.0f64.sqrt());
                assert!((normal - want).abs() < 4e-7, "normal {x}: {normal}");
                let want = (-x.abs()).exp().ln_1p();
                assert!((ln_1p - want).abs() <= 6e-7 * want, "ln_1p {x}: {ln_1p}");
            }
        }
    }

    #[test]
    fn extremes_are_finite_and_nan_stays() {
        for level in Level::available() {
            let [e, s, t, n, _] = with_level(level, || all(f32::INFINITY));
            assert!(e > 1e38 && e.is_finite() && s == 1.0 && t == 1.0 && n == 1.0);
            let [e, s, t, n, _] = with_level(level, || all(f32::NEG_INFINITY));
            assert!(e == 0.0 && s < 1e-38 && t == -1.0 && n == 0.0);
            assert!(with_level(level, || all(f32::NAN)).iter().all(|v| v.is_nan()));
        }
    }

    #[test]
    fn streams_copy_from_and_to_any_place() {
        let from: Vec<f32> = (0..40).map(|i| i as f32).collect();
        for (start, n) in [(0, 0), (0, 1), (1, 2), (3, 17), (2, 32), (5, 35)] {
            let mut to = [-1.0f32; 40];
            stream(&from[start..start + n], &mut to[start..start + n]);
            fence();
            assert_eq!(to[start..start + n], from[start..start + n]);
            assert!(to[..start].iter().chain(&to[start + n..]).all(|v| *v == -1.0));
        }
    }
}
