//! Stochastic structural similarity (Xie et al. 2023, S3IM): one minus the mean SSIM between the rays' colors and the photographs', where the
//! rays of a batch are arranged into tiles, once in their own order and then in random ones.
//!
//! A window has 4 × 4 pixels with Gaussian weights `g` (σ = 1.5) that sum to 1, stride 4 and a border of one zero, so windows are disjoint. With
//! `μ = Σ g x`, `σ_x² = Σ g x² − μ_x²`, `σ_xy = Σ g x y − μ_x μ_y`:
//! `SSIM = (2 μ_x μ_y + C₁)(2 σ_xy + C₂) / ((μ_x² + μ_y² + C₁)(σ_x² + σ_y² + C₂))`, `C₁ = 10⁻⁴`, `C₂ = 9·10⁻⁴`.
//!
//! # Shapes
//! Colors and targets `[R, 3]`, arrangements `[M, R]`; `R` is a multiple of a tile's pixels.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

use diorama_geom::rng::Rng;

/// Arrangements of a batch, as published.
pub const ARRANGEMENTS: usize = 10;
/// Edge of a window, its stride, and zeros around a tile.
const WINDOW: usize = 4;
const STRIDE: usize = 4;
const BORDER: usize = 1;
const SIGMA: f64 = 1.5;
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// Size of a tile in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile {
    pub height: usize,
    pub width: usize,
}

impl Tile {
    fn pixels(self) -> usize {
        self.height * self.width
    }

    /// Windows down and across.
    fn windows(self) -> [usize; 2] {
        [self.height, self.width].map(|n| (n + 2 * BORDER - WINDOW) / STRIDE + 1)
    }

    /// The pixels of a window and their weights; zeros of the border are left out.
    fn pixels_of(self, row: usize, column: usize) -> impl Iterator<Item = (usize, f64)> {
        let weights = weights();
        let at = move |k: usize| {
            let y = (STRIDE * row + k / WINDOW).checked_sub(BORDER).filter(|y| *y < self.height)?;
            let x = (STRIDE * column + k % WINDOW).checked_sub(BORDER).filter(|x| *x < self.width)?;
            Some((y * self.width + x, weights[k / WINDOW] * weights[k % WINDOW]))
        };
        (0..WINDOW * WINDOW).filter_map(at)
    }
}

/// Gaussian weights along an axis; as published, their middle is the third of four.
fn weights() -> [f64; WINDOW] {
    let g = |k: usize| (-(k as f64 - (WINDOW / 2) as f64).powi(2) / (2.0 * SIGMA * SIGMA)).exp();
    let sum: f64 = (0..WINDOW).map(g).sum();
    std::array::from_fn(|k| g(k) / sum)
}

/// `m` arrangements of `rays` rays `[m, rays]`: their own order, then random ones. `first` is the first number drawn, of [`draws`].
pub fn arrangements(rays: usize, m: usize, rng: &Rng, first: u64) -> Vec<u32> {
    let mut all: Vec<u32> = (0..rays as u32).collect();
    let mut counter = first;
    for _ in 1..m {
        let begin = all.len();
        all.extend(0..rays as u32);
        let own = &mut all[begin..];
        // Fisher and Yates.
        for i in (1..rays).rev() {
            own.swap(i, rng.below(counter, i as u64 + 1) as usize);
            counter += 1;
        }
    }
    all
}

/// Random numbers that [`arrangements`] draws.
pub fn draws(rays: usize, m: usize) -> u64 {
    (m.saturating_sub(1) * rays.saturating_sub(1)) as u64
}
