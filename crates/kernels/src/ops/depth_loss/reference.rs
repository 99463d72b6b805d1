//! In f64.

use super::{EXACT, MOST};
use crate::ops::composite::Packed;

/// Penalty on the light of sample `i`, where the surface is at `surface`.
fn away(p: &Packed, i: usize, surface: f32) -> f64 {
    let middle = p.t[i] as f64 + 0.5 * p.dt[i] as f64;
    ((middle / surface as f64 - 1.0).abs() - EXACT as f64).clamp(0.0, MOST as f64)
}

/// Loss per ray; 0 where no surface is known (`surface` is 0).
pub fn forward(p: &Packed, w: &[f64], surface: &[f32]) -> Vec<f64> {
    let known = |r: usize| surface[r] > 0.0;
    (0..p.rays()).map(|r| if known(r) { p.range(r).map(|i| w[i] * away(p, i, surface[r])).sum() } else { 0.0 }).collect()
}

/// Gradient of the weights, `scale` times that of the sum of losses.
pub fn backward(p: &Packed, surface: &[f32], scale: f64) -> Vec<f64> {
    let mut g = vec![0.0; p.t.len()];
    for r in (0..p.rays()).filter(|r| surface[*r] > 0.0) {
        p.range(r).for_each(|i| g[i] = scale * away(p, i, surface[r]));
    }
    g
}
