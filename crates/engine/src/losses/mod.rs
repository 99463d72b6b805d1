//! Photometric loss of rays: color, distortion, opacity and known distances.

use crate::samplers::RayBatch;
use diorama_geom::color::srgb_from_linear;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::field_step::{RayGradient, RayLoss, RayOutput};
use diorama_kernels::ops::photometric_loss::cpu::color_error;
use diorama_kernels::ops::{depth_loss, distortion};

pub use diorama_kernels::ops::photometric_loss::ColorLoss;

/// Weights of the terms of [`Photometric`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Terms {
    pub color: ColorLoss,
    pub distortion: f32,
    pub depth: f32,
    pub alpha: f32,
}

/// Color, distortion and opacity terms of a batch, each a mean over its rays.
pub struct Photometric<'a> {
    pub batch: &'a RayBatch,
    /// Samples in the distance that the distortion loss measures; unused without that loss.
    pub samples: Packed<'a>,
    /// Background of each ray, `[R, 3]`: what transparent pixels are composited on.
    pub background: &'a [f32],
    pub color: ColorLoss,
    /// For linear light: differences are divided by the prediction plus this, which takes no part in the gradient, so that dark parts
    /// count like bright ones (Mildenhall et al. 2022, equation 5); 0: they are not.
    pub relative: f32,
    /// Weight of the distortion loss.
    pub distortion: f32,
    /// Weight of the squared difference between opacity and the photograph's alpha.
    pub alpha: f32,
    /// Weight of the light that ends away from surfaces of known distance ([`depth_loss`]).
    pub depth: f32,
    /// Samples in distance from the camera; unused where `depth` is 0.
    pub along: Packed<'a>,
}

/// Value of [`Photometric::relative`] for linear light.
pub const RELATIVE: f32 = 1e-3;

/// A linear value as it is shown: within white, along the sRGB curve.
pub fn shown(linear: f32) -> f32 {
    srgb_from_linear(linear.clamp(0.0, 1.0))
}

/// Mean squared difference of two colors, of linear ones as they are shown.
pub fn squared_error(a: [f32; 3], b: [f32; 3], is_linear: bool) -> f32 {
    let of = |v: f32| if is_linear { shown(v) } else { v };
    (0..3).map(|k| (of(a[k]) - of(b[k])).powi(2) / 3.0).sum()
}

impl Photometric<'_> {
    /// [`squared_error`] of a ray.
    pub fn squared_error(&self, rgb: [f32; 3], target: [f32; 3]) -> f32 {
        squared_error(rgb, target, self.relative > 0.0)
    }

    /// Target color of a ray, background included.
    pub fn target(&self, r: usize) -> [f32; 3] {
        let t = &self.batch.target[r * 4..r * 4 + 4];
        std::array::from_fn(|k| t[k] * t[3] + self.background[r * 3 + k] * (1.0 - t[3]))
    }
}

