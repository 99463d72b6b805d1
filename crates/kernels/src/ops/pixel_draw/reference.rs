//! One ray after the other, with places in f64.

use super::{ATTEMPTS, Draw, NUMBERS, OBSERVED_EVERY, PixelSource, UNIFORM};
use crate::ops::error_map::{CELLS, reference::cdf};

/// A drawn pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pixel {
    pub image: u32,
    pub x: u32,
    pub y: u32,
    /// 0 where it is not known.
    pub distance: f32,
    pub jitter: f32,
    /// Whether a mask admits it.
    pub counts: bool,
}

/// The pixels of `n` rays.
pub fn draw(source: &dyn PixelSource, d: &Draw, n: usize) -> Vec<Pixel> {
    (0..n as u64).map(|i| draw_ray(source, d, i)).collect()
}

/// The first pixel of ray `i` that a mask admits, or that of the last attempt.
fn draw_ray(source: &dyn PixelSource, d: &Draw, i: u64) -> Pixel {
    let base = (d.first + i) * NUMBERS as u64;
    let mut pixel = Pixel { image: 0, x: 0, y: 0, distance: 0.0, jitter: d.rng.uniform(base), counts: false };
    for attempt in 0..ATTEMPTS as u64 {
        let at = base + 1 + 3 * attempt;
        (pixel.image, pixel.x, pixel.y, pixel.distance) =
            if attempt == 0 && i.is_multiple_of(OBSERVED_EVERY as u64) && !d.observations.is_empty() {
                let o = d.observations[d.rng.below(at, d.observations.len() as u64) as usize];
                (o.image, o.x, o.y, o.distance)
            } else {
                let (image, u, v) = place(source, d, i, at);
                let (w, h) = source.size(image);
                (image as u32, ((u * w as f64) as u32).min(w - 1), ((v * h as f64) as u32).min(h - 1), 0.0)
            };
        (pixel.x, pixel.y) = source.snap(pixel.image as usize, pixel.x, pixel.y);
        pixel.counts = source.counts(pixel.image as usize, pixel.x, pixel.y);
        if pixel.counts {
            break;
        }
    }
    pixel
}

/// An image, and a place in it in shares of its width and height.
fn place(source: &dyn PixelSource, d: &Draw, i: u64, at: u64) -> (usize, f64, f64) {
    let (u, v) = (d.rng.uniform(at + 1) as f64, d.rng.uniform(at + 2) as f64);
    match d.error_map {
        Some(map) if i % 1024 >= UNIFORM as u64 => {
            let sums = cdf(&map.drawn);
            let wanted = d.rng.uniform(at) as f64 * sums.last().copied().unwrap_or(0.0);
            let cell = sums.iter().position(|s| *s >= wanted).unwrap_or(0);
            let share = |cell: usize, u: f64| (cell as f64 + u) / CELLS as f64;
            (cell / (CELLS * CELLS), share(cell % CELLS, u), share(cell / CELLS % CELLS, v))
        }
        _ => (d.rng.below(at, source.images() as u64) as usize, u, v),
    }
}
