//! Polygons in the plane of an image: areas, intersections, distances and the smallest rectangle around points. Lengths are in pixels, y
//! points down, and a corner's coordinates count from the upper left corner of the first pixel.

use crate::text::surface::{hull, smallest};
use diorama_geom::glam::{DVec2, dvec2};
use std::f64::consts::{FRAC_PI_2, PI};

/// Twice the area below which a polygon has none.
const LEAST_AREA: f64 = 1e-9;

/// Area, positive where corners go clockwise on the screen.
pub fn signed_area(polygon: &[DVec2]) -> f64 {
    0.5 * sides(polygon).map(|(a, b)| a.perp_dot(b)).sum::<f64>()
}

/// Length of the boundary.
pub fn perimeter(polygon: &[DVec2]) -> f64 {
    sides(polygon).map(|(a, b)| a.distance(b)).sum()
}

fn sides(polygon: &[DVec2]) -> impl Iterator<Item = (DVec2, DVec2)> {
    let n = polygon.len();
    (0..n).map(move |k| (polygon[k], polygon[(k + 1) % n]))
}

/// Smallest and largest coordinates.
pub fn bounds(polygon: &[DVec2]) -> (DVec2, DVec2) {
    let low = polygon.iter().copied().reduce(DVec2::min).unwrap_or_default();
    (low, polygon.iter().copied().reduce(DVec2::max).unwrap_or_default())
}

/// The part of a polygon on the left of the line from `a` to `b`, as (Sutherland and Hodgman 1974) clip.
fn clipped(polygon: &[DVec2], a: DVec2, b: DVec2) -> Vec<DVec2> {
    let side = |p: DVec2| (b - a).perp_dot(p - a);
    let mut out = Vec::with_capacity(polygon.len() + 2);
    for (p, q) in sides(polygon) {
        let (sp, sq) = (side(p), side(q));
        if sp >= 0.0 {
            out.push(p);
        }
        if (sp > 0.0 && sq < 0.0) || (sp < 0.0 && sq > 0.0) {
            out.push(p + (q - p) * (sp / (sp - sq)));
        }
    }
    out
}

/// Area that two simple polygons share. The second is taken apart into triangles around its first corner, with the signs of their
/// areas, so that neither has to be convex.
pub fn intersection_area(a: &[DVec2], b: &[DVec2]) -> f64 {
    let ((a_low, a_high), (b_low, b_high)) = (bounds(a), bounds(b));
    if a.len() < 3 || b.len() < 3 || a_low.cmpgt(b_high).any() || b_low.cmpgt(a_high).any() {
        return 0.0;
    }
    let mut sum = 0.0;
    for k in 1..b.len() - 1 {
        let mut triangle = [b[0], b[k], b[k + 1]];
        let sign = signed_area(&triangle).signum();
        if sign < 0.0 {
            triangle.swap(1, 2);
        }
        let part = sides(&triangle).fold(a.to_vec(), |part, (p, q)| clipped(&part, p, q));
        sum += sign * signed_area(&part).abs();
    }
    sum.abs()
}

/// Intersection over union of two simple polygons, from 0 to 1; 0 where neither has an area.
pub fn iou(a: &[DVec2], b: &[DVec2]) -> f64 {
    let shared = intersection_area(a, b);
    let union = signed_area(a).abs() + signed_area(b).abs() - shared;
    if union < LEAST_AREA { 0.0 } else { (shared / union).clamp(0.0, 1.0) }
}

/// Whether a point lies inside, by the number of sides that a ray from it crosses.
pub fn contains(polygon: &[DVec2], p: DVec2) -> bool {
    let crosses = |(a, b): (DVec2, DVec2)| (a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x);
    sides(polygon).filter(|s| crosses(*s)).count() % 2 == 1
}

/// Distance of a point to the boundary.
pub fn boundary_distance(polygon: &[DVec2], p: DVec2) -> f64 {
    let to_side = |(a, b): (DVec2, DVec2)| {
        let along = ((p - a).dot(b - a) / (b - a).length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        p.distance(a + (b - a) * along)
    };
    sides(polygon).map(to_side).fold(f64::INFINITY, f64::min)
}

/// A rectangle at an angle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotatedBox {
    pub center: DVec2,
    /// Width along the reading direction and height across it.
    pub size: DVec2,
    /// From the x axis to the reading direction, turning x towards y, in `[−π/2, π/2)`.
    pub angle: f64,
}

impl RotatedBox {
    /// The smallest rectangle around a polygon, whose reading direction is the one that suits the polygon's first side best; text upside
    /// down is taken for upright.
    pub fn around(polygon: &[DVec2]) -> RotatedBox {
        let (axis, low, high) = smallest(&hull(polygon.to_vec()));
        let across = dvec2(-axis.y, axis.x);
        let middle = 0.5 * (low + high);
        let center = axis * middle.x + across * middle.y;
        // Opposite sides together say where the first side points, for outlines of four corners and for others.
        let n = polygon.len();
        let half = (n / 2).max(1);
        let reading = (polygon[half - 1] - polygon[0]) + (polygon[half % n] - polygon[n - 1]);
        let (direction, size) = match reading.dot(axis).abs() >= reading.dot(across).abs() {
            true => (axis, high - low),
            false => (across, dvec2(high.y - low.y, high.x - low.x)),
        };
        RotatedBox { center, size, angle: upright(direction.y.atan2(direction.x)) }
    }

