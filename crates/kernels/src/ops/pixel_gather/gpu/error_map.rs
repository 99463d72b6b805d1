//! Mean error of the parts of the training images, for drawing. A step's errors in one cell are averaged before they
//! are mixed in, since rays come in no order.

use super::{CELLS, Drawn, GpuPhotographs, PHOTOGRAPH};
use crate::gpu::{Accumulate, Buffer, Gpu, GpuError, launch};
use cubecl::prelude::*;

/// Share of its old error that a cell keeps per ray.
const KEPT: f32 = 0.9;

/// Errors `[images, 16, 16]` on the device.
pub struct GpuErrorMap {
    images: usize,
    errors: Buffer,
    /// As of the last refresh.
    drawn: Buffer,
    /// Sums of the roots of `drawn`.
    cdf: Buffer,
    /// Of this step: sums and counts.
    gains: Buffer,
    hits: Buffer,
}

impl GpuErrorMap {
    pub fn upload(gpu: &Gpu, errors: &[f32], drawn: &[f32]) -> Self {
        let n = errors.len();
        let map = GpuErrorMap {
            images: n / (CELLS * CELLS),
            errors: gpu.upload(errors),
            drawn: gpu.upload(drawn),
            cdf: gpu.empty(n),
            gains: gpu.zeros(n),
            hits: gpu.zeros(n),
        };
        map.rebuild(gpu);
        map
    }

    /// What draws go by.
    pub fn cdf(&self) -> &Buffer {
        &self.cdf
    }

    /// Mixes in the squared errors `[R]` of drawn rays.
    pub fn record(&self, gpu: &Gpu, photographs: &GpuPhotographs, drawn: &Drawn, errors: &Buffer) {
        let (rays, cells) = (errors.len(), self.errors.len());
        launch!(
            gpu,
            note::<Adder>,
            rays,
            [
                photographs.sizes => self.images * PHOTOGRAPH,
                drawn.images => rays,
                drawn.pixels => rays * 2,
                drawn.left_out => rays,
                errors => rays,
                self.gains => cells,
                self.hits => cells,
            ],
            rays as u32,
        );
        launch!(gpu, settle, cells, [self.gains => cells, self.hits => cells, self.errors => cells], cells as u32);
    }

    /// Lets draws go by the present errors.
    pub fn refresh(&self, gpu: &Gpu) {
        gpu.copy(&self.errors, &self.drawn);
        self.rebuild(gpu);
    }

    fn rebuild(&self, gpu: &Gpu) {
        let (images, cells) = (self.images, self.images * CELLS * CELLS);
        let sums = gpu.empty(images);
        launch!(gpu, total, images, [self.drawn => cells, sums => images], images as u32);
        launch!(gpu, cumulate, images, [self.drawn => cells, sums => images, self.cdf => cells], images as u32);
    }

    /// Errors, and those that draws go by.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn read(&self, gpu: &Gpu) -> Result<(Vec<f32>, Vec<f32>), GpuError> {
        Ok((gpu.read(&self.errors)?, gpu.read(&self.drawn)?))
    }
}

#[cube(launch_unchecked)]
fn note<A: Accumulate>(
    sizes: &[u32],
    images: &[u32],
    pixels: &[f32],
    left_out: &[u32],
    errors: &[f32],
    gains: &[Atomic<A::Cell>],
    hits: &[Atomic<A::Cell>],
    n: u32,
) {
    let r = ABSOLUTE_POS;
    if r >= n as usize || left_out[r] != 0 {
        terminate!();
    }
    let image = images[r] as usize;
    let u = pixels[r * 2] / f32::cast_from(sizes[image * PHOTOGRAPH]);
    let v = pixels[r * 2 + 1] / f32::cast_from(sizes[image * PHOTOGRAPH + 1]);
    let x = min(u32::cast_from(u * comptime!(CELLS as f32)), comptime!(CELLS as u32 - 1)) as usize;
    let y = min(u32::cast_from(v * comptime!(CELLS as f32)), comptime!(CELLS as u32 - 1)) as usize;
    let cell = (image * CELLS + y) * CELLS + x;
    A::add(&gains[cell], errors[r]);
    A::add(&hits[cell], 1.0);
}

/// `e ← 0.9ᵏ e + (1 − 0.9ᵏ) mean` for the k rays of a cell.
#[cube(launch_unchecked)]
fn settle(gains: &mut [f32], hits: &mut [f32], errors: &mut [f32], n: u32) {
    let cell = ABSOLUTE_POS;
    if cell >= n as usize {
        terminate!();
    }
    let k = hits[cell];
    if k > 0.0 {
        let kept = (k * comptime!(KEPT.ln())).exp();
        errors[cell] = kept * errors[cell] + (1.0 - kept) * gains[cell] / k;
        gains[cell] = 0.0;
        hits[cell] = 0.0;
    }
}

#[cube(launch_unchecked)]
fn total(drawn: &[f32], sums: &mut [f32], images: u32) {
    let image = ABSOLUTE_POS;
    if image >= images as usize {
        terminate!();
    }
    let mut sum = 0.0f32;
    for i in 0..comptime!(CELLS * CELLS) {
        sum += drawn[image * comptime!(CELLS * CELLS) + i].sqrt();
    }
    sums[image] = sum;
}

#[cube(launch_unchecked)]
fn cumulate(drawn: &[f32], sums: &[f32], cdf: &mut [f32], images: u32) {
    let image = ABSOLUTE_POS;
    if image >= images as usize {
        terminate!();
    }
    let mut before = 0.0f32;
    for i in 0..image {
        before += sums[i];
    }
    let mut sum = 0.0f32;
    for i in 0..comptime!(CELLS * CELLS) {
        let at = image * comptime!(CELLS * CELLS) + i;
        sum += drawn[at].sqrt();
        cdf[at] = before + sum;
    }
}
