//! Tetrahedron by tetrahedron in f64, without table; triangles are turned outward by their normals.

use super::MIN_GAP;
use std::collections::BTreeMap;

type Point = [f64; 3];

/// Surface of tetrahedra with any orientation.
pub struct Reference {
    /// Edges of the surface's vertices (lower end first), ascending.
    pub edges: Vec<[u32; 2]>,
    pub positions: Vec<Point>,
    pub faces: Vec<[u32; 3]>,
}

/// `(v_a s_b − v_b s_a) / (s_b − s_a)`.
fn vertex([a, b]: [u32; 2], s: &[f64], positions: &[Point]) -> Point {
    let ([a, b], [s_a, s_b]) = ([a, b].map(|i| positions[i as usize]), [a, b].map(|i| s[i as usize]));
    std::array::from_fn(|k| (a[k] * s_b - b[k] * s_a) / (s_b - s_a))
}

pub fn extract(cells: &[[u32; 4]], s: &[f64], positions: &[Point]) -> Reference {
    let edge = |a: u32, b: u32| [a.min(b), a.max(b)];
    let mut triangles: Vec<[[u32; 2]; 3]> = Vec::new();
    for cell in cells {
        let (within, without): (Vec<u32>, Vec<u32>) = cell.iter().partition(|i| s[**i as usize] > 0.0);
        // Crossings in the order of a ring around the inside.
        let ring: Vec<[u32; 2]> = match (within.len(), without.len()) {
            (1, 3) => without.iter().map(|b| edge(within[0], *b)).collect(),
            (3, 1) => within.iter().map(|a| edge(*a, without[0])).collect(),
            (2, 2) => [(0, 0), (0, 1), (1, 1), (1, 0)].iter().map(|(a, b)| edge(within[*a], without[*b])).collect(),
            _ => continue,
        };
        let minus = |a: Point, b: Point| -> Point { std::array::from_fn(|k| a[k] - b[k]) };
        let down = minus(positions[without[0] as usize], positions[within[0] as usize]);
        for k in 1..ring.len() - 1 {
            let t = [ring[0], ring[k], ring[k + 1]];
            let [p, q, r] = t.map(|e| vertex(e, s, positions));
            let (u, v) = (minus(q, p), minus(r, p));
            let normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
            let outward = (0..3).map(|k| normal[k] * down[k]).sum::<f64>() > 0.0;
            triangles.push(if outward { t } else { [t[0], t[2], t[1]] });
        }
    }
    let mut numbers: BTreeMap<[u32; 2], u32> = triangles.iter().flatten().map(|e| (*e, 0)).collect();
    numbers.values_mut().enumerate().for_each(|(i, n)| *n = i as u32);
    let edges: Vec<[u32; 2]> = numbers.keys().copied().collect();
    Reference {
        positions: edges.iter().map(|e| vertex(*e, s, positions)).collect(),
        faces: triangles.iter().map(|t| t.map(|e| numbers[&e])).collect(),
        edges,
    }
}

/// Gradients of the distances and the grid's positions for those of the vertices on `edges`.
pub fn backward(edges: &[[u32; 2]], s: &[f64], positions: &[Point], d_vertices: &[Point]) -> (Vec<f64>, Vec<Point>) {
    let (mut d_s, mut d_positions) = (vec![0.0; s.len()], vec![[0.0; 3]; positions.len()]);
    for (e, d) in edges.iter().zip(d_vertices) {
        let [a, b] = e.map(|i| i as usize);
        let gap = s[a] - s[b];
        let t = s[a] / gap;
        let along: f64 = (0..3).map(|k| d[k] * (positions[b][k] - positions[a][k])).sum();
        let floored = gap.signum() * gap.abs().max(MIN_GAP as f64);
        d_s[a] -= along * (s[b] / gap) / floored;
        d_s[b] += along * (s[a] / gap) / floored;
        for k in 0..3 {
            d_positions[a][k] += (1.0 - t) * d[k];
            d_positions[b][k] += t * d[k];
        }
    }
    (d_s, d_positions)
}
