//! Tetrahedron by tetrahedron in f64, without table and without sharing vertices.

use super::TETRAHEDRA;

type Point = [f64; 3];

/// Triangles as three points each, for values `[nz, ny, nx]`.
pub fn triangles(nx: usize, ny: usize, nz: usize, values: &[f64], level: f64) -> Vec<[Point; 3]> {
    let mut out = Vec::new();
    for z in 0..nz.saturating_sub(1) {
        for y in 0..ny.saturating_sub(1) {
            for x in 0..nx.saturating_sub(1) {
                for t in TETRAHEDRA {
                    cut(
                        t.map(|c| {
                            let [x, y, z] = [x + (c & 1), y + (c >> 1 & 1), z + (c >> 2)];
                            ([x as f64, y as f64, z as f64], values[(z * ny + y) * nx + x] - level)
                        }),
                        &mut out,
                    );
                }
            }
        }
    }
    out
}

/// The surface in one tetrahedron of corners with their values over the level.
fn cut(corners: [(Point, f64); 4], out: &mut Vec<[Point; 3]>) {
    let within: Vec<_> = corners.iter().filter(|c| c.1 > 0.0).collect();
    let without: Vec<_> = corners.iter().filter(|c| c.1 <= 0.0).collect();
    let crossing =
        |a: &(Point, f64), b: &(Point, f64)| -> Point { std::array::from_fn(|k| a.0[k] + a.1 / (a.1 - b.1) * (b.0[k] - a.0[k])) };
    // Crossings in the order of a ring around the inside.
    let ring: Vec<Point> = match (within.len(), without.len()) {
        (1, 3) => without.iter().map(|b| crossing(within[0], b)).collect(),
        (3, 1) => within.iter().map(|a| crossing(a, without[0])).collect(),
        (2, 2) => [(0, 0), (0, 1), (1, 1), (1, 0)].iter().map(|(a, b)| crossing(within[*a], without[*b])).collect(),
        _ => return,
    };
    let minus = |a: Point, b: Point| -> Point { std::array::from_fn(|k| a[k] - b[k]) };
    for k in 1..ring.len() - 1 {
        let [p, q, r] = [ring[0], ring[k], ring[k + 1]];
        let (u, v) = (minus(q, p), minus(r, p));
        let normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        let down = minus(without[0].0, within[0].0);
        let outward = (0..3).map(|k| normal[k] * down[k]).sum::<f64>() > 0.0;
        out.push(if outward { [p, q, r] } else { [p, r, q] });
    }
}
