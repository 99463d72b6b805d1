//! One unit per ray, cell or image. The errors of a call's rays are averaged per cell before they are mixed in, since rays have no order.

use super::{CELLS, ErrorMap, KEPT};
use crate::gpu::{Accumulate, Buffer, Gpu, GpuError, launch};
use cubecl::prelude::*;

/// [`ErrorMap`] on the device.
pub struct GpuErrorMap {
    /// Widths and heights, `[images, 2]`.
    sizes: Buffer<u32>,
    errors: Buffer,
    /// As of the last refresh.
    drawn: Buffer,
    /// Sums of the roots of `drawn`.
    cdf: Buffer,
    /// Sums and numbers of the errors that are to be mixed in.
    gains: Buffer,
    hits: Buffer,
}

/// Rays through pixels.
#[derive(Clone, Copy)]
pub struct Rays<'a> {
    /// `[R]`
    pub images: &'a Buffer<u32>,
    /// Centers of pixels, `[R, 2]`.
    pub pixels: &'a Buffer,
    /// Rays that do not count: not 0, `[R]`.
    pub left_out: &'a Buffer<u32>,
}

impl GpuErrorMap {
    /// A map of images with widths and heights `sizes`.
    ///
    /// # Panics
    /// When the map is of another number of images.
    pub fn upload(gpu: &Gpu, map: &ErrorMap, sizes: &[(u32, u32)]) -> Self {
        let n = map.errors.len();
        assert_eq!(n, sizes.len() * CELLS * CELLS, "error map: images");
        let sizes: Vec<u32> = sizes.iter().flat_map(|(w, h)| [*w, *h]).collect();
        let map = GpuErrorMap {
            sizes: gpu.upload(&sizes),
            errors: gpu.upload(&map.errors),
            drawn: gpu.upload(&map.drawn),
            cdf: gpu.empty(n),
            gains: gpu.zeros(n),
            hits: gpu.zeros(n),
        };
        map.rebuild(gpu);
        map
    }

    /// Sums of the errors' roots up to each cell, by which cells are drawn.
    pub fn cdf(&self) -> &Buffer {
        &self.cdf
    }

    /// Mixes in the squared errors `[R]` of rays.
    pub fn record(&self, gpu: &Gpu, of: Rays, errors: &Buffer) {
        let (rays, cells) = (errors.len(), self.errors.len());
        launch!(
            gpu,
            add_errors::<Adder>,
            rays,
            [
                self.sizes => cells / (CELLS * CELLS) * 2,
                of.images => rays,
                of.pixels => rays * 2,
                of.left_out => rays,
                errors => rays,
                self.gains => cells,
                self.hits => cells,
            ],
            rays as u32,
        );
        launch!(gpu, mix_errors, cells, [self.gains => cells, self.hits => cells, self.errors => cells], cells as u32);
    }

    /// Makes draws go by the present errors.
    pub fn refresh(&self, gpu: &Gpu) {
        gpu.copy(&self.errors, &self.drawn);
        self.rebuild(gpu);
    }

    fn rebuild(&self, gpu: &Gpu) {
        let (images, cells) = (self.errors.len() / (CELLS * CELLS), self.errors.len());
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
fn add_errors<A: Accumulate>(
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
    // In whole numbers: devices round divisions of f32 as they like, and centers of pixels lie on borders of cells.
    let x = u32::cast_from(2.0 * pixels[r * 2]) * comptime!(CELLS as u32) / (2 * sizes[image * 2]);
    let y = u32::cast_from(2.0 * pixels[r * 2 + 1]) * comptime!(CELLS as u32) / (2 * sizes[image * 2 + 1]);
    let x = min(x, comptime!(CELLS as u32 - 1)) as usize;
    let y = min(y, comptime!(CELLS as u32 - 1)) as usize;
    let cell = (image * CELLS + y) * CELLS + x;
    A::add(&gains[cell], errors[r]);
    A::add(&hits[cell], 1.0);
}

/// `e ← 0.9ᵏ e + (1 − 0.9ᵏ) mean` for the k rays of a cell.
#[cube(launch_unchecked)]
fn mix_errors(gains: &mut [f32], hits: &mut [f32], errors: &mut [f32], n: u32) {
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
