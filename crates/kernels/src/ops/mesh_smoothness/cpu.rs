//! Parallel over vertices and faces; gradients are gathered.

use super::{MIN_AREA, MeshTopology};
use diorama_geom::mesh::{cross, sub};
use rayon::prelude::*;

/// Elements per task.
const CHUNK: usize = 1 << 12;

/// `δ_i` of every vertex; zero for vertices without neighbors.
///
/// # Shapes
/// positions: `[V, 3]`.
pub fn laplacian(topology: &MeshTopology, positions: &[[f32; 3]]) -> Vec<[f32; 3]> {
    assert_eq!(positions.len(), topology.vertices(), "laplacian: vertices");
    let of = |i: usize| {
        let neighbors = topology.neighbors(i);
        let mut sum = [0.0f32; 3];
        for j in neighbors {
            let d = sub(positions[*j as usize], positions[i]);
            (0..3).for_each(|k| sum[k] += d[k]);
        }
        sum.map(|v| v / neighbors.len().max(1) as f32)
    };
    (0..positions.len()).into_par_iter().with_min_len(CHUNK).map(of).collect()
}

/// Value of the relative Laplacian, and `weight` times its gradient added to `d_positions`. `initial` is [`laplacian`] of the first mesh.
///
/// # Shapes
/// positions, initial, d_positions: `[V, 3]`.
///
/// # Panics
/// When the shapes differ.
pub fn relative_laplacian(
    topology: &MeshTopology,
    initial: &[[f32; 3]],
    positions: &[[f32; 3]],
    weight: f32,
    d_positions: &mut [[f32; 3]],
) -> f64 {
    let n = topology.vertices();
    assert!([initial.len(), positions.len(), d_positions.len()] == [n; 3], "relative laplacian: vertices");
    let mut difference = laplacian(topology, positions);
    difference.par_iter_mut().zip(initial).for_each(|(d, i)| *d = sub(*d, *i));
    let square = |d: &[f32; 3]| d.iter().map(|v| *v as f64 * *v as f64).sum::<f64>();
    let parts: Vec<f64> = difference.par_chunks(CHUNK).map(|part| part.iter().map(square).sum()).collect();
    let scale = 2.0 * weight / (3 * n).max(1) as f32;
    d_positions.par_iter_mut().with_min_len(CHUNK).enumerate().for_each(|(i, d)| {
        let neighbors = topology.neighbors(i);
        // δ_i has −1 here and each neighbor's δ the inverse of the number of its neighbors.
        let mut sum = if neighbors.is_empty() { [0.0; 3] } else { difference[i].map(|v| -v) };
        for j in neighbors {
            let share = 1.0 / topology.neighbors(*j as usize).len() as f32;
            (0..3).for_each(|k| sum[k] += share * difference[*j as usize][k]);
        }
        (0..3).for_each(|k| d[k] += scale * sum[k]);
    });
    parts.iter().sum::<f64>() / (3 * n).max(1) as f64
}

/// Value of the normal consistency up to creases of `crease`, and `weight` times its gradient added to `d_positions`. Faces without area
/// have no normal and no gradient.
///
/// # Shapes
/// positions, d_positions: `[V, 3]`.
///
/// # Panics
/// When the shapes differ.
pub fn normal_consistency(topology: &MeshTopology, positions: &[[f32; 3]], crease: f32, weight: f32, d_positions: &mut [[f32; 3]]) -> f64 {
    assert!([positions.len(), d_positions.len()] == [topology.vertices(); 2], "normal consistency: vertices");
    let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let place = |f: &[u32; 3]| f.map(|i| positions[i as usize]);
    // Unit normal and the inverse of the double area; zero for faces without area.
    let normal = |f: &[u32; 3]| {
        let [a, b, c] = place(f);
        let n = cross(sub(b, a), sub(c, a));
        let length = dot(n, n).sqrt();
        if length > MIN_AREA { (n.map(|v| v / length), 1.0 / length) } else { ([0.0; 3], 0.0) }
    };
    let normals: Vec<([f32; 3], f32)> = topology.faces().par_iter().with_min_len(CHUNK).map(normal).collect();
    let bend = |f: usize, g: u32| 1.0 - dot(normals[f].0, normals[g as usize].0);
    let cost = |[f, g]: &[u32; 2]| {
        let b = bend(*f as usize, *g);
        (b / (1.0 + b / crease)) as f64
    };
    let parts: Vec<f64> = topology.pairs().par_chunks(CHUNK).map(|part| part.iter().map(cost).sum()).collect();
    let pairs = topology.pairs().len().max(1);
    // Gradient of the cross product of each face's sides.
    let d_cross: Vec<[f32; 3]> = (0..normals.len())
        .into_par_iter()
        .with_min_len(CHUNK)
        .map(|f| {
            let (n, inverse) = normals[f];
            let mut d = [0.0f32; 3];
            for g in topology.across()[f].iter().filter(|g| **g != u32::MAX) {
                let counts = 1.0 / (1.0 + bend(f, *g) / crease).powi(2);
                (0..3).for_each(|k| d[k] -= counts * normals[*g as usize].0[k]);
            }
            let radial = dot(d, n);
            std::array::from_fn(|k| (d[k] - radial * n[k]) * inverse * weight / pairs as f32)
        })
        .collect();
    d_positions.par_iter_mut().with_min_len(CHUNK).enumerate().for_each(|(i, d)| {
        for corner in topology.corners(i) {
            let (f, k) = (*corner as usize / 3, *corner as usize % 3);
            let p = place(&topology.faces()[f]);
            let side = sub(p[(k + 2) % 3], p[(k + 1) % 3]);
            let of_corner = cross(d_cross[f], side);
            (0..3).for_each(|k| d[k] += of_corner[k]);
        }
    });
    parts.iter().sum::<f64>() / pairs as f64
}
