//! Layer normalization on the CPU: blocks of rows; gradients of the parameters by groups of rows, added in order.

use super::LayerNorm;
use super::cpu::{Gradients, moments};
use crate::math::multiversion;
use crate::ops::activation::{Activation, cpu as activation};
use crate::sums;
use crate::tasks::{self, Parts};

/// Elements per task forward, about.
const BLOCK: usize = 1 << 14;
/// Groups of rows with parameter gradients of their own, at most, and rows that one has at least.
const GROUPS: usize = 64;
const GROUP_ROWS: usize = 16;

multiversion! {
    /// `(x − mean) inverse γ + β` of a row; parameters that are absent are empty.
    fn apply_row(x: &[f32], mean: f32, inverse: f32, scale: &[f32], shift: &[f32], out: &mut [f32]) {
        match (scale.is_empty(), shift.is_empty()) {
            (true, true) => out.iter_mut().zip(x).for_each(|(o, x)| *o = (x - mean) * inverse),
            (true, false) => out.iter_mut().zip(x).zip(shift).for_each(|((o, x), b)| *o = (x - mean) * inverse + b),
            (false, true) => out.iter_mut().zip(x).zip(scale).for_each(|((o, x), s)| *o = (x - mean) * inverse * s),
            (false, false) => {
                out.iter_mut().zip(x).zip(scale).zip(shift).for_each(|(((o, x), s), b)| *o = (x - mean) * inverse * s + b)
            }
        }
    }
}

multiversion! {
    /// Adds `g x̂` and `g` to the parameters' gradients.
    fn add_parameters(x: &[f32], g: &[f32], mean: f32, inverse: f32, d_scale: &mut [f32], d_shift: &mut [f32]) {
        d_scale.iter_mut().zip(x).zip(g).for_each(|((s, x), g)| *s += g * ((x - mean) * inverse));
        d_shift.iter_mut().zip(g).for_each(|(s, g)| *s += g);
    }
}

multiversion! {
    /// `inverse (g γ − Σ g γ / D − x̂ Σ g γ x̂ / D)` of a row; `g` becomes `g γ`.
    fn row_gradient(x: &[f32], g: &mut [f32], mean: f32, inverse: f32, scale: &[f32], dx: &mut [f32]) {
        if !scale.is_empty() {
            g.iter_mut().zip(scale).for_each(|(g, s)| *g *= s);
        }
        dx.iter_mut().zip(x).for_each(|(o, x)| *o = (x - mean) * inverse);
        let (sum, along) = (sums::sum(g) / x.len() as f32, sums::dot(g, dx) / x.len() as f32);
        dx.iter_mut().zip(&*g).for_each(|(o, g)| *o = inverse * (g - sum - *o * along));
    }
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
    let (means, variances, out) = (Parts::new(mean), Parts::new(variance), Parts::new(out));
    tasks::run(rows.div_ceil(per_task), x.len(), |task| {
        // SAFETY: each task has chunks of its own.
        let (mean, variance, out) =
            unsafe { (means.chunk(task, per_task), variances.chunk(task, per_task), out.chunk(task, per_task * width)) };
        for (i, out) in out.chunks_exact_mut(width).enumerate() {
            let x = &x[(task * per_task + i) * width..][..width];
            let (m, squares) = moments(x);
            (mean[i], variance[i]) = (m, squares / width as f32);
            apply_row(x, m, 1.0 / (variance[i] + norm.epsilon).sqrt(), scale, shift, out);
            if norm.activation != Activation::None {
                activation::forward_in_place(norm.activation, out);
            }
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
    let groups = rows.div_ceil(per_group);
    scratch.resize(2 * groups * width, 0.0);
    let (partial, dx) = (Parts::new(scratch), Parts::new(g.x));
    tasks::run(groups, x.len(), |group| {
        // SAFETY: each group has chunks of its own.
        let (partial, dx) = unsafe { (partial.chunk(group, 2 * width), dx.chunk(group, per_group * width)) };
        partial.fill(0.0);
        let (d_scale, d_shift) = partial.split_at_mut(width);
        tasks::with_buffer(width, |before| {
            for (i, dx) in dx.chunks_exact_mut(width).enumerate() {
                let row = group * per_group + i;
                let (x, d) = (&x[row * width..][..width], &d[row * width..][..width]);
                let (mean, inverse) = (mean[row], 1.0 / (variance[row] + norm.epsilon).sqrt());
                if norm.activation == Activation::None {
                    before.copy_from_slice(d);
                } else {
                    apply_row(x, mean, inverse, scale, shift, before);
                    activation::backward_in_place(norm.activation, d, before);
                }
                add_parameters(x, before, mean, inverse, d_scale, d_shift);
                row_gradient(x, before, mean, inverse, scale, dx);
            }
        });
    });
    for (out, k) in [(g.scale, 0), (g.shift, 1)] {
        out.fill(0.0);
        for partial in scratch.chunks_exact(2 * width.max(1)) {
            out.iter_mut().zip(&partial[k * width..]).for_each(|(o, p)| *o += p);
        }
    }
}
