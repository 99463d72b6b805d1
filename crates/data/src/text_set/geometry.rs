//! Areas, bounds and crossings of polygons in pixels (y down).

/// Area in square pixels, positive for clockwise corners (shoelace formula).
pub fn signed_area(polygon: &[[f64; 2]]) -> f64 {
    let n = polygon.len();
    (0..n).map(|k| polygon[k][0] * polygon[(k + 1) % n][1] - polygon[k][1] * polygon[(k + 1) % n][0]).sum::<f64>() / 2.0
}

/// Left, top, right and bottom.
pub fn bounds(polygon: &[[f64; 2]]) -> [f64; 4] {
    let start = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
    polygon.iter().fold(start, |b, p| [b[0].min(p[0]), b[1].min(p[1]), b[2].max(p[0]), b[3].max(p[1])])
}

/// Left, top, width and height.
pub fn left_top_size(polygon: &[[f64; 2]]) -> [f64; 4] {
    let [left, top, right, bottom] = bounds(polygon);
    [left, top, right - left, bottom - top]
}

/// Whether two rectangles of [`bounds`] share a point.
pub fn overlap(a: [f64; 4], b: [f64; 4]) -> bool {
    a[0] <= b[2] && b[0] <= a[2] && a[1] <= b[3] && b[1] <= a[3]
}

/// The first two sides that cross, each as the index of its first corner.
pub fn crossing(polygon: &[[f64; 2]]) -> Option<(usize, usize)> {
    let n = polygon.len();
    let turn = |a: [f64; 2], b: [f64; 2], c: [f64; 2]| (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    for i in 0..n {
        let (a, b) = (polygon[i], polygon[(i + 1) % n]);
        for j in i + 2..n {
            let (c, d) = (polygon[j], polygon[(j + 1) % n]);
            let are_neighbors = (j + 1) % n == i;
            if !are_neighbors && turn(a, b, c) * turn(a, b, d) < 0.0 && turn(c, d, a) * turn(c, d, b) < 0.0 {
                return Some((i, j));
            }
        }
    }
    None
}

/// The coordinates one after the other: x1, y1, x2, y2, ….
pub fn flat(polygon: &[[f64; 2]]) -> Vec<f64> {
    polygon.iter().flatten().copied().collect()
}
