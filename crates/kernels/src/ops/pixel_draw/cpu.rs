//! Parallel over rays.

use super::{ATTEMPTS, Draw, NUMBERS, OBSERVED_EVERY, PixelSource, UNIFORM};
use crate::ops::error_map::CELLS;
use rayon::prelude::*;

/// Fewest rays per task.
const RAYS: usize = 256;

/// Destinations of a draw, all of it written.
pub struct Drawn<'a> {
    /// `[R]`
    pub images: &'a mut [u32],
    /// Centers, `[R, 2]`.
    pub pixels: &'a mut [f32],
    /// Straight RGBA, `[R, 4]`.
    pub target: &'a mut [f32],
    /// In `[0, 1)`, `[R]`.
    pub jitter: &'a mut [f32],
    /// Distance of the surface along the ray, 0 where it is not known, `[R]`.
    pub distance: &'a mut [f32],
    /// False where masks refused every draw, `[R]`.
    pub counts: &'a mut [bool],
}

/// Fills `out` with random training pixels.
pub fn draw(source: &dyn PixelSource, d: &Draw, out: Drawn) {
    let images = source.images() as u64;
    let picked = out.images.par_iter_mut().zip(out.pixels.par_chunks_mut(2)).zip(out.target.par_chunks_mut(4)).zip(out.jitter);
    let known = out.distance.par_iter_mut().zip(out.counts);
    picked.zip(known).enumerate().with_min_len(RAYS).for_each(|(i, ((((image, pixel), target), jitter), (distance, counts)))| {
        let base = (d.first + i as u64) * NUMBERS as u64;
        *jitter = d.rng.uniform(base);
        for attempt in 0..ATTEMPTS as u64 {
            let at = base + 1 + attempt * 3;
            let seen = !d.observations.is_empty() && (i as u32).is_multiple_of(OBSERVED_EVERY) && attempt == 0;
            let seen = seen.then(|| d.observations[d.rng.below(at, d.observations.len() as u64) as usize]);
            *distance = seen.map_or(0.0, |s| s.distance);
            let (img, u, v) = match d.error_map {
                Some(map) if i as u32 % 1024 >= UNIFORM => {
                    let cell = map.cell(d.rng.uniform(at));
                    let within = |c: usize, r: f32| (c as f32 + r) / CELLS as f32;
                    let (cx, cy) = (cell % CELLS, cell / CELLS % CELLS);
                    ((cell / CELLS / CELLS) as u64, within(cx, d.rng.uniform(at + 1)), within(cy, d.rng.uniform(at + 2)))
                }
                _ => (d.rng.below(at, images), d.rng.uniform(at + 1), d.rng.uniform(at + 2)),
            };
            let (w, h) = source.size(img as usize);
            let (x, y) = (((u * w as f32) as u32).min(w - 1), ((v * h as f32) as u32).min(h - 1));
            let (img, x, y) = seen.map_or((img, x, y), |s| (s.image as u64, s.x, s.y));
            let (x, y) = source.snap(img as usize, x, y);
            *image = img as u32;
            pixel.copy_from_slice(&[x as f32 + 0.5, y as f32 + 0.5]);
            target.copy_from_slice(&source.rgba(img as usize, x, y));
            *counts = source.counts(img as usize, x, y);
            if *counts {
                return;
            }
        }
    });
}
