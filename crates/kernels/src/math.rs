//! Functions of slices that compile to vector code on every level.

/// Compiles a function once per instruction set and chooses at run time.
macro_rules! multiversion {
    ($(#[$m:meta])* $vis:vis fn $name:ident($($arg:ident: $t:ty),* $(,)?) $(-> $ret:ty)? $body:block) => {
        $(#[$m])*
        $vis fn $name($($arg: $t),*) $(-> $ret)? {
            #[inline(always)]
            fn body($($arg: $t),*) $(-> $ret)? $body
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl,avx2,fma")]
            fn avx512($($arg: $t),*) $(-> $ret)? {
                body($($arg),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            fn avx2($($arg: $t),*) $(-> $ret)? {
                body($($arg),*)
            }
            match $crate::simd::level() {
                // SAFETY: `level()` only names sets that this CPU has.
                #[cfg(target_arch = "x86_64")]
                $crate::simd::Level::Avx512 => unsafe { avx512($($arg),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                $crate::simd::Level::Avx2 => unsafe { avx2($($arg),*) },
                _ => body($($arg),*),
            }
        }
    };
}
pub(crate) use multiversion;

/// `eˣ` to about 2e-7, 0 below −87.3, `f32::MAX` at most: `2ⁿ · P(r)` with `|r| ≤ ln 2 / 2`.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    let clamped = x.clamp(-87.3, 88.7);
    // Adding 1.5 · 2²³ rounds to an integer, which then stands in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let z = clamped * std::f32::consts::LOG2_E + ROUND;
    let (n, bits) = (z - ROUND, z.to_bits().wrapping_sub(ROUND.to_bits()) as i32);
    let r = (clamped - n * LN2_HIGH) - n * LN2_LOW;
    // Taylor to the seventh power: the rest is below 3e-8 on this range.
    let p = 1.0 + r * (1.0 + r * (0.5 + r * (1.0 / 6.0 + r * (1.0 / 24.0 + r * (1.0 / 120.0 + r * (1.0 / 720.0 + r * (1.0 / 5040.0)))))));
    // Two factors, as 2ⁿ alone may overflow.
    let half = bits >> 1;
    let power = |k: i32| f32::from_bits((k.wrapping_add(127) << 23) as u32);
    let y = p * power(half) * power(bits.wrapping_sub(half));
    if x < -87.3 {
        0.0
    } else if y > f32::MAX {
        f32::MAX
    } else {
        y
    }
}

/// `1 − e⁻ˣ` for `x ≥ 0`, exact to rounding where x is small.
#[inline(always)]
pub fn one_minus_exp_neg(x: f32) -> f32 {
    // Taylor's series where the difference would cancel.
    let series = x * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0 - x * (1.0 / 120.0 - x * (1.0 / 720.0 - x * (1.0 / 5040.0)))))));
    if x < 0.4 { series } else { 1.0 - exp(-x) }
}

multiversion! {
    /// `x ← eˣ`
    pub fn exp_in_place(values: &mut [f32]) {
        values.iter_mut().for_each(|v| *v = exp(*v));
    }
}

multiversion! {
    /// `x ← 1 / (1 + e⁻ˣ)`
    pub fn sigmoid_in_place(values: &mut [f32]) {
        values.iter_mut().for_each(|v| *v = 1.0 / (1.0 + exp(-*v)));
    }
}

multiversion! {
    /// `x ← tanh x`
    pub fn tanh_in_place(values: &mut [f32]) {
        values.iter_mut().for_each(|v| {
            let rest = one_minus_exp_neg(2.0 * v.abs());
            *v = (rest / (2.0 - rest)).copysign(*v);
        });
    }
}

multiversion! {
    /// `x ← x / (1 + e⁻ˣ)`
    pub fn silu_in_place(values: &mut [f32]) {
        values.iter_mut().for_each(|v| *v /= 1.0 + exp(-*v));
    }
}

multiversion! {
    /// `d ← d · silu'(x)`
    pub fn silu_backward(x: &[f32], d: &mut [f32]) {
        for (d, x) in d.iter_mut().zip(x) {
            let s = 1.0 / (1.0 + exp(-*x));
            *d *= s * (1.0 + x * (1.0 - s));
        }
    }
}

multiversion! {
    /// Opacities `1 − e^(−σ δ)`.
    pub fn alphas(sigma: &[f32], dt: &[f32], out: &mut [f32]) {
        for ((o, s), d) in out.iter_mut().zip(sigma).zip(dt) {
            *o = one_minus_exp_neg(s * d);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Level, with_level};

    #[test]
    fn they_match_f64_on_every_level() {
        let xs: Vec<f32> = (-9000..=9000).map(|i| i as f32 * 0.01).chain([0.0, -0.0, 1e-7, -1e-7, 88.0, -88.0, 1e4, -1e4]).collect();
        for level in Level::available() {
            with_level(level, || {
                let (mut e, mut s) = (xs.clone(), xs.clone());
                exp_in_place(&mut e);
                sigmoid_in_place(&mut s);
                for ((x, e), s) in xs.iter().zip(&e).zip(&s) {
                    let want = (*x as f64).exp();
                    if *x < -87.3 {
                        assert!(*e == 0.0);
                    } else if *x <= 88.7 {
                        assert!((*e as f64 - want).abs() <= 4e-7 * want, "exp {x}: {e} {want}");
                    }
                    assert!((*s as f64 - 1.0 / (1.0 + (-*x as f64).exp())).abs() < 3e-7, "sigmoid {x}: {s}");
                }
                let positive: Vec<f32> = xs.iter().map(|x| x.abs()).collect();
                let mut a = vec![0.0; xs.len()];
                alphas(&positive, &vec![1.0; xs.len()], &mut a);
                for (x, a) in positive.iter().zip(&a) {
                    let want = -(-*x as f64).exp_m1();
                    assert!((*a as f64 - want).abs() <= 4e-7 * want, "alpha {x}: {a} {want}");
                }
            });
        }
    }

    #[test]
    fn what_is_no_number_stays_none() {
        assert!(exp(f32::NAN).is_nan() && one_minus_exp_neg(f32::NAN).is_nan());
        assert_eq!(one_minus_exp_neg(f32::MAX), 1.0);
        assert!(exp(200.0) > 1e38 && exp(200.0).is_finite());
    }
}
