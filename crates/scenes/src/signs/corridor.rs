//! A passage of 2.8 × 14 m along +y with doors, notices on both walls and signs across it, lit through three roof lights.

use super::views::CameraPath;
use super::{Board, Draw, Finishes, slab};
use crate::assembly::{Assembly, ModelBuilder};
use diorama_geom::glam::{DAffine3, DVec2, DVec3, dvec3};
use std::f64::consts::FRAC_PI_2;

/// Half the width, where it begins and ends, and the height in meters.
const HALF: f64 = 1.4;
const ENDS: [f64; 2] = [-3.0, 11.0];
const HEIGHT: f64 = 2.8;

pub const PATH: CameraPath = CameraPath {
    from: [-0.5, -1.6, 1.5],
    to: [0.5, 3.6, 1.65],
    bulge: [0.3, 0.0, 0.05],
    looks_from: [0.25, 5.0, 1.75],
    looks_to: [-0.2, 9.0, 1.7],
    sway: 0.09,
    glance: 0.25,
};

/// Signs that hang across, notices on the walls, and one at the end.
pub fn boards(draw: &Draw) -> Vec<Board> {
    let shift = |what| draw.between(what, -0.2, 0.2);
    let x = HALF - 0.012;
    let hanging = |y: f64, side: f64, what: u64| Board::flat([side, y + shift(what), 2.3], draw.between(what + 1, -0.12, 0.12), [1.1, 0.3]);
    vec![
        Board::flat([shift(0), ENDS[1] - 0.012, 1.6], 0.0, [1.7, 0.8]).thick(0.01),
        hanging(4.2, 0.45, 2),
        hanging(6.6, -0.4, 4),
        Board::flat([-x, 3.0 + shift(6), 1.6 + 0.5 * shift(7)], FRAC_PI_2, [1.1, 0.55]).thick(0.01),
        Board::flat([x, 4.4 + shift(8), 1.65 + 0.5 * shift(9)], -FRAC_PI_2, [1.2, 0.55]).thick(0.01),
        Board::flat([-x, 6.4 + shift(10), 1.6 + 0.5 * shift(11)], FRAC_PI_2, [1.3, 0.6]).thick(0.01),
        Board::flat([x, 7.6 + shift(12), 1.6 + 0.5 * shift(13)], -FRAC_PI_2, [1.2, 0.5]).thick(0.01),
        Board::flat([0.95, 5.6 + shift(14), 0.52], draw.between(15, -0.3, 0.1), [0.6, 0.5]).leaning(0.3).thick(0.02),
    ]
}

/// Walls with doors and pilasters, a bench, an extinguisher and a bin, which hide parts of notices.
pub fn stand(b: &mut ModelBuilder, m: &Finishes, draw: &Draw) {
    let ([from, to], x) = (ENDS, HALF);
    let wall = m.plaster[draw.below(20, 4)];
    slab(b, "corridor.floor", m.slabs, [-x, from, -0.1], [x, to, 0.0]);
    slab(b, "corridor.left", wall, [-x - 0.2, from, -0.1], [-x, to, HEIGHT]);
    slab(b, "corridor.right", wall, [x, from, -0.1], [x + 0.2, to, HEIGHT]);
    slab(b, "corridor.end", m.plaster[0], [-x - 0.2, to, -0.1], [x + 0.2, to + 0.2, HEIGHT]);
    slab(b, "corridor.begin", m.plaster[0], [-x - 0.2, from - 0.2, -0.1], [x + 0.2, from, HEIGHT]);
    // Between roof lights of 1.8 × 2.4 m.
    let mut ceiling = Assembly::default();
    let plaster = ceiling.piece("plaster", m.plaster[0]);
    let mut piece = |x0: f64, x1: f64, y0: f64, y1: f64| plaster.cuboid(dvec3(x0, y0, HEIGHT), dvec3(x1, y1, HEIGHT + 0.2));
    piece(-x - 0.2, -0.9, from - 0.2, to + 0.2);
    piece(0.9, x + 0.2, from - 0.2, to + 0.2);
    let lights = [-1.4, 3.0, 7.6];
    let mut begin = from - 0.2;
    for y in lights {
        piece(-0.9, 0.9, begin, y);
        begin = y + 2.4;
    }
    piece(-0.9, 0.9, begin, to + 0.2);
    b.stand("corridor.ceiling", &ceiling, &[DAffine3::IDENTITY]);
    let mut fittings = Assembly::default();
    for side in [-1.0, 1.0] {
        let at = |depth: f64| side * (x - depth);
        let mut flat = |piece: &str, finish, depth: f64, y: [f64; 2], z: [f64; 2]| {
            let (a, b) = (at(0.0).min(at(depth)), at(0.0).max(at(depth)));
            fittings.piece(piece, finish).cuboid(dvec3(a, y[0], z[0]), dvec3(b, y[1], z[1]));
        };
        flat("rail", m.wood[1], 0.03, [from, to], [0.85, 0.97]);
        for k in 0..3 {
            let y = 0.6 + 4.4 * k as f64 + if side > 0.0 { 1.3 } else { 0.0 };
            flat("door", m.lacquer[draw.below(30 + k, 5)], 0.04, [y, y + 0.95], [0.0, 2.1]);
            flat("frame", m.wood[1], 0.06, [y - 0.08, y], [0.0, 2.18]);
            flat("frame", m.wood[1], 0.06, [y + 0.95, y + 1.03], [0.0, 2.18]);
            flat("pilaster", m.stone, 0.12, [y - 0.75, y - 0.5], [0.0, HEIGHT]);
        }
    }
    b.stand("corridor.fittings", &fittings, &[DAffine3::IDENTITY]);
    let mut bench = Assembly::default();
    let wood = bench.piece("wood", m.wood[0]);
    wood.cuboid(dvec3(-0.2, -0.75, 0.42), dvec3(0.2, 0.75, 0.46));
    for y in [-0.6, 0.56] {
        wood.cuboid(dvec3(-0.17, y, 0.0), dvec3(0.17, y + 0.04, 0.42));
    }
    b.stand("bench", &bench, &[DAffine3::from_translation(dvec3(-x + 0.25, 4.9 + draw.between(40, -0.3, 0.3), 0.0))]);
    let extinguisher = [[0.0, 0.0], [0.075, 0.0], [0.08, 0.4], [0.03, 0.47], [0.03, 0.53], [0.0, 0.53]];
    let mut red = Assembly::default();
    red.piece("body", m.lacquer[0]).lathe(DVec3::ZERO, &extinguisher.map(DVec2::from), 20);
    b.stand("extinguisher", &red, &[DAffine3::from_translation(dvec3(x - 0.13, 3.75 + draw.between(41, -0.2, 0.2), 1.1))]);
    let bin = [[0.0, 0.0], [0.16, 0.0], [0.2, 0.6], [0.18, 0.6], [0.16, 0.55], [0.0, 0.55]];
    let mut gray = Assembly::default();
    gray.piece("body", m.steel).lathe(DVec3::ZERO, &bin.map(DVec2::from), 20);
    b.stand("bin", &gray, &[DAffine3::from_translation(dvec3(-x + 0.3, 7.4, 0.0))]);
    let mut rods = Assembly::default();
    for (at, y) in [(0.45, 4.2), (-0.4, 6.6)] {
        rods.piece("rod", m.iron).tube(&[dvec3(at, y, 2.45), dvec3(at, y, HEIGHT + 0.1)], &[0.008; 2], 6);
    }
    b.stand("rods", &rods, &[DAffine3::IDENTITY]);
}
