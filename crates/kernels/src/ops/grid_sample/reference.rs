//! Point by point in f64.

use super::{GridSample, Mode, Outside};

/// Place along an axis of `n` pixels, and its slope with respect to the grid's coordinate.
fn place(s: &GridSample, n: usize, g: f64) -> (f64, f64) {
    let n = n as f64;
    let (at, slope) = if s.align_corners { ((g + 1.0) / 2.0 * (n - 1.0), (n - 1.0) / 2.0) } else { (((g + 1.0) * n - 1.0) / 2.0, n / 2.0) };
    match s.outside {
        Outside::Border if at <= 0.0 => (0.0, 0.0),
        Outside::Border if at >= n - 1.0 => (n - 1.0, 0.0),
        _ => (at, slope),
    }
}

/// Pixels of a point with (row, column, weight, slopes of the weight along x and y).
fn corners(s: &GridSample, gx: f64, gy: f64) -> Vec<(i64, i64, f64, f64, f64)> {
    let ((x, slope_x), (y, slope_y)) = (place(s, s.from[1], gx), place(s, s.from[0], gy));
    if s.mode == Mode::Nearest {
        return vec![(y.round_ties_even() as i64, x.round_ties_even() as i64, 1.0, 0.0, 0.0)];
    }
    let (x0, y0) = (x.floor(), y.floor());
    let mut out = Vec::new();
    for (dy, wy, sy) in [(0, 1.0 - (y - y0), -1.0), (1, y - y0, 1.0)] {
        for (dx, wx, sx) in [(0, 1.0 - (x - x0), -1.0), (1, x - x0, 1.0)] {
            out.push((y0 as i64 + dy, x0 as i64 + dx, wy * wx, wy * sx * slope_x, wx * sy * slope_y));
        }
    }
    out
}

/// Calls `f(output, input, point, weight, slopes)` for every term.
fn terms(s: &GridSample, grid: &[f64], mut f: impl FnMut(usize, usize, usize, f64, (f64, f64))) {
    let [h, w] = s.from;
    for image in 0..s.images {
        for p in 0..s.points {
            let point = image * s.points + p;
            for (y, x, weight, sx, sy) in corners(s, grid[2 * point], grid[2 * point + 1]) {
                if y < 0 || x < 0 || y >= h as i64 || x >= w as i64 {
                    continue;
                }
                for c in 0..s.channels {
                    let plane = image * s.channels + c;
                    f(plane * s.points + p, (plane * h + y as usize) * w + x as usize, point, weight, (sx, sy));
                }
            }
        }
    }
}

/// `[N, C, H', W']`
pub fn forward(s: &GridSample, x: &[f64], grid: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; s.images * s.channels * s.points];
    terms(s, grid, |o, i, _, weight, _| out[o] += weight * x[i]);
    out
}

/// Gradients of x and of the grid.
pub fn backward(s: &GridSample, x: &[f64], grid: &[f64], d: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (mut dx, mut d_grid) = (vec![0.0; x.len()], vec![0.0; grid.len()]);
    terms(s, grid, |o, i, point, weight, (sx, sy)| {
        dx[i] += weight * d[o];
        d_grid[2 * point] += sx * d[o] * x[i];
        d_grid[2 * point + 1] += sy * d[o] * x[i];
    });
    (dx, d_grid)
}
