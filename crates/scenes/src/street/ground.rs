//! Road, gutters, curbs, pavement, the square's cobbles, tree pits and markings.

use super::arcade::WALK;
use super::layout::{END, FACADE, Layout, PAVEMENT};
use super::materials::Materials;
use super::wall::{Opening, frame};
use crate::assembly::Assembly;
use crate::surface::Surface;
use crate::textures::Noise;
use diorama_geom::glam::{DAffine3, dvec2, dvec3};
use std::f64::consts::{PI, TAU};

/// Half of the width of the asphalt, and the outer edge of the gutter.
const ROAD: [f64; 2] = [3.15, 3.5];

/// Ends of the road beyond both ends of the street.
const BEYOND: [f64; 2] = [-52.0, 58.0];

/// A level rectangle that faces up.
fn level(surface: &mut Surface, x: [f64; 2], y: [f64; 2], z: f64) {
    surface.polygon(&[dvec3(x[0], y[0], z), dvec3(x[1], y[0], z), dvec3(x[1], y[1], z), dvec3(x[0], y[1], z)]);
}

/// The pieces of the ground, in world coordinates.
pub fn ground(m: &Materials, layout: &Layout, seed: u64) -> Assembly {
    let mut out = Assembly::default();
    level(out.piece("earth", m.soil), [-90.0, 90.0], [-70.0, 70.0], -0.08);
    level(out.piece("road", m.asphalt), BEYOND, [-ROAD[0], ROAD[0]], 0.0);
    let gutter = out.piece("gutter", m.cobbles);
    level(gutter, BEYOND, [ROAD[0], ROAD[1]], 0.0);
    level(gutter, BEYOND, [-ROAD[1], -ROAD[0]], 0.0);
    let inner = ROAD[1] + 0.16;
    level(out.piece("pavement", m.slabs), BEYOND, [inner, FACADE + 0.4], PAVEMENT);
    level(out.piece("square", m.cobbles), [BEYOND[0], BEYOND[1]], [-FACADE - WALK - 0.5, -inner], PAVEMENT);
    curbs(&mut out, m, seed);
    let marking = out.piece("markings", m.marking);
    for k in 0..5 {
        let x = -21.0 + 11.0 * k as f64;
        level(marking, [x, x + 0.1], [1.25, ROAD[0]], 0.004);
    }
    for k in 0..9 {
        let x = -END + 3.0 + 6.6 * k as f64;
        level(marking, [x, x + 2.6], [-0.06, 0.06], 0.004);
    }
    for (x, y) in [(-12.0, 0.7), (7.0, -0.6), (20.0, 0.5)] {
        let at = |r: f64, k: usize| dvec3(x + r * (TAU * k as f64 / 24.0).cos(), y + r * (TAU * k as f64 / 24.0).sin(), 0.005);
        let disk: Vec<_> = (0..24).map(|k| at(0.34, k)).collect();
        out.piece("manholes", m.iron).polygon(&disk);
    }
    for tree in &layout.trees {
        // A frame stands upright by construction; turned about x it lies on the pavement.
        let lie = DAffine3::from_translation(tree.at) * DAffine3::from_rotation_x(-0.5 * PI);
        let pit = Opening::rectangle(0.0, 1.7, -0.85, 0.85);
        let mut s = Surface::default();
        frame(&mut s, &pit.outline(0.0), &pit.outline(0.14), [-0.09, 0.05]);
        out.piece("pits", m.stone[2]).add(&s, lie);
        let (x, y) = (tree.at.x, tree.at.y);
        level(out.piece("pits", m.soil), [x - 0.72, x + 0.72], [y - 0.72, y + 0.72], PAVEMENT + 0.03);
    }
    out
}

/// Curb stones along both sides, each a little different in height.
fn curbs(out: &mut Assembly, m: &Materials, seed: u64) {
    let noise = Noise::new(seed, 82);
    let stone = out.piece("curb", m.stone[2]);
    let (length, gap) = (2.0, 0.008);
    let n = ((BEYOND[1] - BEYOND[0]) / length) as i64;
    for k in 0..n {
        let x = BEYOND[0] + length * k as f64;
        for (row, side) in [-1.0, 1.0].into_iter().enumerate() {
            let top = PAVEMENT + 0.012 + 0.008 * noise.value(k, row as i64, 0) as f64;
            let (near, far) = (ROAD[1] - 0.004, ROAD[1] + 0.168);
            // The edge toward the road is chamfered.
            let profile = [dvec2(near, -0.3), dvec2(far, -0.3), dvec2(far, top), dvec2(near + 0.04, top), dvec2(near, top - 0.03)];
            let (a, b) = (x + 0.5 * gap, x + length - 0.5 * gap);
            stone.prism(&profile, |p, end| dvec3(if (side > 0.0) == end { a } else { b }, side * p.x, p.y));
        }
    }
}
