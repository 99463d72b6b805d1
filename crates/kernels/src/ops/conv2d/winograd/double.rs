//! Stride 2: 25 products for 4 outputs in place of 36.
//!
//! Along one axis, neighboring outputs read the pixels x₀ to x₂ and x₂ to x₄. The outer taps are a filter of two taps on x₀, x₂ and x₄,
//! of which minimal filtering computes two outputs in three products (S. Winograd, "Arithmetic Complexity of Computations", SIAM
//! 1980, section V); the middle tap adds one each:
//!
//! `y₀ = [g₀ (x₀ − x₂) + g₁ x₁] + (g₀ + g₂) x₂` and `y₁ = (g₀ + g₂) x₂ + [g₁ x₃ + g₂ (x₄ − x₂)]`.

use super::{Costs, Form, LANES, REACH, Strides, WEIGHTS};
use crate::vector::{by_lanes, vectorized};

/// The equation above in both axes.
pub const FORM: Form = Form {
    step: 2,
    reach: 5,
    inputs: 25,
    channels: 32,
    tiles: 102,
    sums: 9,
    terms,
    transform,
    kernels,
    collect,
    costs: Costs { input: 214.0, output: 20.0, band: 9.0, weight: 28.0, direct: 5.2, copy: 32.0 },
};

/// Per sum along one axis, its products (weight, input), of the weights `[g₀, g₁, g₀ + g₂, g₂]` and the inputs
/// `[x₀ − x₂, x₁, x₂, x₃, x₄ − x₂]`.
const AXIS: [&[(usize, usize)]; 3] = [&[(0, 0), (1, 1)], &[(2, 2)], &[(1, 3), (3, 4)]];

fn terms() -> Vec<Vec<(usize, usize)>> {
    let of = |row: (usize, usize), column: (usize, usize)| (4 * row.0 + column.0, 5 * row.1 + column.1);
    let sum = |rows: &[(usize, usize)], columns: &[(usize, usize)]| {
        rows.iter().flat_map(|&row| columns.iter().map(move |&column| of(row, column))).collect()
    };
    AXIS.iter().flat_map(|rows| AXIS.iter().map(move |columns| sum(rows, columns))).collect()
}

by_lanes! {
    /// 25 inputs per tile.
    ///
    /// # Safety
    /// As for [`Form::transform`].
    pub unsafe fn transform<L>(rows: &[*const f32; REACH], to: &Strides, out: *mut f32) {
        for row in 0..to.rows() {
            for column in (0..to.row).step_by(L::N) {
                let (from, tile) = (row * to.from_row + column * to.pixels, row * to.row + column);
                let mut d = [[L::splat(0.0); 5]; 5];
                for y in 0..5 {
                    let row = rows[y].add(from);
                    let (left, right) = (L::load_pairs(row), L::load_pairs(row.add(2 * L::N)));
                    let ((x0, x2), (x1, x3)) = (L::pairs(left.0, right.0), L::pairs(left.1, right.1));
                    let (left, right) = (L::load_pairs(row.add(4)).0, L::load_pairs(row.add(4 + 2 * L::N)).0);
                    let (x4, _) = L::pairs(left, right);
                    d[y] = [L::sub(x0, x2), x1, x2, x3, L::sub(x4, x2)];
                }
                for x in 0..5 {
                    (d[0][x], d[4][x]) = (L::sub(d[0][x], d[2][x]), L::sub(d[4][x], d[2][x]));
                }
                let mut out = out.add(to.at(tile));
                for row in d {
                    for v in row {
                        L::store(out, v);
                        out = out.add(to.point);
                    }
                }
            }
        }
    }
}

by_lanes! {
    /// Neighboring sums added in both axes, `+ bias`.
    ///
    /// # Safety
    /// As for [`Form::collect`].
    pub unsafe fn collect<L>(products: *const f32, from: &Strides, bias: f32, rows: [*mut f32; 2]) {
        let bias = L::splat(bias);
        for tile in (0..from.tiles).step_by(L::N) {
            let m = from.load::<L, 3>(products, tile);
            let mut sums = [[bias; 2]; 3];
            for y in 0..3 {
                sums[y] = [L::add(m[y][0], m[y][1]), L::add(m[y][1], m[y][2])];
            }
            let [top, middle, bottom] = sums;
            let middle = [L::add(middle[0], bias), L::add(middle[1], bias)];
            for (outer, row) in [top, bottom].into_iter().zip(rows) {
                L::store_pairs(row.add(2 * tile), L::add(outer[0], middle[0]), L::add(outer[1], middle[1]));
            }
        }
    }
}

vectorized! {
    /// `[g₀, g₁, g₀ + g₂, g₂]` in both axes: 16 weights per kernel.
    pub fn kernels<const F>(g: &[[f32; LANES]; 9]) -> [[f32; LANES]; WEIGHTS] {
        let mut out = [[0.0; LANES]; WEIGHTS];
        for y in 0..3 {
            for x in 0..3 {
                // The sum of the outer weights comes before the last one.
                out[4 * (y + y / 2) + x + x / 2] = g[3 * y + x];
            }
        }
        for y in [0, 1, 3] {
            for i in 0..LANES {
                out[4 * y + 2][i] = out[4 * y][i] + out[4 * y + 3][i];
            }
        }
        for x in 0..4 {
            for i in 0..LANES {
                out[8 + x][i] = out[x][i] + out[12 + x][i];
            }
        }
        out
    }
}