impl RayLoss for Photometric<'_> {
    fn ray(&self, r: usize, out: &RayOutput, g: &mut RayGradient) -> f64 {
        if !self.batch.counts[r] {
            return 0.0;
        }
        let target = self.target(r);
        let scale = 1.0 / self.batch.len() as f32;
        let mut loss = 0.0f32;
        for k in 0..3 {
            let by = if self.relative > 0.0 { 1.0 / (out.values[k].max(0.0) + self.relative) } else { 1.0 };
            let (value, slope) = color_error(self.color, by * (out.values[k] - target[k]));
            loss += value / 3.0;
            g.values[k] = by * slope * scale / 3.0;
        }
        if self.alpha > 0.0 {
            let d = out.opacity - self.batch.target[r * 4 + 3];
            loss += self.alpha * d * d;
            g.opacity = self.alpha * 2.0 * d * scale;
        }
        if self.distortion > 0.0 {
            loss += self.distortion * distortion::cpu::ray(&self.samples, r, out.weights, self.distortion * scale, g.weights);
        }
        if self.depth > 0.0 && self.batch.distance[r] > 0.0 {
            let (t, dt) = (&self.along.t[out.first..], &self.along.dt[out.first..]);
            loss += self.depth * depth_loss::ray(t, dt, out.weights, self.batch.distance[r], self.depth * scale, g.weights);
        }
        (loss * scale) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relative_differences_count_alike_in_shadow_and_in_light() {
        let mut batch = RayBatch::default();
        batch.resize(2);
        batch.target = vec![0.02, 0.02, 0.02, 1.0, 40.0, 40.0, 40.0, 1.0];
        let (offsets, t, dt) = ([0u32, 1, 2], [0.0, 1.0], [0.5, 0.5]);
        let samples = Packed { offsets: &offsets, t: &t, dt: &dt };
        for color in [ColorLoss::Mse, ColorLoss::Huber(0.1)] {
            let background = &[1.0; 6];
            let (distortion, alpha, depth) = (0.0, 0.0, 0.0);
            let p = Photometric { batch: &batch, samples, background, color, relative: 1e-6, distortion, alpha, depth, along: samples };
            let run = |r: usize, v: f32| {
                let (mut w, mut d) = ([0.0], [0.0; 3]);
                let out = RayOutput { values: &[v; 3], opacity: 1.0, depth: 1.0, weights: &[1.0], first: 0 };
                let loss = p.ray(r, &out, &mut RayGradient { values: &mut d, opacity: 0.0, depth: 0.0, weights: &mut w });
                (loss, d[0])
            };
            let ((dark, d_dark), (light, d_light)) = (run(0, 0.022), run(1, 44.0));
            assert!((dark - light).abs() < 1e-3 * light, "{dark} {light}");
            // A step in proportion to the value.
            assert!((d_dark * 0.022 - d_light * 44.0).abs() < 1e-3 * d_light * 44.0 && d_light > 0.0);
        }
    }

    #[test]
    fn each_term_changes_the_loss_and_masked_rays_do_not_count() {
        let mut batch = RayBatch::default();
        batch.resize(1);
        batch.target = vec![0.2, 0.4, 0.6, 0.5];
        let (offsets, t, dt) = ([0u32, 2], [0.0, 1.0], [0.5, 0.5]);
        let samples = Packed { offsets: &offsets, t: &t, dt: &dt };
        let run = |batch: &RayBatch, distortion: f32, alpha: f32, color: ColorLoss, depth: f32| {
            let p = Photometric { batch, samples, background: &[1.0; 3], color, relative: 0.0, distortion, alpha, depth, along: samples };
            let (mut w, mut d) = ([0.0; 2], [0.0; 3]);
            let out = RayOutput { values: &[0.5, 0.5, 0.5], opacity: 0.9, depth: 1.0, weights: &[0.4, 0.5], first: 0 };
            p.ray(0, &out, &mut RayGradient { values: &mut d, opacity: 0.0, depth: 0.0, weights: &mut w })
        };
        let base = run(&batch, 0.0, 0.0, ColorLoss::Mse, 0.0);
        assert!(run(&batch, 0.1, 0.0, ColorLoss::Mse, 0.0) > base && run(&batch, 0.0, 0.1, ColorLoss::Mse, 0.0) > base);
        assert_ne!(run(&batch, 0.0, 0.0, ColorLoss::Huber(0.1), 0.0), base);
        assert_eq!(run(&batch, 0.0, 0.0, ColorLoss::Mse, 0.1), base, "no surface is known");
        batch.distance[0] = 9.0;
        assert!(run(&batch, 0.0, 0.0, ColorLoss::Mse, 0.1) > base, "all light ends before the surface");
        batch.counts[0] = false;
        assert_eq!(run(&batch, 0.1, 0.1, ColorLoss::Mse, 0.1), 0.0);
    }
}
