//! Parked cars: a lofted body with wheel arches, a glazed cabin, wheels and lights.

use super::materials::Materials;
use crate::assembly::{Assembly, Finish};
use crate::surface::Surface;
use diorama_geom::glam::{DAffine3, DVec2, DVec3, dvec2, dvec3};
use std::f64::consts::PI;

/// Lengths of a car along its axis, in meters; the front is at +x.
#[derive(Clone, Copy, Debug)]
pub struct CarShape {
    pub length: f64,
    pub width: f64,
    /// Height of the roof.
    pub roof: f64,
    /// Height of the lower edge of the windows.
    pub belt: f64,
    /// Foot and head of the windshield, head and foot of the rear window.
    pub cabin: [f64; 4],
    /// Front and rear axle.
    pub axles: [f64; 2],
    /// Height of the hood and of the tail.
    pub ends: [f64; 2],
}

/// A small car with a steep back.
pub const HATCHBACK: CarShape = CarShape {
    length: 4.0,
    width: 1.74,
    roof: 1.47,
    belt: 0.92,
    cabin: [0.95, 0.3, -1.35, -1.86],
    axles: [1.25, -1.27],
    ends: [0.72, 0.84],
};

/// A car with a trunk.
pub const SEDAN: CarShape =
    CarShape { length: 4.6, width: 1.8, roof: 1.43, belt: 0.9, cabin: [0.95, 0.25, -1.0, -1.6], axles: [1.42, -1.35], ends: [0.7, 0.88] };

/// A delivery van.
pub const VAN: CarShape =
    CarShape { length: 4.7, width: 1.88, roof: 1.92, belt: 1.05, cabin: [1.5, 0.85, -2.2, -2.3], axles: [1.45, -1.4], ends: [0.86, 1.05] };

const WHEEL: f64 = 0.31;
const ARCH: f64 = 0.365;
const CLEARANCE: f64 = 0.2;

impl CarShape {
    /// Height of the body's upper edge at `x`.
    fn top(&self, x: f64) -> f64 {
        let half = 0.5 * self.length;
        let [foot, _, _, back] = self.cabin;
        let rounded = |d: f64, r: f64| if d < r { r - (r * r - (r - d).powi(2)).max(0.0).sqrt() } else { 0.0 };
        if x > foot {
            let t = (x - foot) / (half - foot);
            self.belt + (self.ends[0] - self.belt) * t.powf(1.3) - rounded(half - x, 0.22)
        } else if x < back {
            let t = (back - x) / (back + half).max(1e-6);
            self.belt + (self.ends[1] - self.belt) * t - rounded(x + half, 0.16)
        } else {
            self.belt
        }
    }

    /// Height of the body's lower edge at `x`: higher over the wheels and at both ends.
    fn bottom(&self, x: f64) -> f64 {
        let half = 0.5 * self.length;
        let lift = (0.14 - (half - x.abs())).max(0.0);
        let arch = self.axles.iter().map(|a| ARCH * ARCH - (x - a).powi(2)).fold(0.0, f64::max).sqrt();
        (CLEARANCE + lift).max(if arch > 0.0 { WHEEL + arch } else { 0.0 })
    }

    /// Half of the width at `x` and height `z`.
    fn half_width(&self, x: f64, z: f64) -> f64 {
        let t = x.abs() / (0.5 * self.length);
        let ends = 1.0 - 0.16 * t.powi(5) - 0.05 * t.powi(2);
        let belly = 1.0 - 0.05 * ((z - 0.55) / 0.4).powi(2).min(1.5);
        0.5 * self.width * ends * belly
    }

