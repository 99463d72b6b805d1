//! Cases of the op, for its tests and for `bench check`.

use super::reference::Hit;
#[cfg(feature = "gpu")]
use super::{
    ErrorMap,
    gpu::{GpuErrorMap, Rays},
    reference,
};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_testkit::random_unit;

/// Widths and heights of the images.
pub const SIZES: [(u32, u32); 2] = [(8, 4), (33, 7)];

/// Rays through pixels of the images; some do not count.
pub struct Case {
    pub images: Vec<u32>,
    /// Centers of pixels, `[R, 2]`.
    pub pixels: Vec<f32>,
    pub counts: Vec<bool>,
    pub errors: Vec<f32>,
}

pub fn cases() -> [Case; 3] {
    [0, 1, 700].map(|n: usize| {
        let images: Vec<u32> = (0..n as u32).map(|r| r * 7 % 3 % 2).collect();
        let places = random_unit(n * 2, 3);
        let pixel = |r: usize, k: usize| {
            let (w, h) = SIZES[images[r] as usize];
            (places[r * 2 + k] * [w, h][k] as f32).floor() + 0.5
        };
        Case {
            pixels: (0..n).flat_map(|r| [pixel(r, 0), pixel(r, 1)]).collect(),
            counts: (0..n).map(|r| r % 9 != 4).collect(),
            errors: random_unit(n, 4),
            images,
        }
    })
}

impl Case {
    /// The rays that count.
    pub fn hits(&self) -> Vec<Hit> {
        let of = |r: usize| {
            let (image, (w, h)) = (self.images[r] as usize, SIZES[self.images[r] as usize]);
            Hit { image, u: self.pixels[r * 2] / w as f32, v: self.pixels[r * 2 + 1] / h as f32, error: self.errors[r] }
        };
        (0..self.images.len()).filter(|r| self.counts[*r]).map(of).collect()
    }
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    const OP: &str = "error map";
    for c in cases() {
        let (mut map, shape) = (ErrorMap::new(SIZES.len()), format!("R={}", c.images.len()));
        map.errors.iter_mut().enumerate().for_each(|(i, e)| *e = [0.0625, 0.0, 1.0, 0.25][i * 7 % 4]);
        map.refresh();
        let on_gpu = GpuErrorMap::upload(gpu, &map, &SIZES);
        table.close(OP, "sums", &shape, on_gpu.cdf(), &reference::cdf(&map.drawn))?;
        let left_out: Vec<u32> = c.counts.iter().map(|c| !c as u32).collect();
        let (images, pixels, left_out) = (gpu.upload(&c.images), gpu.upload(&c.pixels), gpu.upload(&left_out));
        let want = reference::record_means(&map.errors, &c.hits());
        on_gpu.record(gpu, Rays { images: &images, pixels: &pixels, left_out: &left_out }, &gpu.upload(&c.errors));
        let errors = on_gpu.read(gpu)?.0;
        table.close(OP, "errors", &shape, &gpu.upload(&errors), &want)?;
        table.close(OP, "sums before a refresh", &shape, on_gpu.cdf(), &reference::cdf(&map.drawn))?;
        on_gpu.refresh(gpu);
        table.close(OP, "sums after a refresh", &shape, on_gpu.cdf(), &reference::cdf(&errors))?;
    }
    Ok(())
}
