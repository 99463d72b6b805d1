//! What the two stages minimize.

use diorama_kernels::ops::field_step::{BatchLoss, RayGradients, RayOutputs};
use diorama_kernels::ops::s3im::{self, Tile};
use std::sync::Mutex;

/// Least share and opacity whose logarithm is taken.
const LEAST: f32 = 1e-6;
/// Opacity from which a ray has a depth, and the relative error from which the loss is linear.
const LEAST_OPACITY: f32 = 0.05;
const ROBUST: f32 = 0.1;
/// Least light behind matter where nothing should be.
const LEAST_LIGHT: f32 = 0.01;

/// Colors against photographs: squared error, structure of random tiles, and entropy of opacities.
pub struct SceneLoss<'a> {
    /// Over the rays' background, `[R, 3]`.
    pub target: &'a [f32],
    pub counts: &'a [bool],
    pub tile: Tile,
    /// `[M, R]`
    pub arrangements: &'a [u32],
    pub s3im: f32,
    pub distortion: f32,
    pub opacity: f32,
    /// Distance of each ray's surface, 0 where it is not known, `[R]`, and the weight of its relative error.
    pub distance: &'a [f32],
    pub depth: f32,
    /// Weight of the mean optical depth of the rays from the `R`-th on, on which nothing is.
    pub empty: f32,
    /// Squared error of the last batch.
    pub mse: Mutex<f64>,
}

impl BatchLoss for SceneLoss<'_> {
    fn batch(&self, out: &RayOutputs, gradients: &mut RayGradients) -> f64 {
        let rays = self.counts.len();
        let counted = self.counts.iter().filter(|c| **c).count().max(1) as f64;
        // What does not count looks as it should.
        let color = |r: usize, k: usize| if self.counts[r] { out.values[3 * r + k] } else { self.target[3 * r + k] };
        let colors: Vec<f32> = (0..rays).flat_map(|r| (0..3).map(move |k| (r, k))).map(|(r, k)| color(r, k)).collect();
        let mut loss = match self.s3im > 0.0 {
            true => s3im::cpu::loss(&colors, self.target, self.tile, self.arrangements, self.s3im, &mut gradients.values[..3 * rays]),
            false => 0.0,
        };
        let mut mse = 0.0;
        for r in (0..rays).filter(|r| !self.counts[*r]) {
            gradients.values[3 * r..3 * r + 3].fill(0.0);
        }
        for r in (0..rays).filter(|r| self.counts[*r]) {
            for k in 0..3 {
                let e = (colors[3 * r + k] - self.target[3 * r + k]) as f64;
                mse += e * e / (3.0 * counted);
                gradients.values[3 * r + k] += (2.0 * e / (3.0 * counted)) as f32;
            }
            let o = out.opacity[r].clamp(LEAST, 1.0);
            loss -= (self.opacity * o * o.ln()) as f64 / counted;
            gradients.opacity[r] -= self.opacity * (o.ln() + 1.0) / counted as f32;
        }
        loss += self.depths(out, gradients) + self.matter(out, gradients);
        *self.mse.lock().expect("no other thread holds it") = mse;
        loss + mse
    }

    fn distortion(&self) -> f32 {
        self.distortion
    }
}

impl SceneLoss<'_> {
    /// Mean optical depth `−ln(1 − opacity)` of rays on which nothing is.
    fn matter(&self, out: &RayOutputs, gradients: &mut RayGradients) -> f64 {
        let (first, all) = (self.counts.len(), out.opacity.len());
        let weight = self.empty / (all - first).max(1) as f32;
        let mut loss = 0.0;
        for r in first..all {
            let light = (1.0 - out.opacity[r]).max(LEAST_LIGHT);
            loss -= (weight * light.ln()) as f64;
            gradients.opacity[r] += weight / light;
        }
        loss
    }

    /// Huber's loss of `D / d − 1` over rays of known distance `d`, where `D = Σ w t / Σ w`.
    fn depths(&self, out: &RayOutputs, gradients: &mut RayGradients) -> f64 {
        let known = self.distance.iter().filter(|d| **d > 0.0).count().max(1) as f32;
        let mut loss = 0.0;
        for (r, d) in self.distance.iter().enumerate().filter(|(_, d)| **d > 0.0) {
            let opacity = out.opacity[r];
            if opacity < LEAST_OPACITY {
                continue;
            }
            let error = out.depth[r] / opacity / d - 1.0;
            let slope = self.depth * error.clamp(-ROBUST, ROBUST) / known;
            loss += (self.depth * error.abs().min(ROBUST) * (error.abs() - 0.5 * error.abs().min(ROBUST)) / known) as f64;
            gradients.depth[r] += slope / (opacity * d);
            gradients.opacity[r] -= slope * out.depth[r] / (opacity * opacity * d);
        }
        loss
    }
}

/// Cross entropy of composited shares.
pub struct LabelLoss<'a> {
    pub classes: usize,
    /// Class of each ray, and its weight: weights of a batch sum to the weights of its kinds of labels.
    pub labels: &'a [(u8, f32)],
}

impl BatchLoss for LabelLoss<'_> {
    fn batch(&self, out: &RayOutputs, gradients: &mut RayGradients) -> f64 {
        let mut loss = 0.0;
        for (r, (class, weight)) in self.labels.iter().enumerate() {
            let at = r * self.classes + *class as usize;
            let share = out.values[at].max(LEAST);
            loss -= *weight as f64 * (share as f64).ln();
            gradients.values[at] = -weight / share;
        }
        loss
    }
}