    /// Places of the body's cross-sections, dense at the arches and at the ends.
    fn stations(&self) -> Vec<f64> {
        let half = 0.5 * self.length;
        let mut xs: Vec<f64> = (0..=18).map(|k| -half + self.length * k as f64 / 18.0).collect();
        for a in self.axles {
            xs.retain(|x| (x - a).abs() > ARCH + 0.03);
            xs.extend((0..=8).map(|k| a - ARCH * (PI * k as f64 / 8.0).cos()));
            xs.extend([a - ARCH - 0.004, a + ARCH + 0.004]);
        }
        xs.extend([-half + 0.02, -half + 0.06, half - 0.02, half - 0.06]);
        xs.extend(self.cabin.iter().filter(|x| x.abs() < half));
        xs.sort_by(f64::total_cmp);
        xs.dedup_by(|a, b| (*a - *b).abs() < 0.003);
        xs
    }
}

/// Rows of half a cross-section.
const ROWS: usize = 9;

/// A point of the body's cross-section: `j` runs from the middle of the floor over one side to the middle of the top.
fn section(shape: &CarShape, x: f64, j: usize) -> DVec3 {
    let (lo, hi) = (shape.bottom(x), shape.top(x));
    let hi = hi.max(lo + 0.05);
    let shoulder = hi - (0.06f64).min(0.4 * (hi - lo));
    let side = |z: f64| shape.half_width(x, z);
    let (y, z) = match j {
        0 => (0.0, lo - 0.01),
        1 => (side(lo) - 0.02, lo),
        2..=6 => {
            let z = lo + 0.012 + (shoulder - lo - 0.012) * (j - 2) as f64 / 4.0;
            (side(z), z)
        }
        7 => (side(shoulder) - 0.045, hi - 0.012),
        8 => (0.55 * side(shoulder), hi + 0.012),
        _ => (0.0, hi + 0.022),
    };
    dvec3(x, y, z)
}

/// Adds both sides of a loft along x with closed ends: `at(i, j)` gives the side of positive y from its lower to its upper middle line.
fn loft(surface: &mut Surface, stations: usize, rows: usize, at: impl Fn(usize, usize) -> DVec3, keep: impl Fn(usize, usize) -> bool) {
    let uv = |p: DVec3| (p, dvec2(p.x, -p.z));
    let mirrored = |p: DVec3| dvec3(p.x, if p.y == 0.0 { 0.0 } else { -p.y }, p.z);
    let mut quad = |c: [DVec3; 4]| {
        surface.triangle([uv(c[0]), uv(c[1]), uv(c[2])]);
        surface.triangle([uv(c[0]), uv(c[2]), uv(c[3])]);
    };
    for i in 0..stations - 1 {
        for j in (0..rows).filter(|&j| keep(i, j)) {
            let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
            quad([b, a, d, c]);
            quad([a, b, c, d].map(mirrored));
        }
    }
    for (i, is_front) in [(0, false), (stations - 1, true)] {
        for j in (0..rows).filter(|&j| keep(if is_front { i - 1 } else { i }, j)) {
            let (a, b) = (at(i, j), at(i, j + 1));
            let (c, d) = (mirrored(b), mirrored(a));
            quad(if is_front { [d, a, b, c] } else { [a, d, c, b] });
        }
    }
}

/// The body below the windows; it is closed.
fn body(surface: &mut Surface, shape: &CarShape) {
    let xs = shape.stations();
    loft(surface, xs.len(), ROWS, |i, j| section(shape, xs[i], j), |_, _| true);
}

/// Cabin cross-sections: places along x with the share of the roof's height that is reached.
fn cabin_stations(shape: &CarShape) -> Vec<(f64, f64)> {
    let [foot, head, tail, back] = shape.cabin;
    let mut out: Vec<(f64, f64)> = Vec::new();
    let ramp = |from: f64, to: f64, ts: &[f64]| ts.iter().map(move |&t| (from + (to - from) * t, t)).collect::<Vec<_>>();
    out.extend(ramp(back, tail, &[0.0, 0.08, 0.86, 1.0]));
    let middle = 0.5 * (head + tail);
    out.extend([(tail + 0.1, 1.0), (middle - 0.05, 1.0), (middle + 0.05, 1.0), (head - 0.1, 1.0)]);
    out.extend(ramp(foot, head, &[0.0, 0.08, 0.88, 1.0]).into_iter().rev());
    out
}

