//! Parallel over samples forward; the table's gradient is added sample by sample, in a fixed order.

use super::Corners;
use rayon::prelude::*;

#[inline(always)]
fn weights(u: &[f32]) -> [f32; 8] {
    std::array::from_fn(|c| (0..3).map(|a| if c >> a & 1 == 1 { u[a] } else { 1.0 - u[a] }).product())
}

/// Features `[S, c]`, all of it written.
pub fn forward(k: &Corners, local: &[f32], table: &[f32], c: usize, out: &mut [f32]) {
    assert!(local.len() == k.voxel.len() * 3 && out.len() == k.voxel.len() * c, "corner grid: shapes");
    out.par_chunks_mut(c.max(1)).zip(local.par_chunks(3)).zip(k.voxel).with_min_len(256).for_each(|((o, u), &v)| {
        o.fill(0.0);
        for (w, &row) in weights(u).iter().zip(&k.rows[v as usize * 8..v as usize * 8 + 8]) {
            o.iter_mut().zip(&table[row as usize * c..]).for_each(|(o, t)| *o += w * t);
        }
    });
}

/// Gradient of the positions, overwritten, and of the table, added to.
pub fn backward(k: &Corners, local: &[f32], table: &[f32], c: usize, d: &[f32], d_local: &mut [f32], d_table: &mut [f32]) {
    assert!(local.len() == k.voxel.len() * 3 && d.len() == k.voxel.len() * c, "corner grid: shapes");
    for (s, &v) in k.voxel.iter().enumerate() {
        let (u, d) = (&local[s * 3..s * 3 + 3], &d[s * c..(s + 1) * c]);
        let w = weights(u);
        let mut dots = [0.0f32; 8];
        for q in 0..8 {
            let at = k.rows[v as usize * 8 + q] as usize * c;
            dots[q] = table[at..at + c].iter().zip(d).map(|(t, d)| t * d).sum();
            d_table[at..at + c].iter_mut().zip(d).for_each(|(g, d)| *g += w[q] * d);
        }
        for a in 0..3 {
            let (b, e) = ((a + 1) % 3, (a + 2) % 3);
            let side = |q: usize, k: usize| if q >> k & 1 == 1 { u[k] } else { 1.0 - u[k] };
            d_local[s * 3 + a] = (0..8).map(|q| (if q >> a & 1 == 1 { 1.0 } else { -1.0 }) * side(q, b) * side(q, e) * dots[q]).sum();
        }
    }
}
