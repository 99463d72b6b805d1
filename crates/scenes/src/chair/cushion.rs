//! The cushion: two bulged faces that meet in a seam with a cord, tufted by five buttons.

use super::frame::SEAT;
use crate::assembly::{Assembly, Finish};
use diorama_geom::glam::{DVec3, dvec2, dvec3};
use std::f64::consts::{PI, TAU};

/// Quads along an edge of a face.
const CELLS: usize = 48;

/// Half of the width in front and at the back, half of the depth, in meters.
const HALF: [f64; 3] = [0.235, 0.2, 0.22];

/// Buttons in the square [−1, 1]².
const BUTTONS: [[f64; 2]; 5] = [[0.0, 0.0], [-0.48, -0.45], [0.48, -0.45], [-0.48, 0.45], [0.48, 0.45]];

/// Point of the cushion's middle plane for coordinates in [−1, 1]²: its corners are round.
fn plan(s: f64, t: f64) -> (f64, f64) {
    let (x, y) = (s * (1.0 - 0.06 * t * t), t * (1.0 - 0.06 * s * s));
    let half = HALF[0] + (HALF[1] - HALF[0]) * (0.5 + 0.5 * y);
    (x * half, y * HALF[2])
}

/// Height of the upper face above the seam.
fn bulge(s: f64, t: f64) -> f64 {
    let edge = ((1.0 - s.powi(4)) * (1.0 - t.powi(4))).max(0.0).powf(0.42);
    let dent = BUTTONS.iter().map(|[x, y]| {
        let d2 = (s - x).powi(2) + (t - y).powi(2);
        0.018 * (-d2 / 0.012).exp() + 0.012 * (-d2 / 0.09).exp()
    });
    // Folds lead from the buttons to their neighbors.
    let fold = |a: f64| 0.004 * (-(a * a) / 0.003).exp();
    let folds = (fold(s - t) + fold(s + t)) * (1.0 - s * s) * (1.0 - t * t);
    edge * (0.062 - dent.sum::<f64>() - folds)
}

/// Adds the cushion on the seat.
pub fn cushion(chair: &mut Assembly, cloth: Finish, gold: Finish) {
    let seam = SEAT + 0.028;
    // Cells get smaller toward the seam, where the faces are steep.
    let spread = |k: usize| match k {
        0 => -1.0,
        CELLS => 1.0,
        _ => (0.5 * PI * (2.0 * k as f64 / CELLS as f64 - 1.0)).sin(),
    };
    let surface = chair.piece("cushion", cloth);
    let at = |i: usize, j: usize, is_top: bool| {
        let (s, t) = (spread(i), spread(j));
        let (x, y) = plan(s, t);
        let z = if i == 0 || j == 0 || i == CELLS || j == CELLS { 0.0 } else { bulge(s, t) };
        let sag = -0.35 * z.min(0.04);
        (dvec3(x, y, seam + if is_top { z } else { sag }), dvec2(x, if is_top { -y } else { y }))
    };
    surface.grid(CELLS, CELLS, |i, j| at(i, j, true));
    surface.grid(CELLS, CELLS, |i, j| at(CELLS - i, j, false));
    let buttons = chair.piece("gilding", gold);
    for [s, t] in BUTTONS {
        let (x, y) = plan(s, t);
        buttons.ball(dvec3(x, y, seam + bulge(s, t) + 0.001), 0.0085, 16);
    }
    cord(chair, gold, seam);
}

/// A twisted cord around the seam.
fn cord(chair: &mut Assembly, gold: Finish, seam: f64) {
    let (steps, sides, radius) = (280usize, 6usize, 0.0058);
    let center = |k: usize| {
        let (edge, f) = (k / (steps / 4) % 4, 2.0 * (k % (steps / 4)) as f64 / (steps / 4) as f64 - 1.0);
        let (s, t) = [(f, -1.0), (1.0, f), (-f, 1.0), (-1.0, -f)][edge];
        let (x, y) = plan(s, t);
        dvec3(x, y, seam)
    };
    let surface = chair.piece("cord", gold);
    surface.grid(sides, steps, |i, j| {
        let j = j % steps;
        let d = (center((j + 1) % steps) - center((j + steps - 1) % steps)).normalize();
        // Along the path, "around" starts at the horizontal normal and goes over the upper side.
        let (x, y) = (d.cross(DVec3::Z), DVec3::Z);
        let angle = (i % sides) as f64 / sides as f64 * TAU;
        let twist = radius * (1.0 + 0.16 * (2.0 * angle + j as f64 * 0.9).sin());
        let frame = x.cross(y).dot(d).signum();
        let p = center(j) + x * (twist * angle.cos()) * frame + y * (twist * angle.sin());
        (p, dvec2(i as f64 / sides as f64 * TAU * radius, -(j as f64) * 0.0055))
    });
}
