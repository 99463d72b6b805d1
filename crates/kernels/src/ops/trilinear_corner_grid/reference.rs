//! Plain loops in f64.

use super::Corners;

fn each(k: &Corners, local: &[f64], mut f: impl FnMut(usize, usize, f64, [f64; 3])) {
    for (s, &v) in k.voxel.iter().enumerate() {
        let u = &local[s * 3..s * 3 + 3];
        for c in 0..8 {
            let w = |a: usize| if c >> a & 1 == 1 { u[a] } else { 1.0 - u[a] };
            let d = |a: usize| if c >> a & 1 == 1 { 1.0 } else { -1.0 };
            let slope = [d(0) * w(1) * w(2), w(0) * d(1) * w(2), w(0) * w(1) * d(2)];
            f(s, k.rows[v as usize * 8 + c] as usize, w(0) * w(1) * w(2), slope);
        }
    }
}

/// Features `[S, C]`.
pub fn forward(k: &Corners, local: &[f64], table: &[f64], c: usize) -> Vec<f64> {
    let mut out = vec![0.0; k.voxel.len() * c];
    each(k, local, |s, row, w, _| (0..c).for_each(|j| out[s * c + j] += w * table[row * c + j]));
    out
}

/// Gradients of positions and table.
pub fn backward(k: &Corners, local: &[f64], table: &[f64], c: usize, d: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let (mut du, mut dt) = (vec![0.0; local.len()], vec![0.0; table.len()]);
    each(k, local, |s, row, w, slope| {
        for j in 0..c {
            dt[row * c + j] += w * d[s * c + j];
            (0..3).for_each(|a| du[s * 3 + a] += slope[a] * table[row * c + j] * d[s * c + j]);
        }
    });
    (du, dt)
}
