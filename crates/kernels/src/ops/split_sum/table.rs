//! Shares of the light that white microfacets reflect: `∫ lobe · (1 − F_c)` and `∫ lobe · F_c` with `F_c = (1 − v·h)⁵`, by the cosine to the
//! camera and the roughness.

use rayon::prelude::*;
use std::sync::OnceLock;

/// Entries per axis.
pub const SIZE: usize = 256;
/// Normals drawn per entry, and the number before it in Fibonacci's sequence: their lattice is even. The shares are right to 0.0014.
const DRAWS: usize = 377;
const STRIDE: usize = 233;

/// The table, `[roughness, cosine, 2]`.
#[derive(Debug)]
pub struct Table {
    entries: Vec<[f32; 2]>,
}

/// A value and its slopes along the cosine and the roughness.
#[derive(Clone, Copy, Debug)]
pub struct Share {
    pub value: [f32; 2],
    pub along_cosine: [f32; 2],
    pub along_roughness: [f32; 2],
}

impl Table {
    /// The table, computed when it is first used.
    pub fn get() -> &'static Table {
        static TABLE: OnceLock<Table> = OnceLock::new();
        TABLE.get_or_init(|| {
            let entry = |i: usize| integrate(node(i % SIZE), node(i / SIZE)).map(|v| v as f32);
            Table { entries: (0..SIZE * SIZE).into_par_iter().map(entry).collect() }
        })
    }

    /// Bilinear between entries; outside of 0 to 1 the values of the border, without slope.
    #[inline(always)]
    pub fn at(&self, cosine: f32, roughness: f32) -> Share {
        let place = |v: f32| {
            let x = v.clamp(0.0, 1.0) * (SIZE - 1) as f32;
            let low = (x as usize).min(SIZE - 2);
            (low, x - low as f32, if (0.0..=1.0).contains(&v) { (SIZE - 1) as f32 } else { 0.0 })
        };
        let ((c, x, slope_c), (r, y, slope_r)) = (place(cosine), place(roughness));
        let e = |dr: usize, dc: usize| self.entries[(r + dr) * SIZE + c + dc];
        let (e00, e01, e10, e11) = (e(0, 0), e(0, 1), e(1, 0), e(1, 1));
        let mut share = Share { value: [0.0; 2], along_cosine: [0.0; 2], along_roughness: [0.0; 2] };
        for k in 0..2 {
            let (low, high) = (e00[k] + x * (e01[k] - e00[k]), e10[k] + x * (e11[k] - e10[k]));
            share.value[k] = low + y * (high - low);
            share.along_roughness[k] = slope_r * (high - low);
            share.along_cosine[k] = slope_c * ((1.0 - y) * (e01[k] - e00[k]) + y * (e11[k] - e10[k]));
        }
        share
    }
}

fn node(i: usize) -> f64 {
    (i as f64 / (SIZE - 1) as f64).max(1e-3)
}

/// The two shares from drawn visible normals (Dupuy and Benyoub 2023); each normal's weight is `G₂ / G₁`.
pub fn integrate(cosine: f64, roughness: f64) -> [f64; 2] {
    let alpha = roughness * roughness;
    let outgoing = [(1.0 - cosine * cosine).max(0.0).sqrt(), 0.0, cosine];
    let unit = |v: [f64; 3]| {
        let l = v.iter().map(|v| v * v).sum::<f64>().sqrt();
        v.map(|v| v / l)
    };
    let lambda = |v: [f64; 3]| {
        let tan2 = (v[0] * v[0] + v[1] * v[1]) / (v[2] * v[2]);
        0.5 * ((1.0 + alpha * alpha * tan2).sqrt() - 1.0)
    };
    let stretched = unit([alpha * outgoing[0], 0.0, outgoing[2]]);
    let mut sums = [0.0; 2];
    for i in 0..DRAWS {
        let [a, b] = [i, i * STRIDE % DRAWS].map(|v| (v as f64 + 0.5) / DRAWS as f64);
        let (angle, z) = (std::f64::consts::TAU * a, (1.0 - b) * (1.0 + stretched[2]) - stretched[2]);
        let sine = (1.0 - z * z).max(0.0).sqrt();
        let half = unit([alpha * (sine * angle.cos() + stretched[0]), alpha * (sine * angle.sin()), (z + stretched[2]).max(1e-12)]);
        let along: f64 = (0..3).map(|k| outgoing[k] * half[k]).sum();
        let incoming: [f64; 3] = std::array::from_fn(|k| 2.0 * along * half[k] - outgoing[k]);
        if incoming[2] > 0.0 {
            let (lambda_o, lambda_i) = (lambda(outgoing), lambda(incoming));
            let left = (1.0 + lambda_o) / (1.0 + lambda_o + lambda_i);
            let fresnel = (1.0 - along).clamp(0.0, 1.0).powi(5);
            sums = [sums[0] + left * (1.0 - fresnel), sums[1] + left * fresnel];
        }
    }
    sums.map(|s| s / DRAWS as f64)
}
