//! A task per set of statistics, so that the set is still in cache when it is read again. Means are sums of blocks, merged in
//! f64 (Chan et al. 1979).

use super::{Norm, Over};
use crate::ops::activation::{Activation, cpu as activation};
use crate::sums;
use crate::tasks::{self, Parts};
use crate::vector::{fma, vectorized};

/// Elements that stay in the first-level cache between loops.
const BLOCK: usize = 2048;

vectorized! {
    /// Mean of a slice and its squares about that mean.
    fn moments<const F>(x: &[f32]) -> (f32, f32) {
        sums::moments::<F>(x)
    }
}

vectorized! {
    /// `max((x − mean) scale + shift, floor)`
    fn apply<const F>(x: &[f32], line: Line, out: &mut [f32]) {
        for (o, x) in out.iter_mut().zip(x) {
            let v = fma::<F>(x - line.mean, line.scale, line.shift);
            *o = if v < line.floor { line.floor } else { v };
        }
    }
}

vectorized! {
    /// `Σ d` and `Σ d (x − mean)` where the output is above the floor.
    fn gradient_sums<const F>(x: &[f32], d: &[f32], line: Line) -> (f32, f32) {
        let (mut sum, mut along) = ([0.0f32; sums::LANES], [0.0f32; sums::LANES]);
        let (xs, ds) = (x.chunks_exact(sums::LANES), d.chunks_exact(sums::LANES));
        let tails = xs.remainder().iter().zip(ds.remainder());
        let term = |x: f32, d: f32| {
            let centered = x - line.mean;
            let g = if fma::<F>(centered, line.scale, line.shift) > line.floor { d } else { 0.0 };
            (g, centered)
        };
        for (x, d) in xs.zip(ds) {
            for j in 0..sums::LANES {
                let (g, centered) = term(x[j], d[j]);
                sum[j] += g;
                along[j] = fma::<F>(g, centered, along[j]);
            }
        }
        let (mut sum, mut along) = (sums::fold(sum), sums::fold(along));
        for (x, d) in tails {
            let (g, centered) = term(*x, *d);
            sum += g;
            along = fma::<F>(g, centered, along);
        }
        (sum, along)
    }
}

vectorized! {
    /// `scale d + slope (x − mean) + constant`, with `d` where the output is above the floor.
    fn apply_gradient<const F>(x: &[f32], d: &[f32], line: Line, slope: f32, constant: f32, dx: &mut [f32]) {
        for ((o, x), d) in dx.iter_mut().zip(x).zip(d) {
            let centered = x - line.mean;
            let g = if fma::<F>(centered, line.scale, line.shift) > line.floor { *d } else { 0.0 };
            *o = fma::<F>(line.scale, g, fma::<F>(slope, centered, constant));
        }
    }
}

/// Map of a plane: `max((x − mean) scale + shift, floor)`.
#[derive(Clone, Copy)]
struct Line {
    mean: f32,
    scale: f32,
    shift: f32,
    floor: f32,
}

impl Norm<'_> {
    fn check(&self, x: &[f32], mean: &[f32], variance: &[f32]) {
        assert!(x.len() == self.elements(), "norm: x has {} elements, not {}", x.len(), self.elements());
        assert!(mean.len() == self.sets() && variance.len() == self.sets(), "norm: {} statistics", self.sets());
        assert!(self.scale.is_none_or(|s| s.len() == self.channels), "norm: scale");
        assert!(self.shift.is_none_or(|s| s.len() == self.channels), "norm: shift");
        if let Over::Groups(groups) = self.over {
            assert!(groups > 0 && self.channels.is_multiple_of(groups), "norm: {} channels in {groups} groups", self.channels);
        }
    }

    /// Planes of a set: (number of planes, first plane, distance between planes).
    fn planes(&self, set: usize) -> (usize, usize, usize) {
        match self.over {
            Over::Batch | Over::Given => (self.images, set, self.channels),
            Over::Groups(groups) => (self.channels / groups, set * (self.channels / groups), 1),
        }
    }

    fn line(&self, plane: usize, mean: f32, variance: f32) -> Line {
        let c = plane % self.channels;
        let scale = self.scale.map_or(1.0, |s| s[c]) / (variance + self.epsilon).sqrt();
        let floor = if self.activation == Activation::Relu { 0.0 } else { f32::NEG_INFINITY };
        Line { mean, scale, shift: self.shift.map_or(0.0, |s| s[c]), floor }
    }

    /// Whether an activation remains after the floor.
    fn has_curve(&self) -> bool {
        !matches!(self.activation, Activation::None | Activation::Relu)
    }

    fn span(&self, plane: usize) -> std::ops::Range<usize> {
        plane * self.places..(plane + 1) * self.places
    }
}

/// Mean and biased variance of a set, its planes merged in order.
fn statistics(norm: &Norm, set: usize, x: &[f32]) -> (f32, f32) {
    let (n, first, step) = norm.planes(set);
    let (mut count, mut mean, mut squares) = (0.0f64, 0.0f64, 0.0f64);
    for i in 0..n {
        for block in x[norm.span(first + i * step)].chunks(BLOCK) {
            let (m, s) = moments(block);
            let (own, m) = (block.len() as f64, m as f64);
            let (total, delta) = (count + own, m - mean);
            mean += delta * own / total;
            squares += s as f64 + delta * delta * count * own / total;
            count = total;
        }
    }
    (mean as f32, (squares / count) as f32)
}

