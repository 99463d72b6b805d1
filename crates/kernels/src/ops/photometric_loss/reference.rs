//! The loss term by term in f64, those of weights by their own ops' references.

use super::{ColorLoss, Photometric};
use crate::ops::composite::Composited;
use crate::ops::{depth_loss, distortion};

/// What a color difference counts.
pub fn color_loss(loss: ColorLoss, d: f64) -> f64 {
    match loss {
        ColorLoss::Mse => d * d,
        ColorLoss::Huber(delta) => {
            let delta = delta as f64;
            if d.abs() <= delta { d * d / (2.0 * delta) } else { d.abs() - 0.5 * delta }
        }
    }
}

/// Slope of [`color_loss`].
pub fn color_slope(loss: ColorLoss, d: f64) -> f64 {
    match loss {
        ColorLoss::Mse => 2.0 * d,
        ColorLoss::Huber(delta) => (d / delta as f64).clamp(-1.0, 1.0),
    }
}

/// A linear value as it is shown.
fn shown(linear: f64) -> f64 {
    let v = linear.clamp(0.0, 1.0);
    if v > 0.0031308 { 1.055 * v.powf(1.0 / 2.4) - 0.055 } else { 12.92 * v }
}

/// What channel `i` of all rays' channels should come to, background included.
fn target(l: &Photometric, i: usize) -> f64 {
    let (t, r) = (&l.targets, i / 3);
    let a = t.rgba[r * 4 + 3] as f64;
    t.rgba[r * 4 + i % 3] as f64 * a + t.background[i] as f64 * (1.0 - a)
}

/// What the difference of a channel is multiplied by.
fn weight(l: &Photometric, color: f64) -> f64 {
    let relative = l.measure.relative as f64;
    if relative > 0.0 { 1.0 / (color.max(0.0) + relative) } else { 1.0 }
}

/// Loss and squared error of each ray, `[R]` each; 0 for those that do not count.
///
/// Relative differences are divided by the colors `held` `[R, 3]`, which are those of `out` except where derivatives are taken.
pub fn forward(l: &Photometric, out: &Composited<f64>, held: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (terms, t) = (l.terms, &l.targets);
    let spread = distortion::reference::forward(&l.measured(), &out.weights);
    let astray = depth_loss::reference::forward(&l.samples, &out.weights, t.distance);
    let of_ray = |r: usize| {
        if !t.counts[r] {
            return (0.0, 0.0);
        }
        let off = out.opacity[r] - t.rgba[r * 4 + 3] as f64;
        let mut value = terms.alpha as f64 * off * off + terms.distortion as f64 * spread[r] + terms.depth as f64 * astray[r];
        let mut squared = 0.0;
        for i in r * 3..r * 3 + 3 {
            let (got, want) = (out.color[i], target(l, i));
            value += color_loss(terms.color, weight(l, held[i]) * (got - want)) / 3.0;
            let off = if l.measure.relative > 0.0 { shown(got) - shown(want) } else { got - want };
            squared += off * off / 3.0;
        }
        (value, squared)
    };
    (0..t.counts.len()).map(of_ray).unzip()
}

/// Gradients of the mean of the losses over all rays.
pub fn backward(l: &Photometric, out: &Composited<f64>) -> Composited<f64> {
    let (terms, t, rays) = (l.terms, &l.targets, l.targets.counts.len());
    let scale = |r: usize| if t.counts[r] { 1.0 / rays as f64 } else { 0.0 };
    let color = (0..rays * 3).map(|i| {
        let by = weight(l, out.color[i]);
        scale(i / 3) * by * color_slope(terms.color, by * (out.color[i] - target(l, i))) / 3.0
    });
    let opacity = (0..rays).map(|r| scale(r) * 2.0 * terms.alpha as f64 * (out.opacity[r] - t.rgba[r * 4 + 3] as f64));
    let d_spread: Vec<f64> = (0..rays).map(|r| scale(r) * terms.distortion as f64).collect();
    let mut weights = distortion::reference::backward(&l.measured(), &out.weights, &d_spread);
    let astray = depth_loss::reference::backward(&l.samples, t.distance, terms.depth as f64);
    for r in 0..rays {
        l.samples.range(r).for_each(|i| weights[i] += scale(r) * astray[i]);
    }
    Composited { color: color.collect(), depth: vec![0.0; rays], opacity: opacity.collect(), weights }
}
