//! Legs, seat, back and arms of the chair.

use crate::assembly::{Assembly, Finish};
use crate::surface::{Surface, arc};
use diorama_geom::glam::{DAffine3, DQuat, DVec2, DVec3, dvec2, dvec3};
use std::f64::consts::PI;

/// Half of the distance between the front legs, between the rear legs, and half of the seat's depth, in meters.
const FRONT: f64 = 0.26;
const REAR: f64 = 0.215;
const DEEP: f64 = 0.235;

/// Height of the upper edge of the seat rails.
pub const SEAT: f64 = 0.43;

/// A point of a turned profile: radius and place along the axis as a share of its length.
type Turned = [f64; 2];

/// Rounds a turned profile: every step between two points becomes a smooth curve.
fn rounded(points: &[Turned]) -> Vec<DVec2> {
    let mut out = Vec::new();
    for pair in points.windows(2) {
        let (a, b) = (DVec2::from(pair[0]), DVec2::from(pair[1]));
        let steps = if a.x * b.x == 0.0 || (a.y - b.y).abs() < 1e-6 { 1 } else { 3 };
        for k in 0..steps {
            let t = k as f64 / steps as f64;
            let s = t * t * (3.0 - 2.0 * t);
            out.push(dvec2(a.x + (b.x - a.x) * s, a.y + (b.y - a.y) * t));
        }
    }
    out.push(DVec2::from(points[points.len() - 1]));
    out
}

/// A turned piece between two points; radii are in meters.
fn turned(surface: &mut Surface, from: DVec3, to: DVec3, profile: &[Turned], segments: usize) {
    let length = from.distance(to);
    let points: Vec<DVec2> = rounded(profile).iter().map(|p| dvec2(p.x, p.y * length)).collect();
    let mut own = Surface::default();
    own.lathe(DVec3::ZERO, &points, segments);
    let rotation = DQuat::from_rotation_arc(DVec3::Z, (to - from).normalize());
    surface.add(&own, DAffine3::from_rotation_translation(rotation, from));
}

/// A bar with rounded edges along a path: `size(j)` is half of its width and half of its height at point j.
fn bar(surface: &mut Surface, path: &[DVec3], size: impl Fn(usize) -> DVec2, sides: usize) {
    let power = |v: f64| v.signum() * v.abs().powf(0.3);
    surface.loft(path, sides, |j, angle| dvec2(power(angle.cos()), power(angle.sin())) * size(j));
}

/// Points along a line.
fn line(from: DVec3, to: DVec3, steps: usize) -> Vec<DVec3> {
    (0..=steps).map(|k| from.lerp(to, k as f64 / steps as f64)).collect()
}

/// A ring around an axis between two points at a share of its length.
fn band(surface: &mut Surface, from: DVec3, to: DVec3, at: f64, radius: f64, width: f64) {
    let d = (to - from).normalize();
    let middle = from.lerp(to, at);
    let profile = [[0.0, 0.0], [0.86, 0.0], [0.97, 0.15], [1.0, 0.4], [1.0, 0.6], [0.97, 0.85], [0.86, 1.0], [0.0, 1.0]];
    let mut own = Surface::default();
    own.lathe(DVec3::ZERO, &profile.map(|[r, z]| dvec2(r * radius, (z - 0.5) * width)), 24);
    let rotation = DQuat::from_rotation_arc(DVec3::Z, d);
    surface.add(&own, DAffine3::from_rotation_translation(rotation, middle));
}

