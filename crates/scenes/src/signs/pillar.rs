//! A square with three advertising pillars, whose posters bend around them, before a wall.

use super::views::CameraPath;
use super::{Board, Draw, Finishes, slab};
use crate::assembly::{Assembly, ModelBuilder};
use diorama_geom::glam::{DAffine3, DVec2, DVec3, dvec2, dvec3};

/// Middles of the pillars, their radii and heights in meters.
const PILLARS: [([f64; 2], f64, f64); 3] = [([-2.1, 0.3], 0.6, 3.0), ([0.15, -0.35], 0.7, 3.2), ([2.3, 0.4], 0.55, 2.9)];
/// How far posters stand out.
const OUT: f64 = 0.012;

pub const PATH: CameraPath = CameraPath {
    from: [-3.4, -4.3, 1.55],
    to: [3.4, -4.3, 1.7],
    bulge: [0.0, -0.6, 0.0],
    looks_from: [-0.9, 0.0, 1.6],
    looks_to: [0.9, 0.0, 1.6],
    sway: 0.12,
    glance: 0.2,
};

/// Two or three posters on each pillar, one above the other and turned.
pub fn boards(draw: &Draw) -> Vec<Board> {
    let mut out = Vec::new();
    for (k, ([x, y], radius, _)) in PILLARS.iter().enumerate() {
        for row in 0..if k < 2 { 3 } else { 2 } {
            let what = 10 * k as u64 + 3 * row;
            let turn = draw.between(what, -0.45, 0.45) - 0.12 * x;
            let r = radius + OUT;
            let z = 1.0 + 0.75 * row as f64 + draw.between(what + 1, -0.06, 0.06) + if k < 2 { 0.0 } else { 0.3 };
            let at = [x + r * turn.sin(), y - r * turn.cos(), z];
            let wide = draw.between(what + 2, 1.25, 1.6) * radius;
            out.push(Board::flat(at, turn, [wide, 0.32 * wide + 0.1]).bent(r));
        }
    }
    out
}

/// Ground, wall and pillars; bollards and a tree in a tub before them.
pub fn stand(b: &mut ModelBuilder, m: &Finishes, draw: &Draw) {
    slab(b, "square.ground", m.slabs, [-9.0, -9.0, -0.2], [9.0, 3.2, 0.0]);
    slab(b, "square.wall", [m.brick, m.stone, m.plaster[2]][draw.below(40, 3)], [-9.0, 3.0, -0.2], [9.0, 3.4, 4.6]);
    for k in 0..6 {
        let x = -6.2 + 2.5 * k as f64;
        slab(b, &format!("square.niche.{k}"), m.trim, [x - 0.45, 2.96, 1.2], [x + 0.45, 3.02, 3.0]);
        slab(b, &format!("square.sill.{k}"), m.stone, [x - 0.55, 2.86, 1.08], [x + 0.55, 3.02, 1.2]);
    }
    for (k, ([x, y], radius, height)) in PILLARS.iter().enumerate() {
        let r = |by: f64| radius * by;
        let profile = [
            dvec2(0.0, 0.0),
            dvec2(r(1.15), 0.0),
            dvec2(r(1.15), 0.25),
            dvec2(r(1.0), 0.35),
            dvec2(r(1.0), *height),
            dvec2(r(1.18), height + 0.06),
            dvec2(r(1.18), height + 0.2),
            dvec2(r(0.5), height + 0.45),
            dvec2(0.0, height + 0.6),
        ];
        let mut pillar = Assembly::default();
        pillar.piece("body", m.plaster[(draw.below(41, 4) + k) % 4]).lathe(DVec3::ZERO, &profile, 64);
        b.stand(&format!("pillar.{k}"), &pillar, &[DAffine3::from_translation(dvec3(*x, *y, 0.0))]);
    }
    let bollard = [[0.0, 0.0], [0.1, 0.0], [0.09, 0.75], [0.12, 0.8], [0.08, 0.92], [0.0, 0.95]];
    let mut iron = Assembly::default();
    iron.piece("body", m.iron).lathe(DVec3::ZERO, &bollard.map(DVec2::from), 16);
    let places: Vec<DAffine3> =
        (0..5).map(|k| DAffine3::from_translation(dvec3(-3.4 + 1.7 * k as f64 + draw.between(50 + k, -0.2, 0.2), -1.9, 0.0))).collect();
    b.stand("bollard", &iron, &places);
    let mut tub = Assembly::default();
    let pot = [[0.0, 0.0], [0.24, 0.0], [0.3, 0.5], [0.26, 0.5], [0.25, 0.44], [0.0, 0.44]];
    tub.piece("pot", m.wood[0]).lathe(DVec3::ZERO, &pot.map(DVec2::from), 24);
    tub.piece("stem", m.wood[1]).tube(&[dvec3(0.0, 0.0, 0.4), dvec3(0.0, 0.0, 1.4)], &[0.025, 0.02], 8);
    for k in 0..40 {
        let random = |axis: u64| draw.between(200 + 4 * k + axis, -1.0, 1.0);
        tub.piece("leaf", m.leaf).ball(dvec3(0.26 * random(0), 0.26 * random(1), 1.6 + 0.28 * random(2)), 0.055, 8);
    }
    b.stand("tub", &tub, &[DAffine3::from_translation(dvec3(draw.between(60, -1.5, -1.0), -1.6, 0.0))]);
}