/// Normalizes all of x. Mean and biased variance are written, or read with [`Over::Given`].
///
/// # Shapes
/// x, out `[N, C, L]`; mean, variance: see [`Over`].
pub fn forward(norm: &Norm, x: &[f32], mean: &mut [f32], variance: &mut [f32], out: &mut [f32]) {
    norm.check(x, mean, variance);
    assert_eq!(x.len(), out.len(), "norm: shapes");
    if out.is_empty() {
        return;
    }
    let (means, variances, out) = (Parts::new(mean), Parts::new(variance), Parts::new(out));
    tasks::run(norm.sets(), x.len(), |set| {
        // SAFETY: each set has statistics and planes of its own.
        let (mean, variance) = unsafe { (means.chunk(set, 1), variances.chunk(set, 1)) };
        if norm.over != Over::Given {
            (mean[0], variance[0]) = statistics(norm, set, x);
        }
        let (n, first, step) = norm.planes(set);
        for plane in (0..n).map(|i| first + i * step) {
            let line = norm.line(plane, mean[0], variance[0]);
            // SAFETY: as above.
            let out = unsafe { out.range(norm.span(plane)) };
            for (out, x) in out.chunks_mut(BLOCK).zip(x[norm.span(plane)].chunks(BLOCK)) {
                apply(x, line, out);
                if norm.has_curve() {
                    activation::forward_in_place(norm.activation, out);
                }
            }
        }
    });
}

/// Where [`backward`] writes.
pub struct Gradients<'a> {
    /// `[N, C, L]`
    pub x: &'a mut [f32],
    /// `[C]`, or empty where nobody wants it.
    pub scale: &'a mut [f32],
    /// `[C]`, or empty where nobody wants it.
    pub shift: &'a mut [f32],
}

/// Gradients of x, scale and shift from that of the output, for statistics that [`forward`] wrote or read. `scratch` grows once.
///
/// # Shapes
/// x, d `[N, C, L]`; mean, variance: see [`Over`].
pub fn backward(norm: &Norm, x: &[f32], mean: &[f32], variance: &[f32], d: &[f32], g: Gradients, scratch: &mut Vec<f32>) {
    norm.check(x, mean, variance);
    assert!(d.len() == x.len() && g.x.len() == x.len(), "norm: shapes");
    let planes = norm.images * norm.channels;
    scratch.resize(2 * planes, 0.0);
    // Per plane: Σ g, Σ g x̂.
    scratch.fill(0.0);
    let (sums, dx) = (Parts::new(scratch), Parts::new(g.x));
    tasks::run(norm.sets(), x.len(), |set| {
        let (n, first, step) = norm.planes(set);
        let inverse = 1.0 / (variance[set] + norm.epsilon).sqrt();
        let (mut sum, mut along) = (0.0f64, 0.0f64);
        for plane in (0..n).map(|i| first + i * step) {
            // SAFETY: each set has planes of its own.
            let (own, dx) = unsafe { (sums.chunk(plane, 2), dx.range(norm.span(plane))) };
            plane_sums(norm, norm.line(plane, mean[set], variance[set]), &x[norm.span(plane)], &d[norm.span(plane)], dx, own);
            own[1] *= inverse;
            let scale = norm.scale.map_or(1.0, |s| s[plane % norm.channels]) as f64;
            sum += scale * own[0] as f64;
            along += scale * own[1] as f64;
        }
        let count = norm.count() as f64;
        let through = if norm.over == Over::Given { 0.0 } else { inverse };
        let (slope, constant) = (-through * inverse * (along / count) as f32, -through * (sum / count) as f32);
        for plane in (0..n).map(|i| first + i * step) {
            // SAFETY: as above.
            let dx = unsafe { dx.range(norm.span(plane)) };
            let line = norm.line(plane, mean[set], variance[set]);
            plane_gradient(norm, line, slope, constant, &x[norm.span(plane)], &d[norm.span(plane)], dx);
        }
    });
    for (out, k) in [(g.scale, 1), (g.shift, 0)] {
        for (c, o) in out.iter_mut().enumerate() {
            *o = (0..norm.images).map(|n| scratch[2 * (n * norm.channels + c) + k] as f64).sum::<f64>() as f32;
        }
    }
}

/// `Σ g` and `Σ g (x − mean)` of a plane, where g is the gradient before the activation; for activations other than ReLU, `dx` receives g.
fn plane_sums(norm: &Norm, line: Line, x: &[f32], d: &[f32], dx: &mut [f32], out: &mut [f32]) {
    let (mut sum, mut along) = (0.0f64, 0.0f64);
    for ((x, d), dx) in x.chunks(BLOCK).zip(d.chunks(BLOCK)).zip(dx.chunks_mut(BLOCK)) {
        let (s, a) = if norm.has_curve() {
            apply(x, line, dx);
            activation::backward_in_place(norm.activation, d, dx);
            gradient_sums(x, dx, line)
        } else {
            gradient_sums(x, d, line)
        };
        sum += s as f64;
        along += a as f64;
    }
    (out[0], out[1]) = (sum as f32, along as f32);
}

/// Gradient of a plane of x, from the values that [`plane_sums`] wrote to `dx`.
fn plane_gradient(norm: &Norm, line: Line, slope: f32, constant: f32, x: &[f32], d: &[f32], dx: &mut [f32]) {
    let mut kept = [0.0f32; BLOCK];
    for ((x, d), dx) in x.chunks(BLOCK).zip(d.chunks(BLOCK)).zip(dx.chunks_mut(BLOCK)) {
        let d = if norm.has_curve() {
            kept[..dx.len()].copy_from_slice(dx);
            &kept[..dx.len()]
        } else {
            d
        };
        apply_gradient(x, d, line, slope, constant, dx);
    }
}
