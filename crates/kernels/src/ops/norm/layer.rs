//! Layer normalization on the CPU: blocks of rows; gradients of the parameters by groups of rows, added in order.

use super::LayerNorm;
use super::cpu::Gradients;
use crate::ops::activation::{Activation, cpu as activation};
use crate::sums;
use crate::tasks::{self, Parts};
use crate::vector::{LARGE, fence, fma, stream, vectorized};

/// Elements per task forward, about.
const BLOCK: usize = 1 << 14;
/// Groups of rows with parameter gradients of their own, at most, and rows that one has at least.
const GROUPS: usize = 64;
const GROUP_ROWS: usize = 16;

vectorized! {
    /// Mean and variance of a row, and `(x − mean) / √(variance + epsilon) γ + β`; parameters that are absent are empty.
    fn normalize_row<const F>(x: &[f32], epsilon: f32, scale: &[f32], shift: &[f32], out: &mut [f32]) -> (f32, f32) {
        let (mean, squares) = sums::moments::<F>(x);
        let variance = squares / x.len() as f32;
        apply_row::<F>(x, mean, 1.0 / (variance + epsilon).sqrt(), scale, shift, out);
        (mean, variance)
    }
}

vectorized! {
    /// [`normalize_row`] with known statistics.
    fn normalize_again<const F>(x: &[f32], mean: f32, inverse: f32, scale: &[f32], shift: &[f32], out: &mut [f32]) {
        apply_row::<F>(x, mean, inverse, scale, shift, out);
    }
}

#[inline(always)]
fn apply_row<const F: bool>(x: &[f32], mean: f32, inverse: f32, scale: &[f32], shift: &[f32], out: &mut [f32]) {
    match (scale.is_empty(), shift.is_empty()) {
        (true, true) => out.iter_mut().zip(x).for_each(|(o, x)| *o = (x - mean) * inverse),
        (true, false) => out.iter_mut().zip(x).zip(shift).for_each(|((o, x), b)| *o = fma::<F>(x - mean, inverse, *b)),
        (false, true) => out.iter_mut().zip(x).zip(scale).for_each(|((o, x), s)| *o = (x - mean) * inverse * s),
        (false, false) => {
            out.iter_mut().zip(x).zip(scale).zip(shift).for_each(|(((o, x), s), b)| *o = fma::<F>((x - mean) * inverse, *s, *b))
        }
    }
}

vectorized! {
    /// `inverse (g γ − Σ g γ / D − x̂ Σ g γ x̂ / D)` of a row; adds `g x̂` and `g` to the parameters' gradients.
    fn row_gradient<const F>(x: &[f32], g: &[f32], line: Row, dx: &mut [f32], d_scale: &mut [f32], d_shift: &mut [f32]) {
        const LANES: usize = sums::LANES;
        let Row { mean, inverse, scale } = line;
        let n = x.len();
        let (g, scale, dx) = (&g[..n], &scale[..n], &mut dx[..n]);
        let (mut sum, mut along) = ([0.0f32; LANES], [0.0f32; LANES]);
        let whole = n / LANES * LANES;
        let (d_scale, d_shift) = (&mut d_scale[..n], &mut d_shift[..n]);
        for first in (0..whole).step_by(LANES) {
            let (x, g, scale) = (&x[first..first + LANES], &g[first..first + LANES], &scale[first..first + LANES]);
            let (d_scale, d_shift) = (&mut d_scale[first..first + LANES], &mut d_shift[first..first + LANES]);
            for j in 0..LANES {
                let normalized = (x[j] - mean) * inverse;
                d_scale[j] = fma::<F>(g[j], normalized, d_scale[j]);
                d_shift[j] += g[j];
                sum[j] = fma::<F>(g[j], scale[j], sum[j]);
                along[j] = fma::<F>(g[j] * scale[j], normalized, along[j]);
            }
        }
        for i in whole..n {
            let normalized = (x[i] - mean) * inverse;
            d_scale[i] = fma::<F>(g[i], normalized, d_scale[i]);
            d_shift[i] += g[i];
            sum[i - whole] = fma::<F>(g[i], scale[i], sum[i - whole]);
            along[i - whole] = fma::<F>(g[i] * scale[i], normalized, along[i - whole]);
        }
        let (sum, along) = (sums::fold(sum) / n as f32, sums::fold(along) / n as f32);
        for i in 0..n {
            let normalized = (x[i] - mean) * inverse;
            dx[i] = inverse * fma::<F>(-normalized, along, fma::<F>(g[i], scale[i], -sum));
        }
    }
}

/// A row's statistics, and `γ [D]`.
#[derive(Clone, Copy)]
struct Row<'a> {
    mean: f32,
    inverse: f32,
    scale: &'a [f32],
}

