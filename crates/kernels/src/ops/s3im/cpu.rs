//! One task per arrangement, each with a gradient of its own; their sum does not depend on threads.

use super::{C1, C2, Tile, WINDOW};
use crate::tasks::{self, Parts};

/// One minus the mean similarity; adds `weight` times its gradient to `d_colors`, `[R, 3]`. Sums of a window are in f64: variances are
/// differences of nearly equal numbers.
///
/// # Panics
/// When shapes differ, the rays do not fill whole tiles, or a tile is smaller than a window.
pub fn loss(colors: &[f32], targets: &[f32], tile: Tile, arrangements: &[u32], weight: f32, d_colors: &mut [f32]) -> f64 {
    let rays = colors.len() / 3;
    assert!(colors.len() == targets.len() && colors.len() == d_colors.len() && colors.len() == 3 * rays, "s3im: shapes");
    let m = arrangements.len() / rays.max(1);
    assert!(arrangements.len() == m * rays && rays.is_multiple_of(tile.pixels()), "s3im: {rays} rays, tiles of {} pixels", tile.pixels());
    assert!(tile.height >= WINDOW && tile.width >= WINDOW, "s3im: tiles of {} × {} are smaller than a window", tile.height, tile.width);
    if rays == 0 || m == 0 {
        return 0.0;
    }
    let [rows, columns] = tile.windows();
    let count = (m * (rays / tile.pixels()) * rows * columns * 3) as f64;
    let (mut gradients, mut sums) = (vec![0.0f32; m * colors.len()], vec![0.0f64; m]);
    let (d_parts, s_parts) = (Parts::new(&mut gradients), Parts::new(&mut sums));
    tasks::run(m, m * colors.len() * 16, |k| {
        // SAFETY: each arrangement has parts of its own.
        let (d, sum) = unsafe { (d_parts.chunk(k, colors.len()), &mut s_parts.chunk(k, 1)[0]) };
        for arranged in arrangements[k * rays..(k + 1) * rays].chunks_exact(tile.pixels()) {
            for window in 0..rows * columns {
                *sum += similarity(colors, targets, arranged, &tile, (window / columns, window % columns), d);
            }
        }
    });
    let scale = -(weight as f64 / count) as f32;
    for (i, d) in d_colors.iter_mut().enumerate() {
        *d += scale * (0..m).map(|k| gradients[k * colors.len() + i]).sum::<f32>();
    }
    1.0 - sums.iter().sum::<f64>() / count
}

/// Sum of the similarities of a window's three channels; adds its gradient to `d`.
fn similarity(colors: &[f32], targets: &[f32], arranged: &[u32], tile: &Tile, (row, column): (usize, usize), d: &mut [f32]) -> f64 {
    let mut sums = [[0.0f64; 5]; 3];
    for (pixel, g) in tile.pixels_of(row, column) {
        let at = 3 * arranged[pixel] as usize;
        for (k, s) in sums.iter_mut().enumerate() {
            let (x, y) = (colors[at + k] as f64, targets[at + k] as f64);
            for (sum, v) in s.iter_mut().zip([x, y, x * x, y * y, x * y]) {
                *sum += g * v;
            }
        }
    }
    let mut total = 0.0;
    // Derivatives by μ_x, Σ g x² and Σ g x y.
    let slopes = sums.map(|[mx, my, xx, yy, xy]| {
        let (a, b) = (2.0 * mx * my + C1, 2.0 * (xy - mx * my) + C2);
        let (c, v) = (mx * mx + my * my + C1, xx - mx * mx + yy - my * my + C2);
        let s = a * b / (c * v);
        total += s;
        [2.0 * my * (b - a) / (c * v) - 2.0 * mx * s / c + 2.0 * mx * s / v, -s / v, 2.0 * a / (c * v)]
    });
    for (pixel, g) in tile.pixels_of(row, column) {
        let at = 3 * arranged[pixel] as usize;
        for (k, [by_mean, by_square, by_product]) in slopes.iter().enumerate() {
            let (x, y) = (colors[at + k] as f64, targets[at + k] as f64);
            d[at + k] += (g * (by_mean + 2.0 * x * by_square + y * by_product)) as f32;
        }
    }
    total
}
