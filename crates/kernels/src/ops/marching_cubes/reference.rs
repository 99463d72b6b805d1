//! Cell by cell in f64, without sharing vertices.

use super::case_table;

/// Triangles as three points each, for values `[nz, ny, nx]`.
pub fn triangles(nx: usize, ny: usize, nz: usize, values: &[f64], level: f64) -> Vec<[[f64; 3]; 3]> {
    let table = case_table();
    let mut out = Vec::new();
    for z in 0..nz.saturating_sub(1) {
        for y in 0..ny.saturating_sub(1) {
            for x in 0..nx.saturating_sub(1) {
                let place = |c: usize| [x + (c & 1), y + ((c >> 1) & 1), z + (c >> 2)];
                let value = |c: usize| {
                    let [x, y, z] = place(c);
                    values[(z * ny + y) * nx + x]
                };
                let inside = (0..8).filter(|&c| value(c) > level).map(|c| 1 << c).sum::<usize>();
                for t in &table.triangles[inside] {
                    out.push(t.map(|e| {
                        let (a, b) = (e.corner, e.corner | e.direction);
                        let f = (level - value(a)) / (value(b) - value(a));
                        let (p, q) = (place(a), place(b));
                        std::array::from_fn(|k| p[k] as f64 + f * (q[k] as f64 - p[k] as f64))
                    }));
                }
            }
        }
    }
    out
}
