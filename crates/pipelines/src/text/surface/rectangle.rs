//! The smallest rectangle that holds the points of a surface, in coordinates of length along it, and its pose.

use super::fit::{Kind, Surface};
use diorama_geom::glam::{DMat2, DMat3, DVec2, DVec3, dvec2};
use serde::{Deserialize, Serialize};

/// Share of the points, the most central ones, that the rectangle holds.
const CENTRAL: f64 = 0.99;
/// Steps by which lengths along a curve are summed (Simpson's rule needs an even number).
const STEPS: usize = 64;
/// Steps of Newton's method from a length to its place.
const INVERSIONS: usize = 30;

/// A rectangle on a surface. Its coordinates `(x, y)` are lengths along the surface from its middle: x along the longer side.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rectangle {
    pub surface: Surface,
    /// Longer and shorter side.
    pub size: DVec2,
    /// Directions of the surface's strongest and weakest bend in its plane, and where lengths begin.
    bends: DMat2,
    from: DVec2,
    /// From coordinates of the rectangle to lengths along the bends.
    lengths_from_own: DMat2,
    middle: DVec2,
    /// Quarter turns counterclockwise from x to the reading direction.
    pub quarter_turns: u8,
}

impl Rectangle {
    /// The world's point at coordinates.
    pub fn point(&self, at: DVec2) -> DVec3 {
        self.surface.point(self.place(at))
    }

    pub(super) fn place(&self, at: DVec2) -> DVec2 {
        let lengths = self.middle + self.lengths_from_own * at;
        let along = |k: usize| inverse(&self.surface, self.from, self.bends.col(k), lengths[k]);
        self.from + self.bends * dvec2(along(0), along(1))
    }

    /// Coordinates of a point of the surface's plane.
    pub(super) fn locate(&self, place: DVec2) -> DVec2 {
        self.lengths_from_own.transpose() * (lengths(&self.surface, self.from, self.bends, place) - self.middle)
    }

    /// A rectangle whose reading direction is that of unit length `along`, from `low` to `high` along and across it, all in lengths along the
    /// bends of a surface from `from`.
    pub(super) fn reading_along(surface: &Surface, from: DVec2, along: DVec2, [low, high]: [DVec2; 2]) -> Rectangle {
        let across = dvec2(-along.y, along.x);
        let (size, middle) = (high - low, DMat2::from_cols(along, across) * (0.5 * (low + high)));
        // Upright text: x points down, and a quarter turn leads to the reading direction.
        let (x, size, quarter_turns) = if size.x >= size.y { (along, size, 0) } else { (-across, dvec2(size.y, size.x), 1) };
        let own = DMat2::from_cols(x, dvec2(-x.y, x.x));
        Rectangle { surface: *surface, size, bends: bends(surface), from, lengths_from_own: own, middle, quarter_turns }
    }

    /// Corners from the upper left, clockwise, as the rectangle's own axes say.
    pub fn corners(&self) -> [DVec3; 4] {
        let h = 0.5 * self.size;
        [dvec2(-h.x, h.y), h, dvec2(h.x, -h.y), -h].map(|at| self.point(at))
    }

    /// Pose at the middle: x along the longer side, y up, z the normal.
    pub fn world_from_region(&self) -> (DMat3, DVec3) {
        let z = self.surface.normal(self.place(DVec2::ZERO));
        let step = 1e-4 * self.size.x;
        let x = self.point(dvec2(step, 0.0)) - self.point(dvec2(-step, 0.0));
        let x = (x - z * x.dot(z)).normalize();
        (DMat3::from_cols(x, z.cross(x), z), self.point(DVec2::ZERO))
    }
}

/// Length along the surface from `from` in a direction of its plane, signed.
fn length(surface: &Surface, from: DVec2, direction: DVec2, to: f64) -> f64 {
    if surface.kind == Kind::Plane {
        return to;
    }
    let speed = |t: f64| (1.0 + surface.height_at(from + t * direction).1.dot(direction).powi(2)).sqrt();
    let step = to / STEPS as f64;
    let weight = |k: usize| if k == 0 || k == STEPS { 1.0 } else { 2.0 + 2.0 * (k % 2) as f64 };
    (0..=STEPS).map(|k| weight(k) * speed(k as f64 * step)).sum::<f64>() * step / 3.0
}

/// Lengths along both bends from `from` to a place.
pub(super) fn lengths(surface: &Surface, from: DVec2, bends: DMat2, place: DVec2) -> DVec2 {
    let at = bends.transpose() * (place - from);
    dvec2(length(surface, from, bends.x_axis, at.x), length(surface, from, bends.y_axis, at.y))
}

/// Where so much length is reached.
fn inverse(surface: &Surface, from: DVec2, direction: DVec2, wanted: f64) -> f64 {
    let mut t = wanted;
    for _ in 0..INVERSIONS {
        let speed = (1.0 + surface.height_at(from + t * direction).1.dot(direction).powi(2)).sqrt();
        let off = length(surface, from, direction, t) - wanted;
        t -= off / speed;
        if off.abs() < 1e-13 * (1.0 + wanted.abs()) {
            break;
        }
    }
    t
}

