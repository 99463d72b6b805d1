//! One ray at a time.

use super::{ColorLoss, Photometric};
use crate::ops::field_step::{RayGradient, RayLoss, RayOutput};
use crate::ops::{depth_loss, distortion};
use diorama_geom::color::srgb_from_linear;

/// Value and slope of a difference.
#[inline(always)]
pub fn color_error(loss: ColorLoss, d: f32) -> (f32, f32) {
    match loss {
        ColorLoss::Mse => (d * d, 2.0 * d),
        ColorLoss::Huber(delta) if d.abs() <= delta => (d * d / (2.0 * delta), d / delta),
        ColorLoss::Huber(delta) => (d.abs() - 0.5 * delta, d.signum()),
    }
}

/// A linear value as it is shown: within white, along the sRGB curve.
pub fn shown(linear: f32) -> f32 {
    srgb_from_linear(linear.clamp(0.0, 1.0))
}

/// Mean squared difference of two colors, of linear ones as they are shown.
pub fn squared_error(a: [f32; 3], b: [f32; 3], is_linear: bool) -> f32 {
    let of = |v: f32| if is_linear { shown(v) } else { v };
    (0..3).map(|k| (of(a[k]) - of(b[k])).powi(2) / 3.0).sum()
}

impl RayLoss for Photometric<'_> {
    fn ray(&self, r: usize, out: &RayOutput, g: &mut RayGradient) -> f64 {
        let (terms, targets, relative) = (&self.terms, &self.targets, self.measure.relative);
        if !targets.counts[r] {
            return 0.0;
        }
        let target = targets.color(r);
        let scale = 1.0 / targets.counts.len() as f32;
        let mut loss = 0.0f32;
        for k in 0..3 {
            let by = if relative > 0.0 { 1.0 / (out.values[k].max(0.0) + relative) } else { 1.0 };
            let (value, slope) = color_error(terms.color, by * (out.values[k] - target[k]));
            loss += value / 3.0;
            g.values[k] = by * slope * scale / 3.0;
        }
        if terms.alpha > 0.0 {
            let d = out.opacity - targets.rgba[r * 4 + 3];
            loss += terms.alpha * d * d;
            g.opacity = terms.alpha * 2.0 * d * scale;
        }
        if terms.distortion > 0.0 {
            loss += terms.distortion * distortion::cpu::ray(&self.measured(), r, out.weights, terms.distortion * scale, g.weights);
        }
        if terms.depth > 0.0 && targets.distance[r] > 0.0 {
            let (t, dt) = (&self.samples.t[out.first..], &self.samples.dt[out.first..]);
            loss += terms.depth * depth_loss::ray(t, dt, out.weights, targets.distance[r], terms.depth * scale, g.weights);
        }
        (loss * scale) as f64
    }
}