/// A point of the cabin: rows lead from the belt over the side window to the middle of the roof.
fn cabin_point(shape: &CarShape, (x, share): (f64, f64), j: usize) -> DVec3 {
    let base = shape.top(x).min(shape.belt) + 0.012;
    let top = base + (shape.roof - base) * share.min(1.0) * (1.0 - 0.015 * (2.0 * x / shape.length).powi(2));
    let foot = 0.5 * shape.width - 0.075;
    let head = 0.5 * shape.width - 0.25;
    let lean = |t: f64| foot + (head - foot) * t;
    let s = (top - base) / (shape.roof - base);
    let (y, z) = match j {
        0 => (0.0, base - 0.03),
        1 => (foot, base - 0.02),
        2 => (lean(0.1 * s), base + 0.1 * (top - base)),
        3 => (lean(0.86 * s), base + 0.86 * (top - base)),
        4 => (lean(s) - 0.045, top + 0.002 - 0.02 * s),
        5 => (0.5 * lean(s), top + 0.004 + 0.015 * s),
        _ => (0.0, top + 0.005 + 0.02 * s),
    };
    dvec3(x, y, z)
}

/// Whether a face of the cabin is glass: station and row.
fn is_glazed(stations: usize, i: usize, j: usize, is_van: bool) -> bool {
    let windshield = i == stations - 3 && j >= 4;
    let rear = i == 1 && j >= 4 && !is_van;
    let side = j == 2 && (i == 6 || i == 7 || (!is_van && (i == 4 || i == stations - 3)));
    windshield || rear || side
}

/// A wheel with its outer face toward −y, its center on the origin.
fn wheel(car: &mut Assembly, m: &Materials, self_from_wheel: DAffine3) {
    let tire =
        [[0.0, -0.1], [0.2, -0.1], [0.285, -0.095], [WHEEL, -0.05], [WHEEL, 0.05], [0.285, 0.095], [0.225, 0.1], [0.21, 0.07], [0.0, 0.07]];
    let up = DAffine3::from_rotation_x(PI / 2.0);
    let mut s = Surface::default();
    s.lathe(DVec3::ZERO, &tire.map(DVec2::from), 20);
    car.piece("tires", m.rubber).add(&s, self_from_wheel * up);
    let mut rim = Surface::default();
    let dish = [[0.0, 0.02], [0.212, 0.02], [0.212, 0.085], [0.195, 0.092], [0.185, 0.075], [0.0, 0.072]];
    rim.lathe(DVec3::ZERO, &dish.map(DVec2::from), 14);
    rim.lathe(DVec3::ZERO, &[[0.0, 0.06], [0.055, 0.06], [0.05, 0.1], [0.0, 0.104]].map(DVec2::from), 8);
    for k in 0..5 {
        let mut spoke = Surface::default();
        spoke.cuboid(dvec3(0.04, -0.022, 0.06), dvec3(0.19, 0.022, 0.09));
        rim.add(&spoke, DAffine3::from_rotation_z(k as f64 * PI * 0.4));
    }
    car.piece("rims", m.chrome).add(&rim, self_from_wheel * up);
}