/// Turned front legs, rear legs that go on as stiles, and turned stretchers.
pub fn legs(chair: &mut Assembly, wood: Finish, gold: Finish) {
    let profile: [Turned; 22] = [
        [0.0, 0.0],
        [0.016, 0.0],
        [0.019, 0.02],
        [0.014, 0.05],
        [0.014, 0.07],
        [0.024, 0.1],
        [0.024, 0.12],
        [0.017, 0.15],
        [0.02, 0.3],
        [0.026, 0.48],
        [0.03, 0.56],
        [0.026, 0.62],
        [0.017, 0.67],
        [0.017, 0.69],
        [0.03, 0.72],
        [0.03, 0.75],
        [0.02, 0.78],
        [0.024, 0.82],
        [0.034, 0.86],
        [0.034, 0.93],
        [0.03, 0.97],
        [0.0, 0.97],
    ];
    for side in [-1.0, 1.0] {
        let (foot, head) = (dvec3(side * FRONT, -DEEP, 0.035), dvec3(side * FRONT, -DEEP, SEAT - 0.015));
        turned(chair.piece("legs", wood), foot, head, &profile, 32);
        let gilded = chair.piece("gilding", gold);
        gilded.ball(dvec3(side * FRONT, -DEEP, 0.026), 0.026, 28);
        for at in [0.11, 0.735] {
            band(gilded, foot, head, at, if at < 0.5 { 0.0265 } else { 0.0325 }, 0.011);
        }
        let path = rear_path(side);
        bar(chair.piece("legs", wood), &path, |j| DVec2::splat(0.021 - 0.004 * (j as f64 / 24.0 - 0.45).abs() * 2.0), 20);
        let gilded = chair.piece("gilding", gold);
        let top = path[path.len() - 1];
        let up = (top - path[path.len() - 2]).normalize();
        let finial = [
            [0.0, 0.0],
            [0.022, 0.0],
            [0.022, 0.12],
            [0.012, 0.22],
            [0.012, 0.3],
            [0.024, 0.5],
            [0.027, 0.62],
            [0.02, 0.8],
            [0.006, 0.95],
            [0.0, 1.0],
        ];
        turned(gilded, top - up * 0.006, top + up * 0.085, &finial, 24);
        gilded.ball(path[0] + dvec3(0.0, 0.0, 0.008), 0.024, 24);
    }
    let stretcher: [Turned; 14] = [
        [0.0, 0.0],
        [0.009, 0.0],
        [0.009, 0.08],
        [0.012, 0.2],
        [0.009, 0.3],
        [0.015, 0.36],
        [0.012, 0.4],
        [0.02, 0.5],
        [0.012, 0.6],
        [0.015, 0.64],
        [0.009, 0.7],
        [0.012, 0.8],
        [0.009, 1.0],
        [0.0, 1.0],
    ];
    let rails = chair.piece("stretchers", wood);
    for side in [-1.0, 1.0] {
        turned(rails, dvec3(side * FRONT, -DEEP, 0.14), dvec3(side * (REAR + 0.003), DEEP + 0.028, 0.15), &stretcher, 20);
    }
    turned(rails, dvec3(-0.245, 0.0, 0.145), dvec3(0.245, 0.0, 0.145), &stretcher, 20);
    turned(rails, dvec3(-REAR, DEEP + 0.012, 0.24), dvec3(REAR, DEEP + 0.012, 0.24), &stretcher, 20);
    let knob = chair.piece("gilding", gold);
    band(knob, dvec3(-0.2, 0.0, 0.145), dvec3(0.2, 0.0, 0.145), 0.5, 0.0225, 0.014);
}

/// Middle line of a rear leg: it leans back below and above the seat.
fn rear_path(side: f64) -> Vec<DVec3> {
    let at = |z: f64| {
        let lean = if z < SEAT { 0.16 * (SEAT - z).powi(2) * 2.2 } else { 0.24 * (z - SEAT).powf(1.35) };
        dvec3(side * (REAR + 0.02 * ((z - SEAT).max(0.0) / 0.6)), DEEP + lean, z)
    };
    (0..=24).map(|k| at(0.016 + 0.994 * k as f64 / 24.0)).collect()
}

/// Point of the middle line of a rear leg at a height.
fn rear_at(side: f64, z: f64) -> DVec3 {
    let path = rear_path(side);
    let s = (z - 0.016) / 0.994 * 24.0;
    let j = (s as usize).min(23);
    path[j].lerp(path[j + 1], s - j as f64)
}

