//! Plain loops in f64.

use super::HashGrid;

/// Cell, fraction and whether the coordinate was clamped, per axis.
fn locate(cells: u32, x: f64) -> (u32, f64, bool) {
    let c = x.clamp(0.0, 1.0);
    let p = c * cells as f64;
    let i = (p.floor() as u32).min(cells - 1);
    (i, p - i as f64, c != x)
}

/// Calls `f(row, corner weight, d weight / d point)` for the eight corners of a level's cell.
fn corners(grid: &HashGrid, l: usize, p: &[f64], mut f: impl FnMut(usize, f64, [f64; 3])) {
    let level = grid.levels[l];
    let axes: [(u32, f64, bool); 3] = std::array::from_fn(|k| locate(level.cells, p[k]));
    for c in 0..8u32 {
        let bit = |k: usize| (c >> k) & 1;
        let w = |k: usize| if bit(k) == 1 { axes[k].1 } else { 1.0 - axes[k].1 };
        let dw = |k: usize| {
            let sign = if bit(k) == 1 { 1.0 } else { -1.0 };
            if axes[k].2 { 0.0 } else { sign * level.cells as f64 }
        };
        let row = level.offset + level.row(axes[0].0 + bit(0), axes[1].0 + bit(1), axes[2].0 + bit(2));
        f(row, w(0) * w(1) * w(2), [dw(0) * w(1) * w(2), w(0) * dw(1) * w(2), w(0) * w(1) * dw(2)]);
    }
}

fn each(grid: &HashGrid, points: &[f64], mut f: impl FnMut(usize, usize, usize, f64, [f64; 3])) {
    let (s, width) = (points.len() / 3, grid.config.features);
    for l in 0..grid.levels.len() {
        for i in 0..s {
            corners(grid, l, &points[i * 3..i * 3 + 3], |row, w, dw| {
                for k in 0..width {
                    f((l * s + i) * width + k, i, row * width + k, w, dw);
                }
            });
        }
    }
}

/// Features `[L, S, F]`.
pub fn forward(grid: &HashGrid, points: &[f64], table: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; points.len() / 3 * grid.output_dims()];
    each(grid, points, |o, _, t, w, _| out[o] += w * table[t]);
    out
}

/// Gradients of the points `[S, 3]` and of the table.
pub fn backward(grid: &HashGrid, points: &[f64], table: &[f64], d_out: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (mut d_points, mut d_table) = (vec![0.0; points.len()], vec![0.0; table.len()]);
    each(grid, points, |o, i, t, w, dw| {
        d_table[t] += w * d_out[o];
        for k in 0..3 {
            d_points[i * 3 + k] += dw[k] * table[t] * d_out[o];
        }
    });
    (d_points, d_table)
}

/// `∂features/∂point`, `[L, S, F, 3]`.
pub fn jacobian(grid: &HashGrid, points: &[f64], table: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; points.len() * grid.output_dims()];
    each(grid, points, |o, _, t, _, dw| {
        for k in 0..3 {
            out[o * 3 + k] += dw[k] * table[t];
        }
    });
    out
}

/// Gradient of the table given that of the Jacobian.
pub fn jacobian_backward(grid: &HashGrid, points: &[f64], d_jacobian: &[f64]) -> Vec<f64> {
    let mut d_table = vec![0.0; grid.params_len()];
    each(grid, points, |o, _, t, _, dw| {
        d_table[t] += (0..3).map(|k| dw[k] * d_jacobian[o * 3 + k]).sum::<f64>();
    });
    d_table
}

/// Backward pass of the points' gradient `Jᵀ g`, given its gradient `d` `[S, 3]`: gradients of `g` (`J d`, `[L, S, F]`) and of the table.
/// The points get none.
pub fn gradient_backward(grid: &HashGrid, points: &[f64], table: &[f64], g: &[f64], d: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (mut d_g, mut d_table) = (vec![0.0; g.len()], vec![0.0; table.len()]);
    each(grid, points, |o, i, t, _, dw| {
        let along: f64 = (0..3).map(|k| dw[k] * d[i * 3 + k]).sum();
        d_g[o] += along * table[t];
        d_table[t] += along * g[o];
    });
    (d_g, d_table)
}
