//! Window by window in f64, with images laid out in full.

use super::{BORDER, C1, C2, STRIDE, Tile, WINDOW, weights};

/// A tile with its border of zeros, one channel.
fn image(values: &[f64], arranged: &[u32], tile: Tile, channel: usize) -> Vec<Vec<f64>> {
    let mut out = vec![vec![0.0; tile.width + 2 * BORDER]; tile.height + 2 * BORDER];
    for (i, ray) in arranged.iter().enumerate() {
        out[i / tile.width + BORDER][i % tile.width + BORDER] = values[3 * *ray as usize + channel];
    }
    out
}

/// Value and its gradient by the colors.
pub fn loss(colors: &[f64], targets: &[f64], tile: Tile, arrangements: &[u32]) -> (f64, Vec<f64>) {
    let g = weights();
    let (mut sum, mut count, mut gradient) = (0.0, 0.0, vec![0.0; colors.len()]);
    for arranged in arrangements.chunks(tile.height * tile.width) {
        for k in 0..3 {
            let (x, y) = (image(colors, arranged, tile, k), image(targets, arranged, tile, k));
            let mut top = 0;
            while top + WINDOW <= tile.height + 2 * BORDER {
                let mut left = 0;
                while left + WINDOW <= tile.width + 2 * BORDER {
                    let over = |f: &dyn Fn(usize, usize) -> f64| -> f64 {
                        (0..WINDOW).flat_map(|i| (0..WINDOW).map(move |j| (i, j))).map(|(i, j)| g[i] * g[j] * f(top + i, left + j)).sum()
                    };
                    let (mx, my) = (over(&|i, j| x[i][j]), over(&|i, j| y[i][j]));
                    let vx = over(&|i, j| x[i][j] * x[i][j]) - mx * mx;
                    let vy = over(&|i, j| y[i][j] * y[i][j]) - my * my;
                    let vxy = over(&|i, j| x[i][j] * y[i][j]) - mx * my;
                    let (a, b) = (2.0 * mx * my + C1, 2.0 * vxy + C2);
                    let (c, d) = (mx * mx + my * my + C1, vx + vy + C2);
                    sum += a * b / (c * d);
                    count += 1.0;
                    for i in 0..WINDOW {
                        for j in 0..WINDOW {
                            let (row, column) = (top + i, left + j);
                            if row < BORDER || column < BORDER || row >= tile.height + BORDER || column >= tile.width + BORDER {
                                continue;
                            }
                            let w = g[i] * g[j];
                            // Of the four factors.
                            let (da, db) = (2.0 * my * w, 2.0 * w * (y[row][column] - my));
                            let (dc, dd) = (2.0 * mx * w, 2.0 * w * (x[row][column] - mx));
                            let ds = (da * b + a * db) / (c * d) - a * b * (dc / (c * c * d) + dd / (c * d * d));
                            let ray = arranged[(row - BORDER) * tile.width + column - BORDER] as usize;
                            gradient[3 * ray + k] -= ds;
                        }
                    }
                    left += STRIDE;
                }
                top += STRIDE;
            }
        }
    }
    gradient.iter_mut().for_each(|d| *d /= count);
    (1.0 - sum / count, gradient)
}
