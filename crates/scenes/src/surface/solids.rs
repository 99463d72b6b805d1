//! Closed solids: boxes, surfaces of revolution, tubes, moldings and balls.

use super::Surface;
use diorama_geom::glam::{DVec2, DVec3, dvec2, dvec3};
use std::f64::consts::TAU;

impl Surface {
    /// An axis-aligned box.
    pub fn cuboid(&mut self, lo: DVec3, hi: DVec3) {
        let p = |k: usize| {
            let pick = |bit: usize, lo: f64, hi: f64| if k >> bit & 1 == 1 { hi } else { lo };
            dvec3(pick(0, lo.x, hi.x), pick(1, lo.y, hi.y), pick(2, lo.z, hi.z))
        };
        for face in [[0, 1, 5, 4], [3, 2, 6, 7], [2, 0, 4, 6], [1, 3, 7, 5], [2, 3, 1, 0], [4, 5, 7, 6]] {
            self.polygon(&face.map(p));
        }
    }

    /// A surface of revolution about the vertical axis through `base`: points of `profile` are (radius, height), upward.
    /// It is closed if the first and the last radius are 0.
    pub fn lathe(&mut self, base: DVec3, profile: &[DVec2], segments: usize) {
        let widest = profile.iter().map(|p| p.x).fold(0.0, f64::max);
        let lengths = lengths_along(profile);
        self.grid(segments, profile.len() - 1, |i, j| {
            let angle = (i % segments) as f64 / segments as f64 * TAU;
            let (r, z) = (profile[j].x, profile[j].y);
            (base + dvec3(r * angle.cos(), r * angle.sin(), z), dvec2(i as f64 / segments as f64 * TAU * widest, -lengths[j]))
        });
    }

    /// A ball.
    pub fn ball(&mut self, center: DVec3, radius: f64, segments: usize) {
        let rows = segments / 2;
        let profile: Vec<DVec2> = (0..=rows)
            .map(|j| {
                let a = (j as f64 / rows as f64 - 0.5) * std::f64::consts::PI;
                let r = if j == 0 || j == rows { 0.0 } else { radius * a.cos() };
                dvec2(r, radius * a.sin())
            })
            .collect();
        self.lathe(center, &profile, segments);
    }

    /// A closed tube around a path, with a radius at each point. `u` runs around, `v` against the path.
    pub fn tube(&mut self, path: &[DVec3], radii: &[f64], sides: usize) {
        self.loft(path, sides, |j, angle| dvec2(angle.cos(), angle.sin()) * radii[j]);
    }

    /// A closed tube whose cross-section at point `j` of the path is `section(j, angle)`, counterclockwise seen from the path's end.
    pub fn loft(&mut self, path: &[DVec3], sides: usize, section: impl Fn(usize, f64) -> DVec2) {
        let n = path.len();
        let direction = |j: usize| (path[(j + 1).min(n - 1)] - path[j.saturating_sub(1)]).normalize();
        // Frames without twist: each turns the last one by the smallest rotation.
        let mut x = if direction(0).x.abs() < 0.9 { DVec3::X } else { DVec3::Y };
        let frames: Vec<[DVec3; 2]> = (0..n)
            .map(|j| {
                let d = direction(j);
                x = (x - d * x.dot(d)).normalize();
                [x, d.cross(x)]
            })
            .collect();
        let mut length = vec![0.0; n];
        for j in 1..n {
            length[j] = length[j - 1] + path[j].distance(path[j - 1]);
        }
        let around = TAU * (0..n).map(|j| section(j, 0.0).length()).fold(0.0, f64::max);
        let ring = |i: usize, j: usize| {
            let s = section(j, (i % sides) as f64 / sides as f64 * TAU);
            path[j] + frames[j][0] * s.x + frames[j][1] * s.y
        };
        self.grid(sides, n - 1, |i, j| (ring(i, j), dvec2(i as f64 / sides as f64 * around, -length[j])));
        for (j, is_end) in [(0, false), (n - 1, true)] {
            let uv = |i: usize| section(j, (i % sides) as f64 / sides as f64 * TAU);
            for i in 0..sides {
                let (a, b) = if is_end { (i, i + 1) } else { (i + 1, i) };
                self.triangle([(path[j], DVec2::ZERO), (ring(a, j), uv(a)), (ring(b, j), uv(b))]);
            }
        }
    }

