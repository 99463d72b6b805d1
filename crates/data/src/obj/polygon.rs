//! Triangles of planar polygons.

use diorama_geom::glam::{DVec2, DVec3};

/// Polygons with more corners are cut into a fan, in place of a search among all corners.
const MOST_CORNERS: usize = 256;

/// Cuts a polygon into triangles of its corners' indices by clipping ears, so that concave polygons keep their shape.
pub fn triangulate(corners: &[DVec3]) -> Vec<[usize; 3]> {
    let n = corners.len();
    let fan = || (2..n).map(|i| [0, i - 1, i]).collect();
    if !(4..=MOST_CORNERS).contains(&n) {
        return fan();
    }
    // Newell's normal.
    let normal: DVec3 = (0..n).map(|i| corners[i].cross(corners[(i + 1) % n])).sum();
    let Some(normal) = normal.try_normalize() else { return fan() };
    let (right, up) = normal.any_orthonormal_pair();
    let flat: Vec<DVec2> = corners.iter().map(|p| DVec2::new(p.dot(right), p.dot(up))).collect();
    let turn = |[a, b, c]: [usize; 3]| (flat[b] - flat[a]).perp_dot(flat[c] - flat[a]);
    let mut open: Vec<usize> = (0..n).collect();
    let mut out = Vec::with_capacity(n - 2);
    while open.len() > 3 {
        let m = open.len();
        let ear = |i: usize| [open[(i + m - 1) % m], open[i], open[(i + 1) % m]];
        let is_ear = |[a, b, c]: [usize; 3]| {
            let covers = |p: usize| turn([a, b, p]) >= 0.0 && turn([b, c, p]) >= 0.0 && turn([c, a, p]) >= 0.0;
            turn([a, b, c]) > 0.0 && !open.iter().any(|p| ![a, b, c].contains(p) && covers(*p))
        };
        // The second corner first: convex polygons become the usual fan around the first one.
        let i = (1..=m).map(|i| i % m).find(|i| is_ear(ear(*i))).unwrap_or(1);
        out.push(ear(i));
        open.remove(i);
    }
    out.push([open[0], open[1], open[2]]);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(corners: &[DVec3], triangles: &[[usize; 3]]) -> f64 {
        let of = |[a, b, c]: [usize; 3]| (corners[b] - corners[a]).cross(corners[c] - corners[a]).length() / 2.0;
        triangles.iter().map(|t| of(*t)).sum()
    }

    #[test]
    fn a_square_is_a_fan_around_its_first_corner() {
        let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(|[x, y]| DVec3::new(x, 0.0, y));
        assert_eq!(triangulate(&square), [[0, 1, 2], [0, 2, 3]]);
    }

    #[test]
    fn concave_polygons_are_covered_once() {
        // An arrow head and a comb, tilted in space.
        let arrow: &[[f64; 2]] = &[[0.0, 0.0], [2.0, 1.0], [0.0, 2.0], [0.5, 1.0]];
        let comb: &[[f64; 2]] =
            &[[0.0, 0.0], [5.0, 0.0], [5.0, 2.0], [4.0, 2.0], [4.0, 1.0], [3.0, 1.0], [3.0, 2.0], [2.0, 2.0], [2.0, 1.0], [0.0, 1.0]];
        for (shape, want) in [(arrow, 1.5), (comb, 7.0)] {
            let (x, y) = (DVec3::new(0.6, 0.8, 0.0), DVec3::new(0.0, 0.0, 1.0));
            // From every corner.
            for first in 0..shape.len() {
                let corners: Vec<DVec3> = (0..shape.len()).map(|i| shape[(first + i) % shape.len()]).map(|[u, v]| u * x + v * y).collect();
                let triangles = triangulate(&corners);
                assert_eq!(triangles.len(), shape.len() - 2);
                assert!((area(&corners, &triangles) - want).abs() < 1e-9, "{triangles:?}");
            }
        }
    }

    #[test]
    fn polygons_without_area_still_give_triangles() {
        assert_eq!(triangulate(&[DVec3::ZERO; 5]).len(), 3);
        assert_eq!(triangulate(&[DVec3::ZERO; 2]).len(), 0);
    }
}