/// The rectangle of the most central points on a surface. `reading` points about along the reading direction in the world; none: the longer
/// side to the right of a viewer whose up is `up`.
pub fn rectangle(surface: &Surface, points: &[DVec3], reading: Option<DVec3>, up: DVec3) -> Rectangle {
    let places: Vec<DVec2> = points.iter().map(|p| surface.nearest(*p).0).collect();
    let from = places.iter().sum::<DVec2>() / places.len().max(1) as f64;
    let bends = bends(surface);
    let mut lengths: Vec<DVec2> = places.iter().map(|p| lengths(surface, from, bends, *p)).collect();
    keep_central(&mut lengths);
    let (axis, low, high) = smallest(&hull(lengths));
    let across = dvec2(-axis.y, axis.x);
    let mut size = high - low;
    let middle = DMat2::from_cols(axis, across) * (0.5 * (low + high));
    let mut x = axis;
    if size.y > size.x {
        (x, size) = (across, dvec2(size.y, size.x));
    }
    let own = |x: DVec2| DMat2::from_cols(x, dvec2(-x.y, x.x));
    let with = |x: DVec2| Rectangle { surface: *surface, size, bends, from, lengths_from_own: own(x), middle, quarter_turns: 0 };
    let mut out = with(x);
    let (pose, _) = out.world_from_region();
    let reading = reading.unwrap_or_else(|| {
        // To the right of who looks at the surface upright.
        let right = up.cross(pose.z_axis);
        if right.length() > 1e-9 { right } else { pose.x_axis }
    });
    // Text along the longer side turns x; text along the shorter one counts quarter turns.
    let [along, above] = [pose.x_axis.dot(reading), pose.y_axis.dot(reading)];
    if along.abs() >= above.abs() {
        if along < 0.0 {
            out = with(-x);
        }
    } else {
        out.quarter_turns = if above > 0.0 { 1 } else { 3 };
    }
    out
}

/// Keeps [`CENTRAL`] of the points, by Mahalanobis' distance: what a long rectangle loses is then its corners, not its ends.
fn keep_central(points: &mut Vec<DVec2>) {
    let n = points.len().max(1) as f64;
    let mean = points.iter().sum::<DVec2>() / n;
    let sum = |f: &dyn Fn(DVec2) -> f64| points.iter().map(|p| f(*p - mean)).sum::<f64>() / n;
    let (xx, xy, yy) = (sum(&|d| d.x * d.x), sum(&|d| d.x * d.y), sum(&|d| d.y * d.y));
    let far = |p: &DVec2| {
        let d = *p - mean;
        yy * d.x * d.x - 2.0 * xy * d.x * d.y + xx * d.y * d.y
    };
    points.sort_by(|a, b| far(a).total_cmp(&far(b)));
    points.truncate(((CENTRAL * n).ceil() as usize).max(1));
}

/// Directions of a quadric's strongest and weakest bend; of a plane its axes.
pub(super) fn bends(surface: &Surface) -> DMat2 {
    let [a, b, c, ..] = surface.height;
    let angle = 0.5 * b.atan2(a - c);
    let first = dvec2(angle.cos(), angle.sin());
    let bend = |d: DVec2| (a * d.x * d.x + b * d.x * d.y + c * d.y * d.y).abs();
    let second = dvec2(-first.y, first.x);
    if bend(first) >= bend(second) { DMat2::from_cols(first, second) } else { DMat2::from_cols(second, -first) }
}

/// Convex hull, counterclockwise (Andrew's monotone chain).
pub(in crate::text) fn hull(mut points: Vec<DVec2>) -> Vec<DVec2> {
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    let half = |points: &mut dyn Iterator<Item = DVec2>| {
        let mut out: Vec<DVec2> = Vec::new();
        for p in points {
            while out.len() > 1 && (out[out.len() - 1] - out[out.len() - 2]).perp_dot(p - out[out.len() - 2]) <= 0.0 {
                out.pop();
            }
            out.push(p);
        }
        out.pop();
        out
    };
    let mut out = half(&mut points.iter().copied());
    out.extend(half(&mut points.iter().rev().copied()));
    if out.is_empty() {
        points.truncate(1);
        return points;
    }
    out
}

/// The direction of a side of the smallest rectangle around a hull, which lies along one of its edges, with its bounds along and across.
pub(in crate::text) fn smallest(hull: &[DVec2]) -> (DVec2, DVec2, DVec2) {
    let bounds = |axis: DVec2| {
        let own = |p: &DVec2| dvec2(p.dot(axis), p.dot(dvec2(-axis.y, axis.x)));
        let (low, high) = (hull.iter().map(own).reduce(DVec2::min), hull.iter().map(own).reduce(DVec2::max));
        (axis, low.unwrap_or_default(), high.unwrap_or_default())
    };
    let area = |b: &(DVec2, DVec2, DVec2)| (b.2 - b.1).x * (b.2 - b.1).y;
    let edges = (0..hull.len()).filter_map(|k| (hull[(k + 1) % hull.len()] - hull[k]).try_normalize());
    edges.map(bounds).min_by(|a, b| area(a).total_cmp(&area(b))).unwrap_or_else(|| bounds(DVec2::X))
}

/// Corners of the smallest rectangle around points of a plane, clockwise from the upper left of one who reads about along `reading`, y up.
pub fn plane_rectangle(points: Vec<DVec2>, reading: DVec2) -> [DVec2; 4] {
    let (mut x, low, high) = smallest(&hull(points));
    let corner = |a: f64, b: f64, x: DVec2| x * a + dvec2(-x.y, x.x) * b;
    let mut corners = [(low.x, high.y), (high.x, high.y), (high.x, low.y), (low.x, low.y)].map(|(a, b)| corner(a, b, x));
    // Turned until its first side is the one most along the reading direction.
    while x.dot(reading) < std::f64::consts::FRAC_1_SQRT_2 - 1e-9 {
        x = dvec2(x.y, -x.x);
        corners.rotate_left(1);
    }
    corners
}
