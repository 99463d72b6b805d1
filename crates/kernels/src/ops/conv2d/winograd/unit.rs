//! `Y = Aᵀ [(G g Gᵀ) ⊙ (Bᵀ d B)] A` per 4×4 tile d of the input and kernel g: 16 products for 4 outputs in place of 36.
//!
//! A. Lavin, S. Gray, "Fast Algorithms for Convolutional Neural Networks", CVPR 2016, section 4.1.

use super::{Costs, Form, LANES, REACH, Strides, WEIGHTS};
use crate::vector::{by_lanes, vectorized};

/// F(2×2, 3×3) of stride 1.
pub const FORM: Form = Form {
    step: 1,
    reach: 4,
    inputs: 16,
    channels: 64,
    tiles: 160,
    sums: 16,
    terms,
    transform,
    kernels,
    collect,
    costs: Costs { input: 72.0, output: 37.0, band: 0.0, weight: 30.0, direct: 3.9, copy: 7.0 },
};

/// Each sum is one product.
fn terms() -> Vec<Vec<(usize, usize)>> {
    (0..16).map(|i| vec![(i, i)]).collect()
}

by_lanes! {
    /// `Bᵀ d B`: 16 inputs per tile.
    ///
    /// # Safety
    /// As for [`Form::transform`].
    pub unsafe fn transform<L>(rows: &[*const f32; REACH], to: &Strides, out: *mut f32) {
        for row in 0..to.rows() {
            for column in (0..to.row).step_by(L::N) {
                let (from, tile) = (row * to.from_row + column * to.pixels, row * to.row + column);
                let mut b = [[L::splat(0.0); 4]; 4];
                for half in 0..2 {
                    let d = |row: usize| L::load_pairs(rows[row].add(from + 2 * half));
                    let (d0, d1, d2, d3) = (d(0), d(1), d(2), d(3));
                    for (x, [d0, d1, d2, d3]) in [[d0.0, d1.0, d2.0, d3.0], [d0.1, d1.1, d2.1, d3.1]].into_iter().enumerate() {
                        let x = 2 * half + x;
                        b[0][x] = L::sub(d0, d2);
                        b[1][x] = L::add(d1, d2);
                        b[2][x] = L::sub(d2, d1);
                        b[3][x] = L::sub(d1, d3);
                    }
                }
                let mut out = out.add(to.at(tile));
                for [a, b, c, d] in b {
                    for v in [L::sub(a, c), L::add(b, c), L::sub(c, b), L::sub(b, d)] {
                        L::store(out, v);
                        out = out.add(to.point);
                    }
                }
            }
        }
    }
}

by_lanes! {
    /// `Aᵀ m A + bias`.
    ///
    /// # Safety
    /// As for [`Form::collect`].
    pub unsafe fn collect<L>(products: *const f32, from: &Strides, bias: f32, rows: [*mut f32; 2]) {
        let bias = L::splat(bias);
        for tile in (0..from.tiles).step_by(L::N) {
            let [a, b, c, d] = from.load::<L, 4>(products, tile);
            let mut sums = [[bias; 4]; 2];
            for x in 0..4 {
                sums[0][x] = L::add(L::add(a[x], b[x]), c[x]);
                sums[1][x] = L::sub(L::sub(b[x], c[x]), d[x]);
            }
            for ([a, b, c, d], row) in sums.into_iter().zip(rows) {
                let even = L::add(L::add(L::add(a, b), c), bias);
                let odd = L::add(L::sub(L::sub(b, c), d), bias);
                L::store_pairs(row.add(2 * tile), even, odd);
            }
        }
    }
}

vectorized! {
    /// `G g Gᵀ`: 16 weights per kernel.
    pub fn kernels<const F>(g: &[[f32; LANES]; 9]) -> [[f32; LANES]; WEIGHTS] {
        let mut columns = [[0.0; LANES]; 12];
        for x in 0..3 {
            line([&g[x], &g[3 + x], &g[6 + x]], &mut columns[4 * x..]);
        }
        let mut out = [[0.0; LANES]; WEIGHTS];
        for y in 0..4 {
            line([&columns[y], &columns[4 + y], &columns[8 + y]], &mut out[4 * y..]);
        }
        out
    }
}

/// `G g` of three weights.
#[inline(always)]
fn line([a, b, c]: [&[f32; LANES]; 3], out: &mut [[f32; LANES]]) {
    for i in 0..LANES {
        let (sum, middle) = (0.5 * (a[i] + c[i]), 0.5 * b[i]);
        out[0][i] = a[i];
        out[1][i] = sum + middle;
        out[2][i] = sum - middle;
        out[3][i] = c[i];
    }
}