/// Seat rails, a carved apron in front, and the seat's board.
pub fn seat(chair: &mut Assembly, wood: Finish, dark: Finish, gold: Finish) {
    let rails = chair.piece("rails", wood);
    let half = dvec2(0.019, 0.034);
    let z = SEAT - 0.034;
    let corner = |x: f64, y: f64| dvec3(x, y, z);
    let (fl, fr) = (corner(-FRONT, -DEEP), corner(FRONT, -DEEP));
    let (rl, rr) = (corner(-REAR, DEEP), corner(REAR, DEEP));
    for (a, b) in [(fl, fr), (rl, rr), (fl, rl), (fr, rr)] {
        bar(rails, &line(a, b, 6), |_| half, 20);
    }
    for (x, y) in [(-FRONT, -DEEP), (FRONT, -DEEP)] {
        bar(rails, &line(dvec3(x, y, SEAT - 0.075), dvec3(x, y, SEAT + 0.006), 4), |_| DVec2::splat(0.034), 32);
    }
    let board = [dvec2(-FRONT + 0.014, -DEEP), dvec2(FRONT - 0.014, -DEEP), dvec2(REAR - 0.01, DEEP), dvec2(-REAR + 0.01, DEEP)];
    chair.piece("board", dark).prism(&board, |p, is_low| dvec3(p.x, p.y, SEAT + if is_low { -0.03 } else { -0.002 }));
    // The apron hangs from the front rail: scallops between two scrolls.
    let mut outline = Vec::new();
    let n = 72;
    for k in 0..=n {
        let t = k as f64 / n as f64 * 2.0 - 1.0;
        let depth = 0.028 + 0.03 * (1.0 - t.abs()).powi(2) + 0.012 * (t * PI * 5.0).cos() + 0.016 * t.powi(6);
        outline.push(dvec2(t * (FRONT - 0.03), SEAT - 0.06 - depth));
    }
    outline.extend([dvec2(FRONT - 0.03, SEAT - 0.05), dvec2(-FRONT + 0.03, SEAT - 0.05)]);
    chair.piece("apron", wood).plate(&outline, -DEEP - 0.009, -DEEP + 0.009);
    let gilded = chair.piece("gilding", gold);
    let along = |k: usize| dvec3((k as f64 / 20.0 - 1.0) * (FRONT - 0.045), -DEEP - 0.024, SEAT - 0.034);
    for k in 0..=40 {
        gilded.ball(along(k), 0.0062, 8);
    }
    rosette(gilded, dvec3(0.0, -DEEP - 0.008, SEAT - 0.093), 0.026, DVec3::NEG_Y);
    for side in [-1.0, 1.0] {
        rosette(gilded, dvec3(side * FRONT, -DEEP - 0.03, SEAT - 0.034), 0.022, DVec3::NEG_Y);
    }
}

/// A flower of eight petals around a knob on a face with the given normal.
fn rosette(surface: &mut Surface, at: DVec3, radius: f64, normal: DVec3) {
    let mut own = Surface::default();
    let plate = [[0.0, -0.01], [0.62 * radius, -0.01], [0.62 * radius, 0.1 * radius], [0.0, 0.16 * radius]];
    own.lathe(DVec3::ZERO, &plate.map(DVec2::from), 24);
    own.ball(dvec3(0.0, 0.0, 0.12 * radius), 0.26 * radius, 12);
    for k in 0..8 {
        let angle = k as f64 * PI / 4.0;
        let mut petal = Surface::default();
        petal.ball(DVec3::ZERO, 1.0, 8);
        let place = DAffine3::from_rotation_z(angle)
            * DAffine3::from_translation(dvec3(0.62 * radius, 0.0, 0.03 * radius))
            * DAffine3::from_scale(dvec3(0.36, 0.2, 0.17) * radius);
        own.add(&petal, place);
    }
    let turn = DQuat::from_rotation_arc(DVec3::Z, normal);
    surface.add(&own, DAffine3::from_rotation_translation(turn, at));
}

/// A frame that turns a plate, which faces −y, into the plane of the leaning back at height `z`.
fn lean(z: f64) -> DAffine3 {
    let (low, high) = (rear_at(1.0, z - 0.02), rear_at(1.0, z + 0.02));
    let angle = (high.y - low.y).atan2(high.z - low.z);
    DAffine3::from_translation(dvec3(0.0, rear_at(1.0, z).y, z)) * DAffine3::from_rotation_x(-angle)
}

