//! Walls with openings: a wall stands in the plane y = 0, faces −y, and its openings have reveals that lead inward along +y.

use crate::surface::{Surface, arc};
use diorama_geom::glam::{DVec2, DVec3, dvec2, dvec3};
use std::f64::consts::PI;

/// Segments of half a circle.
const ARC: usize = 12;

/// A hole in a wall.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Opening {
    /// Middle.
    pub x: f64,
    pub width: f64,
    pub bottom: f64,
    pub top: f64,
    /// Half a circle ends it above.
    pub is_arched: bool,
    /// A whole circle; width and height agree.
    pub is_round: bool,
}

impl Opening {
    /// A rectangle.
    pub fn rectangle(x: f64, width: f64, bottom: f64, top: f64) -> Opening {
        Opening { x, width, bottom, top, is_arched: false, is_round: false }
    }

    /// A rectangle under half a circle that ends at `top`.
    pub fn arched(x: f64, width: f64, bottom: f64, top: f64) -> Opening {
        Opening { is_arched: true, ..Opening::rectangle(x, width, bottom, top) }
    }

    /// A circle.
    pub fn circle(x: f64, z: f64, radius: f64) -> Opening {
        Opening { is_arched: true, is_round: true, ..Opening::rectangle(x, 2.0 * radius, z - radius, z + radius) }
    }

    /// Height at which the arch begins.
    pub fn spring(&self) -> f64 {
        if self.is_arched { self.top - 0.5 * self.width } else { self.top }
    }

    /// Points (x, z) of the outline, counterclockwise seen from outside, made smaller by `inset`; it begins on the left, below the arch.
    pub fn outline(&self, inset: f64) -> Vec<DVec2> {
        let (radius, spring) = (0.5 * self.width - inset, self.spring());
        let (left, right, bottom, top) = (self.x - radius, self.x + radius, self.bottom + inset, self.top - inset);
        let mut points = if self.is_round {
            arc(dvec2(self.x, spring), radius, PI, 2.0 * PI, ARC)
        } else {
            vec![dvec2(left, bottom), dvec2(right, bottom)]
        };
        if self.is_arched {
            let mut over = arc(dvec2(self.x, spring), radius, 0.0, PI, ARC);
            if self.is_round {
                over = over[1..ARC].to_vec();
            }
            points.extend(over);
        } else {
            points.extend([dvec2(right, top), dvec2(left, top)]);
        }
        points
    }
}

/// Adds a rectangle of the plane at depth `y` that faces −y.
pub fn front(surface: &mut Surface, x: [f64; 2], z: [f64; 2], y: f64) {
    if x[1] > x[0] && z[1] > z[0] {
        surface.polygon(&[dvec3(x[0], y, z[0]), dvec3(x[1], y, z[0]), dvec3(x[1], y, z[1]), dvec3(x[0], y, z[1])]);
    }
}

/// Adds a wall over `x` and `z` at depth 0 with reveals of the given depth. Openings are sorted by x and do not overlap.
pub fn wall(surface: &mut Surface, x: [f64; 2], z: [f64; 2], depth: f64, openings: &[Opening]) {
    let mut from = x[0];
    for o in openings {
        let (left, right) = (o.x - 0.5 * o.width, o.x + 0.5 * o.width);
        front(surface, [from, left], z, 0.0);
        front(surface, [left, right], [z[0], o.bottom], 0.0);
        front(surface, [left, right], [o.top, z[1]], 0.0);
        let outline = o.outline(0.0);
        if o.is_arched {
            spandrels(surface, o, &outline);
        }
        // A reveal without a sill where the opening reaches the lower edge of the wall.
        let first = if o.bottom <= z[0] { 1 } else { 0 };
        ring(surface, &outline[..], first, [0.0, depth]);
        from = right;
    }
    front(surface, [from, x[1]], z, 0.0);
}