/// Small parts: bumpers, lights, plates, mirrors, handles, seats.
fn fittings(car: &mut Assembly, m: &Materials, shape: &CarShape, paint: Finish) {
    let half = 0.5 * shape.length;
    for side in [-1.0, 1.0] {
        let span = |y0: f64, y1: f64| if side > 0.0 { (y0, y1) } else { (-y1, -y0) };
        let (a, b) = span(0.42, 0.68);
        car.piece("lights", m.lens).cuboid(dvec3(half - 0.2, a, 0.52), dvec3(half - 0.005, b, 0.63));
        car.piece("lights", m.tail_light).cuboid(dvec3(-half - 0.012, a, 0.62), dvec3(-half + 0.2, b, 0.78));
        let (a, b) = span(0.5 * shape.width - 0.1, 0.5 * shape.width + 0.1);
        let x = shape.cabin[0] - 0.32;
        car.piece("mirrors", paint).cuboid(dvec3(x - 0.06, a, shape.belt + 0.03), dvec3(x + 0.06, b, shape.belt + 0.16));
        let y = shape.half_width(0.0, 0.75);
        let (a, b) = span(y - 0.03, y + 0.018);
        car.piece("handles", m.chrome).cuboid(dvec3(-0.28, a, 0.76), dvec3(-0.1, b, 0.785));
        let (a, b) = span(y - 0.03, y + 0.012);
        car.piece("trim", m.trim).cuboid(dvec3(shape.axles[1] + ARCH + 0.08, a, 0.42), dvec3(shape.axles[0] - ARCH - 0.08, b, 0.47));
        let (a, b) = span(0.12, 0.62);
        for x in [-0.85, 0.12] {
            car.piece("seats", m.interior).cuboid(dvec3(x - 0.12, a, shape.belt - 0.1), dvec3(x + 0.02, b, shape.belt + 0.28));
        }
    }
    let trim = car.piece("trim", m.trim);
    trim.cuboid(dvec3(half - 0.14, -0.6, 0.3), dvec3(half + 0.03, 0.6, 0.43));
    trim.cuboid(dvec3(half - 0.12, -0.34, 0.53), dvec3(half + 0.004, 0.34, 0.62));
    trim.cuboid(dvec3(-half - 0.03, -0.62, 0.34), dvec3(-half + 0.1, 0.62, 0.48));
    for a in shape.axles {
        trim.cuboid(dvec3(a - 0.33, -0.5 * shape.width + 0.28, 0.22), dvec3(a + 0.33, 0.5 * shape.width - 0.28, 0.62));
    }
    let plate = car.piece("plates", m.marking);
    plate.cuboid(dvec3(half, -0.26, 0.32), dvec3(half + 0.038, 0.26, 0.42));
    plate.cuboid(dvec3(-half - 0.02, -0.26, 0.56), dvec3(-half + 0.02, 0.26, 0.66));
}

/// A car that stands on z = 0, facing +x.
pub fn car(m: &Materials, shape: &CarShape, paint: Finish) -> Assembly {
    let mut out = Assembly::default();
    body(out.piece("body", paint), shape);
    let stations = cabin_stations(shape);
    let is_van = shape.roof > 1.7;
    let at = |i: usize, j: usize| cabin_point(shape, stations[i], j);
    loft(out.piece("cabin", paint), stations.len(), 6, at, |i, j| !is_glazed(stations.len(), i, j, is_van));
    loft(out.piece("glass", m.glass), stations.len(), 6, at, |i, j| is_glazed(stations.len(), i, j, is_van));
    for x in shape.axles {
        for (side, turn) in [(-1.0, 0.0), (1.0, PI)] {
            let at = dvec3(x, side * (0.5 * shape.width - 0.17), WHEEL);
            wheel(&mut out, m, DAffine3::from_translation(at) * DAffine3::from_rotation_z(turn));
        }
    }
    fittings(&mut out, m, shape, paint);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bodies_are_closed_and_enclose_a_plausible_volume() {
        for shape in [HATCHBACK, SEDAN, VAN] {
            let mut s = Surface::default();
            body(&mut s, &shape);
            assert!(s.is_closed(), "{shape:?}");
            let volume = s.mesh(1.0).volume();
            let block = shape.length * shape.width * (shape.belt - CLEARANCE);
            assert!(volume > 0.6 * block && volume < block, "{volume} of {block}");

            let stations = cabin_stations(&shape);
            let mut cabin = Surface::default();
            loft(&mut cabin, stations.len(), 6, |i, j| cabin_point(&shape, stations[i], j), |_, _| true);
            assert!(cabin.is_closed() && cabin.mesh(1.0).volume() > 1.0);
        }
    }
}
