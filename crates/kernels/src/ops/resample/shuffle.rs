//! Pixel shuffle: `r²` channels become the pixels of an image `r` times as large, and back; each is the other's backward.

use crate::math::multiversion;
use crate::tasks::{self, Parts};

#[inline(always)]
fn interleave<const R: usize>(planes: [&[f32]; R], out: &mut [f32]) {
    for (i, out) in out.chunks_exact_mut(R).enumerate() {
        for j in 0..R {
            out[j] = planes[j][i];
        }
    }
}

multiversion! {
    /// A row of the large image from `r` rows, `step` apart.
    fn merge(r: usize, step: usize, x: &[f32], out: &mut [f32]) {
        let width = out.len() / r;
        match r {
            2 => interleave::<2>(std::array::from_fn(|j| &x[j * step..][..width]), out),
            3 => interleave::<3>(std::array::from_fn(|j| &x[j * step..][..width]), out),
            4 => interleave::<4>(std::array::from_fn(|j| &x[j * step..][..width]), out),
            _ => {
                for (i, out) in out.chunks_exact_mut(r).enumerate() {
                    for (j, o) in out.iter_mut().enumerate() {
                        *o = x[j * step + i];
                    }
                }
            }
        }
    }
}

multiversion! {
    /// Every `r`-th pixel of a row of the large image.
    fn pick(r: usize, x: &[f32], out: &mut [f32]) {
        match r {
            2 => out.iter_mut().zip(x.chunks(2)).for_each(|(o, x)| *o = x[0]),
            3 => out.iter_mut().zip(x.chunks(3)).for_each(|(o, x)| *o = x[0]),
            4 => out.iter_mut().zip(x.chunks(4)).for_each(|(o, x)| *o = x[0]),
            _ => out.iter_mut().zip(x.chunks(r)).for_each(|(o, x)| *o = x[0]),
        }
    }
}

/// `out[n, c, y r + i, x r + j] = in[n, c r² + i r + j, y, x]`; also backward of [`unshuffle`].
///
/// # Shapes
/// x `[planes r², H, W]`, out `[planes, H r, W r]`, planes being images times channels.
pub fn shuffle(planes: usize, [h, w]: [usize; 2], r: usize, x: &[f32], out: &mut [f32]) {
    let size = h * w * r * r;
    assert!(x.len() == planes * size && out.len() == planes * size, "pixel shuffle: shapes");
    let parts = Parts::new(out);
    tasks::run(if size == 0 { 0 } else { planes }, x.len(), |plane| {
        // SAFETY: each task has a plane of its own.
        let out = unsafe { parts.chunk(plane, size) };
        for (line, out) in out.chunks_exact_mut(w * r).enumerate() {
            let from = (plane * r * r + line % r * r) * h * w + line / r * w;
            merge(r, h * w, &x[from..], out);
        }
    });
}

/// `out[n, c r² + i r + j, y, x] = in[n, c, y r + i, x r + j]`; also backward of [`shuffle`].
///
/// # Shapes
/// x `[planes, H r, W r]`, out `[planes r², H, W]`, planes being images times channels.
pub fn unshuffle(planes: usize, [h, w]: [usize; 2], r: usize, x: &[f32], out: &mut [f32]) {
    let size = h * w * r * r;
    assert!(x.len() == planes * size && out.len() == planes * size, "pixel shuffle: shapes");
    let parts = Parts::new(out);
    tasks::run(if size == 0 { 0 } else { planes }, x.len(), |plane| {
        // SAFETY: each task has a plane of its own.
        let out = unsafe { parts.chunk(plane, size) };
        for (k, out) in out.chunks_exact_mut(w).enumerate() {
            let (i, j, y) = (k / h / r, k / h % r, k % h);
            pick(r, &x[plane * size + (y * r + i) * w * r + j..], out);
        }
    });
}