/// The faces between an arch and its bounding box.
fn spandrels(surface: &mut Surface, o: &Opening, outline: &[DVec2]) {
    let at = |p: DVec2| dvec3(p.x, 0.0, p.y);
    let mut fan = |corner: DVec2, from: usize| {
        for k in from..from + ARC / 2 {
            let (a, b) = (outline[k % outline.len()], outline[(k + 1) % outline.len()]);
            surface.polygon(&[at(corner), at(b), at(a)]);
        }
    };
    let (left, right) = (o.x - 0.5 * o.width, o.x + 0.5 * o.width);
    let start = if o.is_round { ARC } else { 2 };
    fan(dvec2(right, o.top), start);
    fan(dvec2(left, o.top), start + ARC / 2);
    if o.is_round {
        fan(dvec2(left, o.bottom), 0);
        fan(dvec2(right, o.bottom), ARC / 2);
    }
}

/// Faces along an outline that look toward its middle, between two depths; the first `skipped` edges are left out.
pub fn ring(surface: &mut Surface, outline: &[DVec2], skipped: usize, y: [f64; 2]) {
    let n = outline.len();
    let at = |p: DVec2, y: f64| dvec3(p.x, y, p.y);
    for k in skipped..n {
        let (a, b) = (outline[k], outline[(k + 1) % n]);
        surface.polygon(&[at(a, y[0]), at(b, y[0]), at(b, y[1]), at(a, y[1])]);
    }
}

/// A closed frame between two outlines of the same number of points, from depth `y[0]` in front to `y[1]`.
pub fn frame(surface: &mut Surface, outer: &[DVec2], inner: &[DVec2], y: [f64; 2]) {
    let n = outer.len();
    let at = |p: DVec2, y: f64| dvec3(p.x, y, p.y);
    for k in 0..n {
        let m = (k + 1) % n;
        let (a, b, c, d) = (outer[k], outer[m], inner[m], inner[k]);
        surface.polygon(&[at(a, y[0]), at(b, y[0]), at(c, y[0]), at(d, y[0])]);
        surface.polygon(&[at(d, y[1]), at(c, y[1]), at(b, y[1]), at(a, y[1])]);
        surface.polygon(&[at(a, y[1]), at(b, y[1]), at(b, y[0]), at(a, y[0])]);
        surface.polygon(&[at(d, y[0]), at(c, y[0]), at(c, y[1]), at(d, y[1])]);
    }
}

/// A pane over a convex outline that faces −y.
pub fn pane(surface: &mut Surface, outline: &[DVec2], y: f64) {
    let points: Vec<DVec3> = outline.iter().map(|p| dvec3(p.x, y, p.y)).collect();
    surface.polygon(&points);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Area of the faces of a surface that look toward −y.
    fn front_area(s: &Surface) -> f64 {
        let mesh = s.mesh(1.0);
        let area = |f: &[u32; 3]| {
            let [a, b, c] = f.map(|i| DVec3::from(mesh.positions[i as usize].map(f64::from)));
            (b - a).cross(c - a) * 0.5
        };
        mesh.faces.iter().map(area).filter(|n| n.y < -1e-9).map(|n| n.length()).sum()
    }

    #[test]
    fn openings_take_their_area_out_of_the_wall() {
        let openings = [Opening::rectangle(1.5, 1.0, 0.5, 2.0), Opening::arched(4.0, 2.0, 0.0, 3.0), Opening::circle(7.0, 2.0, 0.8)];
        let mut s = Surface::default();
        wall(&mut s, [0.0, 9.0], [0.0, 4.0], 0.2, &openings);
        // Half a circle of 12 segments has the area 6 sin(π/12) r².
        let half = 0.5 * ARC as f64 * (PI / ARC as f64).sin();
        let holes = 1.5 + (4.0 + half) + 2.0 * half * 0.64;
        assert!((front_area(&s) - (36.0 - holes)).abs() < 1e-4, "{}", front_area(&s));
    }

    #[test]
    fn frames_are_closed() {
        for o in [Opening::rectangle(0.0, 1.0, 0.5, 2.0), Opening::arched(0.0, 1.0, 0.0, 2.0), Opening::circle(0.0, 2.0, 0.8)] {
            let mut s = Surface::default();
            frame(&mut s, &o.outline(0.0), &o.outline(0.1), [0.1, 0.2]);
            assert!(s.is_closed() && s.mesh(1.0).volume() > 0.0, "{o:?}");
        }
    }
}
