//! Largest values row by row: each place of the window is compared with the whole output row at once.

use super::Pool;
use crate::math::multiversion;
use crate::sums;
use crate::tasks::{self, Parts};

/// One place of the window against an output row: `x` holds every input that it reads, `STRIDE` apart, or `stride` where `STRIDE` is 0.
#[inline(always)]
fn compare<const STRIDE: usize>(stride: usize, x: &[f32], at: u32, best: &mut [f32], indices: &mut [u32]) {
    let stride = if STRIDE == 0 { stride } else { STRIDE };
    let n = best.len().min(indices.len());
    assert!(n == 0 || x.len() > (n - 1) * stride, "max pool: row");
    for i in 0..n {
        // SAFETY: `(n − 1) stride` was found inside.
        let v = unsafe { *x.get_unchecked(i * stride) };
        let better = v > best[i] || v.is_nan();
        best[i] = if better { v } else { best[i] };
        indices[i] = if better { at + (i * stride) as u32 } else { indices[i] };
    }
}

multiversion! {
    fn max_plane(pool: &Pool, from: [usize; 2], to: [usize; 2], x: &[f32], out: &mut [f32], indices: &mut [u32]) {
        let ([h, w], [kh, kw], [sh, sw], [ph, pw]) = (from, pool.kernel, pool.stride, pool.padding);
        for (oy, (best, indices)) in out.chunks_exact_mut(to[1]).zip(indices.chunks_exact_mut(to[1])).enumerate() {
            let (first, last) = ((oy * sh).max(ph) - ph, (oy * sh + kh - ph).min(h));
            best.fill(f32::NEG_INFINITY);
            for (ox, i) in indices.iter_mut().enumerate() {
                *i = (first * w + (ox * sw).max(pw) - pw) as u32;
            }
            for y in first..last {
                for kx in 0..kw {
                    // Outputs whose place `ox sw + kx − pw` lies in 0..w.
                    let (begin, end) = (pw.saturating_sub(kx).div_ceil(sw), ((w + pw).saturating_sub(kx)).div_ceil(sw).min(to[1]));
                    if begin >= end {
                        continue;
                    }
                    let at = y * w + begin * sw + kx - pw;
                    let (x, best, indices) = (&x[at..(y + 1) * w], &mut best[begin..end], &mut indices[begin..end]);
                    match sw {
                        1 => compare::<1>(1, x, at as u32, best, indices),
                        2 => compare::<2>(2, x, at as u32, best, indices),
                        _ => compare::<0>(sw, x, at as u32, best, indices),
                    }
                }
            }
        }
    }
}

/// Largest values, and where they are in their plane (`y W + x`), which backward needs.
///
/// # Shapes
/// x `[P, H, W]`, out and indices `[P, H', W']` with [`Pool::output`]; images and channels count as planes alike.
pub fn max(pool: &Pool, planes: usize, from: [usize; 2], x: &[f32], out: &mut [f32], indices: &mut [u32]) {
    let (to, size) = (pool.output(from), from[0] * from[1]);
    let places = to[0] * to[1];
    assert!(x.len() == planes * size && out.len() == planes * places && indices.len() == out.len(), "max pool: shapes");
    let (parts, indices) = (Parts::new(out), Parts::new(indices));
    tasks::run(if places == 0 { 0 } else { planes }, x.len(), |plane| {
        // SAFETY: each task has a plane of its own.
        let (out, indices) = unsafe { (parts.chunk(plane, places), indices.chunk(plane, places)) };
        max_plane(pool, from, to, &x[plane * size..][..size], out, indices);
    });
}

/// Gradient of the input, overwritten, given the indices that [`max`] wrote.
///
/// # Shapes
/// indices, d `[P, H', W']`, dx `[P, H, W]`; `size` is `H W`.
pub fn max_backward(planes: usize, size: usize, indices: &[u32], d: &[f32], dx: &mut [f32]) {
    assert!(dx.len() == planes * size && d.len() == indices.len(), "max pool: shapes");
    let places = d.len() / planes.max(1);
    let (elements, parts) = (dx.len() + d.len(), Parts::new(dx));
    tasks::run(planes, elements, |plane| {
        // SAFETY: each task has a plane of its own.
        let dx = unsafe { parts.chunk(plane, size) };
        dx.fill(0.0);
        let span = plane * places..(plane + 1) * places;
        for (i, d) in indices[span.clone()].iter().zip(&d[span]) {
            dx[*i as usize] += d;
        }
    });
}

multiversion! {
    fn mean(x: &[f32]) -> f32 {
        sums::sum(x) / x.len() as f32
    }
}

/// Mean of each plane.
///
/// # Shapes
/// x `[P, places]`, out `[P]`.
pub fn global_average(places: usize, x: &[f32], out: &mut [f32]) {
    assert_eq!(x.len(), out.len() * places, "average pool: shapes");
    let (planes, parts) = (out.len(), Parts::new(out));
    tasks::run(planes, x.len(), |plane| {
        // SAFETY: each task has an element of its own.
        let out = unsafe { parts.chunk(plane, 1) };
        out[0] = mean(&x[plane * places..][..places]);
    });
}

/// Gradient of the input of [`global_average`], overwritten.
///
/// # Shapes
/// d `[P]`, dx `[P, places]`.
pub fn global_average_backward(places: usize, d: &[f32], dx: &mut [f32]) {
    assert_eq!(dx.len(), d.len() * places, "average pool: shapes");
    let (elements, parts) = (dx.len(), Parts::new(dx));
    tasks::run(d.len(), elements, |plane| {
        // SAFETY: each task has a plane of its own.
        unsafe { parts.chunk(plane, places) }.fill(d[plane] / places as f32);
    });
}
