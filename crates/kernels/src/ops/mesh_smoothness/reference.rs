//! Both terms written out in f64 over sets of neighbors, with scattered gradients.

use std::collections::{BTreeMap, BTreeSet};

type Point = [f64; 3];

fn sub(a: Point, b: Point) -> Point {
    std::array::from_fn(|k| a[k] - b[k])
}

fn cross(a: Point, b: Point) -> Point {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn dot(a: Point, b: Point) -> f64 {
    (0..3).map(|k| a[k] * b[k]).sum()
}

/// Relative Laplacian of `positions` against `initial` positions, and its gradient.
pub fn relative_laplacian(faces: &[[u32; 3]], initial: &[Point], positions: &[Point]) -> (f64, Vec<Point>) {
    let mut neighbors = vec![BTreeSet::new(); positions.len()];
    for f in faces {
        for k in 0..3 {
            neighbors[f[k] as usize].extend([f[(k + 1) % 3] as usize, f[(k + 2) % 3] as usize]);
        }
    }
    let moved: Vec<Point> = positions.iter().zip(initial).map(|(p, i)| sub(*p, *i)).collect();
    let n = (3 * positions.len()) as f64;
    let (mut value, mut gradient) = (0.0, vec![[0.0; 3]; positions.len()]);
    for (i, of) in neighbors.iter().enumerate().filter(|(_, of)| !of.is_empty()) {
        for k in 0..3 {
            let d = of.iter().map(|j| moved[*j][k]).sum::<f64>() / of.len() as f64 - moved[i][k];
            value += d * d / n;
            gradient[i][k] -= 2.0 * d / n;
            of.iter().for_each(|j| gradient[*j][k] += 2.0 * d / n / of.len() as f64);
        }
    }
    (value, gradient)
}

/// Normal consistency up to creases of `crease` and its gradient.
pub fn normal_consistency(faces: &[[u32; 3]], positions: &[Point], crease: f64) -> (f64, Vec<Point>) {
    let mut sides: BTreeMap<[u32; 2], Vec<usize>> = BTreeMap::new();
    for (i, f) in faces.iter().enumerate() {
        (0..3).for_each(|k| sides.entry([f[k].min(f[(k + 1) % 3]), f[k].max(f[(k + 1) % 3])]).or_default().push(i));
    }
    let pairs: Vec<[usize; 2]> = sides.into_values().filter_map(|f| f.try_into().ok()).collect();
    let place = |f: usize| faces[f].map(|i| positions[i as usize]);
    let normal = |f: usize| {
        let [a, b, c] = place(f);
        let n = cross(sub(b, a), sub(c, a));
        let length = dot(n, n).sqrt();
        (n.map(|v| v / length), length)
    };
    let (mut value, mut gradient) = (0.0, vec![[0.0; 3]; positions.len()]);
    let share = 1.0 / pairs.len().max(1) as f64;
    for [f, g] in pairs {
        let bend = 1.0 - dot(normal(f).0, normal(g).0);
        value += share * bend / (1.0 + bend / crease);
        let counts = (1.0 + bend / crease).powi(-2);
        for (own, other) in [(f, g), (g, f)] {
            let ((n, length), d) = (normal(own), normal(other).0.map(|v| -share * counts * v));
            let d_cross: Point = std::array::from_fn(|k| (d[k] - dot(d, n) * n[k]) / length);
            let [a, b, c] = place(own);
            let (d_b, d_c) = (cross(sub(c, a), d_cross), cross(d_cross, sub(b, a)));
            for k in 0..3 {
                gradient[faces[own][0] as usize][k] -= d_b[k] + d_c[k];
                gradient[faces[own][1] as usize][k] += d_b[k];
                gradient[faces[own][2] as usize][k] += d_c[k];
            }
        }
    }
    (value, gradient)
}
