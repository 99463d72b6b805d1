//! Steps of the model as printed, which learns all at once.

use super::{PIXELS, Trainer, WithoutGlass};
use crate::relight::outdoor::stepper::sphere_rays;
use diorama_engine::samplers::pixels::PixelSource;
use diorama_engine::train::StepReport;
use diorama_geom::rng::Rng;

/// Stream of random numbers: points of the occupancy grid.
const OCCUPANCY: u64 = 35;

impl Trainer<'_> {
    /// One step on rays of one photograph, each through a random point of a random pixel.
    pub(super) fn learn_at_once(&mut self, step: u64, progress: f32) -> StepReport {
        let c = self.model.config.clone();
        let (n, rng) = (c.sampling.rays, Rng::new(c.seed, PIXELS));
        let pixels = WithoutGlass(&self.photographs);
        let image = rng.below(step.wrapping_mul(0x9e37_79b9_7f4a_7c15), self.cameras.len() as u64) as usize;
        let (w, h) = pixels.size(image);
        self.batch.resize(n);
        for r in 0..n {
            let at = |k: u64| rng.uniform(2 * (self.model.rays + r as u64) + k);
            let (x, y) = (at(0) * w as f32, at(1) * h as f32);
            let (column, row) = pixels.snap(image, (x as u32).min(w - 1), (y as u32).min(h - 1));
            self.batch.images[r] = image as u32;
            self.batch.pixels[2 * r..2 * r + 2].copy_from_slice(&[column as f32 + x.fract(), row as f32 + y.fract()]);
            let color = pixels.rgba(image, column, row);
            self.batch.target[4 * r..4 * r + 4].copy_from_slice(&color);
            // Only a background has anything to say about the sky.
            self.batch.counts[r] = pixels.counts(image, column, row) && (c.field.background || color[3] > 0.5);
        }
        sphere_rays(&self.model, &self.cameras, &mut self.batch);
        if step.is_multiple_of(c.sampling.occupancy_every) {
            // For meshes, which look where matter is.
            self.model.occupancy.update(&self.model.field, &Rng::new(c.seed, OCCUPANCY), step, c.sampling.occupancy_points, 1);
        }
        let light = vec![self.model.light_of[image]; n];
        let f = self.stepper.step(&mut self.model, &self.batch, &light, step, progress);
        if f.loss.is_finite() {
            self.model.count(n, f.samples as f64);
        }
        StepReport { loss: f.loss, scalars: self.scalars(f.mse, n, f.samples as f64) }
    }
}
