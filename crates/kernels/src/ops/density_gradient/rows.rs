//! Loops over rows of numbers.

use crate::ops::linear::Activation;
use crate::ops::linear::cpu::slope_from_output;
use crate::sums;
use crate::vector::{fma, vectorized};

vectorized! {
    /// Adds the product of each row `[K]` with `w` to `out`.
    pub fn add_dots<const F>(x: &[f32], w: &[f32], out: &mut [f32]) {
        for (x, o) in x.chunks_exact(w.len()).zip(out) {
            *o += sums::dot::<F>(x, w);
        }
    }
}

/// Scales by the slopes of a piecewise linear activation with outputs `y`.
pub fn scale(a: Activation, y: &[f32], d: &mut [f32]) {
    match a {
        Activation::None => {}
        a => scale_signed(y, slope_from_output(a, -1.0), d),
    }
}

vectorized! {
    /// Scales by `leak` where `y` is not positive.
    pub fn scale_signed<const F>(y: &[f32], leak: f32, d: &mut [f32]) {
        d.iter_mut().zip(y).for_each(|(d, y)| *d = if *y > 0.0 { *d } else { leak * *d });
    }
}

vectorized! {
    /// Rows `u w`, added to `out` where it `accumulates`.
    pub fn outer<const F>(u: &[f32], w: &[f32], accumulates: bool, out: &mut [f32]) {
        for (u, o) in u.iter().zip(out.chunks_exact_mut(w.len())) {
            if accumulates {
                o.iter_mut().zip(w).for_each(|(o, w)| *o = fma::<F>(*u, *w, *o));
            } else {
                o.iter_mut().zip(w).for_each(|(o, w)| *o = u * w);
            }
        }
    }
}

vectorized! {
    /// Adds `Σ u x` over rows `x` to `out`.
    pub fn weighted_sum<const F>(x: &[f32], u: &[f32], out: &mut [f32]) {
        for (x, u) in x.chunks_exact(out.len()).zip(u) {
            out.iter_mut().zip(x).for_each(|(o, x)| *o = fma::<F>(*u, *x, *o));
        }
    }
}

vectorized! {
    /// `x = factor x + t` for rows of `width`; nothing is added where `t` is empty.
    pub fn combine<const F>(x: &mut [f32], width: usize, factor: &[f32], t: &[f32]) {
        for (x, f) in x.chunks_exact_mut(width).zip(factor) {
            x.iter_mut().for_each(|x| *x *= f);
        }
        x.iter_mut().zip(t).for_each(|(x, t)| *x += t);
    }
}

/// Copies columns of rows from one array to another: `width` columns, in rows so long and from column so and so on.
pub fn copy_columns(width: usize, from: (&[f32], usize, usize), to: (&mut [f32], usize, usize)) {
    match width {
        1 => copy_few::<1>(from, to),
        2 => copy_few::<2>(from, to),
        4 => copy_few::<4>(from, to),
        _ => copy_few::<8>(from, to),
    }
}

/// [`copy_columns`] of a width that is known, which are moves in place of calls.
fn copy_few<const F: usize>((from, from_row, a): (&[f32], usize, usize), (to, to_row, b): (&mut [f32], usize, usize)) {
    for (t, f) in to.chunks_exact_mut(to_row).zip(from.chunks_exact(from_row)) {
        let few: [f32; F] = f[a..a + F].try_into().expect("columns");
        t[b..b + F].copy_from_slice(&few);
    }
}