    /// A molding on a wall that faces −y: `profile`, counterclockwise, has points (distance from the wall, height); it runs from `x0` to `x1`.
    pub fn molding(&mut self, profile: &[DVec2], x0: f64, x1: f64) {
        self.prism(profile, |p, end| dvec3(if end { x1 } else { x0 }, -p.x, p.y));
    }

    /// A closed prism over a simple polygon: `at(point, false)` is one end, `at(point, true)` the other.
    /// The polygon is counterclockwise seen from the first end toward which its normal points.
    pub fn prism(&mut self, outline: &[DVec2], at: impl Fn(DVec2, bool) -> DVec3) {
        let n = outline.len();
        for k in 0..n {
            let (a, b) = (outline[k], outline[(k + 1) % n]);
            self.polygon(&[at(a, false), at(a, true), at(b, true), at(b, false)]);
        }
        for [a, b, c] in ear_clip(outline) {
            let [a, b, c] = [a, b, c].map(|k| outline[k]);
            self.polygon(&[at(a, false), at(b, false), at(c, false)]);
            self.polygon(&[at(a, true), at(c, true), at(b, true)]);
        }
    }

    /// A plate over a polygon of points (x, z), counterclockwise seen from −y, between two depths.
    pub fn plate(&mut self, outline: &[DVec2], y0: f64, y1: f64) {
        self.prism(outline, |p, end| dvec3(p.x, if end { y1 } else { y0 }, p.y));
    }
}

/// Lengths from the first point along a polyline.
fn lengths_along(points: &[DVec2]) -> Vec<f64> {
    let mut total = 0.0;
    (0..points.len())
        .map(|j| {
            total += if j > 0 { points[j].distance(points[j - 1]) } else { 0.0 };
            total
        })
        .collect()
}

/// Points of a circular arc, `steps + 1` of them, between two angles in radians.
pub fn arc(center: DVec2, radius: f64, from: f64, to: f64, steps: usize) -> Vec<DVec2> {
    let at = |k: usize| from + (to - from) * k as f64 / steps as f64;
    (0..=steps).map(|k| center + dvec2(at(k).cos(), at(k).sin()) * radius).collect()
}

/// Triangles of a simple counterclockwise polygon, by clipping ears.
fn ear_clip(outline: &[DVec2]) -> Vec<[usize; 3]> {
    let mut left: Vec<usize> = (0..outline.len()).collect();
    let mut out = Vec::new();
    let turn = |a: usize, b: usize, c: usize| (outline[b] - outline[a]).perp_dot(outline[c] - outline[a]);
    while left.len() > 2 {
        let n = left.len();
        let corner = |k: usize| (left[(k + n - 1) % n], left[k], left[(k + 1) % n]);
        let is_ear = |k: &usize| {
            let (a, b, c) = corner(*k);
            let inside = |p: usize| turn(a, b, p) >= 0.0 && turn(b, c, p) >= 0.0 && turn(c, a, p) >= 0.0;
            turn(a, b, c) > 1e-12 && !left.iter().any(|&p| p != a && p != b && p != c && inside(p))
        };
        let Some(k) = (0..n).find(is_ear) else { break };
        let (a, b, c) = corner(k);
        out.push([a, b, c]);
        left.remove(k);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solids_are_closed_and_have_the_volumes_of_their_formulas() {
        let volume = |build: &dyn Fn(&mut Surface)| {
            let mut s = Surface::default();
            build(&mut s);
            assert!(s.is_closed());
            s.mesh(1.0).volume()
        };
        let profile = [dvec2(0.0, 0.0), dvec2(1.0, 0.0), dvec2(1.0, 2.0), dvec2(0.0, 2.0)];
        // A regular prism with n sides has the area n/2 sin(2π/n).
        let disk = 16.0 * (TAU / 32.0).sin();
        assert!((volume(&|s| s.lathe(DVec3::ZERO, &profile, 32)) - 2.0 * disk).abs() < 1e-5);
        let path = [dvec3(0.0, 0.0, 0.0), dvec3(0.0, 0.0, 3.0)];
        assert!((volume(&|s| s.tube(&path, &[1.0, 1.0], 32)) - 3.0 * disk).abs() < 1e-5);
        let step = [dvec2(0.0, 0.0), dvec2(2.0, 0.0), dvec2(2.0, 1.0), dvec2(1.0, 1.0), dvec2(1.0, 2.0), dvec2(0.0, 2.0)];
        assert!((volume(&|s| s.plate(&step, 0.0, 2.0)) - 6.0).abs() < 1e-6);
        assert!((volume(&|s| s.molding(&step, 0.0, 2.0)) - 6.0).abs() < 1e-6);
    }
}
