//! Sums in the order of the faces, so the result does not depend on threads; meshes here have some ten thousand faces.

use super::LEAST;
use diorama_geom::mesh::{cross, sub};
use rayon::prelude::*;

/// Elements per task.
const CHUNK: usize = 1 << 12;

fn face_normals(faces: &[[u32; 3]], positions: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let of = |f: &[u32; 3]| {
        let [a, b, c] = f.map(|i| positions[i as usize]);
        cross(sub(b, a), sub(c, a))
    };
    faces.par_iter().with_min_len(CHUNK).map(of).collect()
}

fn sums(faces: &[[u32; 3]], positions: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let mut sums = vec![[0.0f32; 3]; positions.len()];
    for (f, n) in faces.iter().zip(face_normals(faces, positions)) {
        f.iter().for_each(|i| (0..3).for_each(|k| sums[*i as usize][k] += n[k]));
    }
    sums
}

fn length(v: [f32; 3]) -> f32 {
    (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()
}

/// Normals `[V, 3]`.
///
/// # Panics
/// When a face names a vertex that is not there.
pub fn forward(faces: &[[u32; 3]], positions: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let unit = |n: [f32; 3]| {
        let l = length(n);
        if l > LEAST { n.map(|v| v / l) } else { [0.0, 0.0, 1.0] }
    };
    sums(faces, positions).into_iter().map(unit).collect()
}

/// Adds the gradient of positions to `d_positions`, for the gradient `d` of normals.
///
/// # Shapes
/// positions, d, d_positions: `[V, 3]`.
///
/// # Panics
/// When the shapes differ.
pub fn backward(faces: &[[u32; 3]], positions: &[[f32; 3]], d: &[[f32; 3]], d_positions: &mut [[f32; 3]]) {
    assert!(d.len() == positions.len() && d_positions.len() == d.len(), "vertex normals: shapes");
    let of = |(n, d): (&[f32; 3], &[f32; 3])| {
        let l = length(*n);
        if l <= LEAST {
            return [0.0; 3];
        }
        let along = (n[0] * d[0] + n[1] * d[1] + n[2] * d[2]) / (l * l);
        std::array::from_fn(|k| (d[k] - along * n[k]) / l)
    };
    let d_sums: Vec<[f32; 3]> = sums(faces, positions).par_iter().zip(d).with_min_len(CHUNK).map(of).collect();
    let of_face = |f: &[u32; 3]| {
        let [a, b, c] = f.map(|i| positions[i as usize]);
        let (p, q) = (sub(b, a), sub(c, a));
        let g: [f32; 3] = std::array::from_fn(|k| f.iter().map(|i| d_sums[*i as usize][k]).sum());
        // n = p × q: dp = q × g, dq = g × p.
        [cross(q, g), cross(g, p)]
    };
    let of_faces: Vec<[[f32; 3]; 2]> = faces.par_iter().with_min_len(CHUNK).map(of_face).collect();
    for (f, [dp, dq]) in faces.iter().zip(&of_faces) {
        for k in 0..3 {
            d_positions[f[0] as usize][k] -= dp[k] + dq[k];
            d_positions[f[1] as usize][k] += dp[k];
            d_positions[f[2] as usize][k] += dq[k];
        }
    }
}