    /// Corners from the upper left in reading order, clockwise.
    pub fn corners(&self) -> [DVec2; 4] {
        let (sin, cos) = self.angle.sin_cos();
        let (x, y) = (dvec2(cos, sin) * (0.5 * self.size.x), dvec2(-sin, cos) * (0.5 * self.size.y));
        [-x - y, x - y, x + y, y - x].map(|d| self.center + d)
    }

    /// The rectangle with every side moved outward by a distance in pixels.
    #[must_use]
    pub fn grown(self, by: f64) -> RotatedBox {
        RotatedBox { size: self.size + 2.0 * by, ..self }
    }

    /// Area in square pixels.
    pub fn area(&self) -> f64 {
        self.size.x * self.size.y
    }
}

/// The angle of the same line in `[−π/2, π/2)`.
fn upright(angle: f64) -> f64 {
    (angle + FRAC_PI_2).rem_euclid(PI) - FRAC_PI_2
}

#[cfg(test)]
pub(in crate::text) mod tests {
    use super::*;
    use proptest::prelude::*;

    pub fn rectangle(x: f64, y: f64, w: f64, h: f64) -> Vec<DVec2> {
        vec![dvec2(x, y), dvec2(x + w, y), dvec2(x + w, y + h), dvec2(x, y + h)]
    }

    #[test]
    fn areas_and_intersections_of_known_shapes() {
        let square = rectangle(0.0, 0.0, 2.0, 2.0);
        assert_eq!((signed_area(&square), perimeter(&square)), (4.0, 8.0));
        assert_eq!(intersection_area(&square, &rectangle(1.0, 1.0, 2.0, 2.0)), 1.0);
        assert!((iou(&square, &rectangle(1.0, 0.0, 2.0, 2.0)) - 1.0 / 3.0).abs() < 1e-12);
        assert_eq!(iou(&square, &rectangle(2.0, 0.0, 2.0, 2.0)), 0.0);
        // A diamond over a square: the corners outside have an area of 1/8 each ...
        let diamond = [dvec2(1.0, -0.5), dvec2(2.5, 1.0), dvec2(1.0, 2.5), dvec2(-0.5, 1.0)];
        assert!((intersection_area(&square, &diamond) - (4.5 - 4.0 * 0.25)).abs() < 1e-12);
        // ... and an L, which is not convex, over the square that it leaves out and one that it holds.
        let l = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0)].map(|(x, y)| dvec2(x, y));
        assert!(intersection_area(&rectangle(1.0, 1.0, 1.0, 1.0), &l).abs() < 1e-12);
        assert!((intersection_area(&l, &rectangle(0.5, 0.5, 1.0, 1.0)) - 0.75).abs() < 1e-12);
        assert!((intersection_area(&l, &l) - 3.0).abs() < 1e-12);
        assert!(contains(&l, dvec2(0.5, 1.5)) && !contains(&l, dvec2(1.5, 1.5)));
        assert!((boundary_distance(&l, dvec2(1.5, 1.5)) - 0.5).abs() < 1e-12);
    }

    #[test]
    fn boxes_read_as_the_polygon_does() {
        let b = RotatedBox { center: dvec2(30.0, 20.0), size: dvec2(5.0, 16.0), angle: 0.4 };
        let again = RotatedBox::around(&b.corners());
        assert!((again.angle - 0.4).abs() < 1e-12 && (again.size - b.size).length() < 1e-9 && (again.center - b.center).length() < 1e-9);
        // Upside down is upright.
        let mut turned = b.corners();
        turned.rotate_left(2);
        assert!((RotatedBox::around(&turned).angle - 0.4).abs() < 1e-12);
        assert_eq!(upright(FRAC_PI_2), -FRAC_PI_2);
        assert_eq!(b.grown(1.0).size, dvec2(7.0, 18.0));
    }

    prop_compose! {
        fn any_box()(x in -20.0..20.0f64, y in -20.0..20.0f64, w in 0.5..30.0f64, h in 0.5..30.0f64, angle in -1.57..1.57f64) -> RotatedBox {
            RotatedBox { center: dvec2(x, y), size: dvec2(w, h), angle }
        }
    }

    proptest! {
        #[test]
        fn iou_is_symmetric_bounded_and_rigid(a in any_box(), b in any_box(), turn in -3.0..3.0f64, shift in -50.0..50.0f64) {
            let (p, q) = (a.corners(), b.corners());
            let v = iou(&p, &q);
            prop_assert!((0.0..=1.0).contains(&v) && (v - iou(&q, &p)).abs() < 1e-9);
            prop_assert!((iou(&p, &p) - 1.0).abs() < 1e-9);
            let moved = |c: [DVec2; 4]| c.map(|p| DVec2::from_angle(turn).rotate(p) + shift);
            prop_assert!((v - iou(&moved(p), &moved(q))).abs() < 1e-7);
            let reversed: Vec<DVec2> = q.iter().rev().copied().collect();
            prop_assert!((v - iou(&p, &reversed)).abs() < 1e-9);
        }

        #[test]
        fn the_smallest_rectangle_of_a_box_is_the_box(a in any_box()) {
            let found = RotatedBox::around(&a.corners());
            prop_assert!(iou(&found.corners(), &a.corners()) > 1.0 - 1e-6);
            prop_assert!((found.angle - a.angle).abs() < 1e-6 && (found.size - a.size).length() < 1e-6);
        }
    }
}