impl LayerNorm<'_> {
    /// Number of rows of x.
    fn rows(&self, x: &[f32], mean: &[f32], variance: &[f32]) -> usize {
        assert!(mean.len() == variance.len() && x.len() == mean.len() * self.width, "layer norm: shapes");
        assert!(self.scale.is_none_or(|s| s.len() == self.width), "layer norm: scale");
        assert!(self.shift.is_none_or(|s| s.len() == self.width), "layer norm: shift");
        if self.width == 0 { 0 } else { mean.len() }
    }

    fn parameters(&self) -> (&[f32], &[f32]) {
        (self.scale.unwrap_or(&[]), self.shift.unwrap_or(&[]))
    }
}

/// Output of all rows; mean and biased variance of each are written.
///
/// # Shapes
/// x, out `[M, D]`; mean, variance `[M]`.
pub fn forward(norm: &LayerNorm, x: &[f32], mean: &mut [f32], variance: &mut [f32], out: &mut [f32]) {
    let rows = norm.rows(x, mean, variance);
    assert_eq!(x.len(), out.len(), "layer norm: shapes");
    let (width, (scale, shift)) = (norm.width, norm.parameters());
    let per_task = (BLOCK / width.max(1)).max(1);
    let large = x.len() >= LARGE;
    let (means, variances, out) = (Parts::new(mean), Parts::new(variance), Parts::new(out));
    tasks::run(rows.div_ceil(per_task), x.len(), |task| {
        // SAFETY: each task has chunks of its own.
        let (mean, variance, out) =
            unsafe { (means.chunk(task, per_task), variances.chunk(task, per_task), out.chunk(task, per_task * width)) };
        tasks::with_buffer(width, |kept| {
            for (i, out) in out.chunks_exact_mut(width).enumerate() {
                let x = &x[(task * per_task + i) * width..][..width];
                let row = if large { &mut *kept } else { &mut *out };
                (mean[i], variance[i]) = normalize_row(x, norm.epsilon, scale, shift, row);
                if norm.activation != Activation::None {
                    activation::forward_in_place(norm.activation, row);
                }
                if large {
                    stream(kept, out);
                }
            }
        });
        if large {
            fence();
        }
    });
}

/// Gradients of x, scale and shift from that of the output. `scratch` grows once.
///
/// # Shapes
/// x, d `[M, D]`; mean, variance `[M]`, as [`forward`] wrote them.
pub fn backward(norm: &LayerNorm, x: &[f32], mean: &[f32], variance: &[f32], d: &[f32], g: Gradients, scratch: &mut Vec<f32>) {
    let rows = norm.rows(x, mean, variance);
    assert!(d.len() == x.len() && g.x.len() == x.len(), "layer norm: shapes");
    let (width, (scale, shift)) = (norm.width, norm.parameters());
    let per_group = rows.div_ceil(GROUPS).max(GROUP_ROWS);
    let (groups, large) = (rows.div_ceil(per_group), x.len() >= LARGE);
    scratch.resize(2 * groups * width, 0.0);
    let (partial, dx) = (Parts::new(scratch), Parts::new(g.x));
    tasks::run(groups, x.len(), |group| {
        // SAFETY: each group has chunks of its own.
        let (partial, dx) = unsafe { (partial.chunk(group, 2 * width), dx.chunk(group, per_group * width)) };
        partial.fill(0.0);
        let (d_scale, d_shift) = partial.split_at_mut(width);
        tasks::with_buffer(3 * width, |buffer| {
            let (before, buffer) = buffer.split_at_mut(width);
            let (ones, kept) = buffer.split_at_mut(width);
            ones.fill(1.0);
            let factors = if scale.is_empty() { &*ones } else { scale };
            for (i, dx) in dx.chunks_exact_mut(width).enumerate() {
                let row = group * per_group + i;
                let (x, d) = (&x[row * width..][..width], &d[row * width..][..width]);
                let line = Row { mean: mean[row], inverse: 1.0 / (variance[row] + norm.epsilon).sqrt(), scale: factors };
                let d_row = if large { &mut *kept } else { &mut *dx };
                if norm.activation == Activation::None {
                    row_gradient(x, d, line, d_row, d_scale, d_shift);
                } else {
                    normalize_again(x, line.mean, line.inverse, scale, shift, before);
                    activation::backward_in_place(norm.activation, d, before);
                    row_gradient(x, before, line, d_row, d_scale, d_shift);
                }
                if large {
                    stream(kept, dx);
                }
            }
        });
        if large {
            fence();
        }
    });
    for (out, k) in [(g.scale, 0), (g.shift, 1)] {
        out.fill(0.0);
        for partial in scratch.chunks_exact(2 * width.max(1)) {
            out.iter_mut().zip(&partial[k * width..]).for_each(|(o, p)| *o += p);
        }
    }
}