/// Crest rail, lower rail, spindles and a pierced splat with a gilded disk.
pub fn back(chair: &mut Assembly, wood: Finish, dark: Finish, gold: Finish) {
    let (low, high) = (0.54, 0.93);
    let mut crest: Vec<DVec2> = Vec::new();
    let half = 0.232;
    crest.extend([dvec2(-half, -0.035), dvec2(half, -0.035)]);
    for k in 0..=64 {
        let t = 1.0 - k as f64 / 32.0;
        let wave = 0.045 + 0.05 * (0.5 + 0.5 * (t * PI).cos()).powi(2) + 0.01 * (t * 3.0 * PI).cos() - 0.012 * t.abs().powi(8);
        crest.push(dvec2(t * half, wave));
    }
    let mut own = Surface::default();
    own.plate(&crest, -0.013, 0.013);
    chair.piece("crest", wood).add(&own, lean(high));
    let mut shell = Surface::default();
    rosette(&mut shell, dvec3(0.0, -0.012, 0.035), 0.042, DVec3::NEG_Y);
    for side in [-1.0, 1.0] {
        rosette(&mut shell, dvec3(side * 0.15, -0.012, 0.002), 0.02, DVec3::NEG_Y);
    }
    chair.piece("gilding", gold).add(&shell, lean(high));

    let (a, b) = (rear_at(-1.0, low), rear_at(1.0, low));
    bar(chair.piece("rails", wood), &line(a, b, 6), |_| dvec2(0.013, 0.021), 28);
    let spindle: [Turned; 13] = [
        [0.0, 0.0],
        [0.007, 0.0],
        [0.007, 0.05],
        [0.011, 0.09],
        [0.006, 0.13],
        [0.009, 0.3],
        [0.012, 0.45],
        [0.009, 0.6],
        [0.006, 0.85],
        [0.011, 0.9],
        [0.007, 0.94],
        [0.007, 1.0],
        [0.0, 1.0],
    ];
    for x in [-0.17, -0.125, 0.125, 0.17] {
        let (y0, y1) = (rear_at(1.0, low).y, rear_at(1.0, high).y);
        turned(chair.piece("spindles", wood), dvec3(x, y0, low), dvec3(x, y1, high - 0.02), &spindle, 16);
        band(chair.piece("gilding", gold), dvec3(x, y0, low), dvec3(x, y1, high - 0.02), 0.45, 0.0135, 0.007);
    }
    let middle = 0.5 * (low + high);
    let mut board = Surface::default();
    board.plate(&splat(0.5 * (high - low) - 0.015), -0.009, 0.009);
    chair.piece("splat", dark).add(&board, lean(middle));
    let mut sun = Surface::default();
    rosette(&mut sun, dvec3(0.0, -0.008, 0.055), 0.05, DVec3::NEG_Y);
    rosette(&mut sun, dvec3(0.0, -0.008, -0.115), 0.026, DVec3::NEG_Y);
    for k in 0..24 {
        let angle = k as f64 * PI / 12.0;
        sun.ball(dvec3(0.064 * angle.cos(), -0.01, 0.055 + 0.064 * angle.sin()), 0.0042, 8);
    }
    chair.piece("gilding", gold).add(&sun, lean(middle));
}

/// Outline of a vase, `2 · half` high.
fn splat(half: f64) -> Vec<DVec2> {
    let width = |t: f64| 0.045 + 0.036 * (0.5 + 0.5 * (2.0 * PI * (t - 0.63)).cos()).powf(1.5) + 0.012 * (6.0 * PI * t).cos().max(0.0);
    let side = |k: usize| dvec2(width(k as f64 / 48.0), -half + 2.0 * half * k as f64 / 48.0);
    let right = (0..=48).map(side);
    let left = (0..=48).rev().map(side).map(|p| dvec2(-p.x, p.y));
    right.chain(left).collect()
}

/// Curved arms on turned posts, with gilded scrolls.
pub fn arms(chair: &mut Assembly, wood: Finish, gold: Finish) {
    for side in [-1.0, 1.0] {
        let rear = rear_at(side, 0.69);
        let at = |t: f64| {
            let y = rear.y - 0.02 + (-DEEP + 0.02 - rear.y) * t;
            let x = rear.x + side * (0.03 + 0.045 * (t * PI * 0.6).sin()) * t.min(0.25) * 4.0;
            dvec3(x, y, 0.69 - 0.035 * (PI * t).sin() + 0.012 * t)
        };
        let path: Vec<DVec3> = (0..=28).map(|k| at(k as f64 / 28.0)).collect();
        bar(chair.piece("arms", wood), &path, |j| dvec2(0.021 + 0.006 * (j as f64 / 28.0 * PI).sin(), 0.014), 20);
        let end = path[28];
        let scroll: Vec<DVec2> = arc(DVec2::ZERO, 0.028, 0.0, 2.0 * PI, 36)[..36].to_vec();
        let mut disk = Surface::default();
        disk.prism(&scroll, |p, is_far| dvec3(if is_far { 0.027 } else { -0.027 }, -p.x, p.y));
        let place = DAffine3::from_translation(end + dvec3(0.0, -0.004, -0.012));
        chair.piece("arms", wood).add(&disk, place);
        let gilded = chair.piece("gilding", gold);
        for x in [-1.0, 1.0] {
            rosette(gilded, end + dvec3(x * 0.0265, -0.004, -0.012), 0.021, DVec3::X * x);
        }
        let post: [Turned; 14] = [
            [0.0, 0.0],
            [0.02, 0.0],
            [0.02, 0.06],
            [0.013, 0.12],
            [0.02, 0.2],
            [0.024, 0.32],
            [0.018, 0.5],
            [0.012, 0.66],
            [0.012, 0.72],
            [0.02, 0.76],
            [0.02, 0.8],
            [0.013, 0.84],
            [0.016, 1.0],
            [0.0, 1.0],
        ];
        let (foot, head) = (dvec3(side * FRONT, -DEEP + 0.01, SEAT), path[26] - DVec3::Z * 0.004);
        turned(chair.piece("arms", wood), foot, head, &post, 24);
        band(chair.piece("gilding", gold), foot, head, 0.78, 0.0225, 0.009);
    }
}
