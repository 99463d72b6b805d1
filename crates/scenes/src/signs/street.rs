//! Three shop fronts of 4.5 m along a pavement, with signs above and in their windows, across the pavement and on the ground.

use super::views::CameraPath;
use super::{Board, Draw, Finishes, slab};
use crate::assembly::{Assembly, ModelBuilder};
use diorama_geom::glam::{DAffine3, DVec2, DVec3, dvec3};
use std::f64::consts::FRAC_PI_2;

/// Width of a shop, height of the fronts, and depth of a window's reveal in meters. Fronts face −y at y = 0.
const SHOP: f64 = 4.5;
const HEIGHT: f64 = 6.4;
const REVEAL: f64 = 0.16;

pub const PATH: CameraPath = CameraPath {
    from: [-3.8, -7.0, 1.6],
    to: [3.8, -6.4, 1.7],
    bulge: [0.0, -0.8, 0.0],
    looks_from: [-1.8, 0.0, 2.2],
    looks_to: [1.8, 0.0, 2.2],
    sway: 0.15,
    glance: 0.35,
};

fn middle(shop: usize) -> f64 {
    (shop as f64 - 1.0) * SHOP
}

/// A sign above each shop, two that project, two in windows, and one that stands on the pavement.
pub fn boards(draw: &Draw) -> Vec<Board> {
    let shift = |what| draw.between(what, -0.15, 0.15);
    let above = |shop: usize, what: u64| {
        Board::flat([middle(shop) + shift(what), -0.12, 3.2], 0.0, [draw.between(what + 1, 2.6, 3.4), 0.62]).thick(0.1)
    };
    let projecting = |x: f64, what: u64| {
        Board::flat([x, -0.62, 3.9 + shift(what)], draw.between(what + 1, -0.1, 0.1) + FRAC_PI_2 * x.signum() * 0.72, [0.9, 0.5])
    };
    vec![
        above(0, 0),
        above(1, 2),
        above(2, 4),
        projecting(-2.3, 6),
        projecting(2.3, 8),
        Board::flat([middle(0) - 0.7 + shift(10), 0.1, 1.55 + shift(11)], 0.0, [1.2, 0.45])
            .thick(0.006)
            .rolled(draw.between(12, -0.05, 0.05)),
        Board::flat([middle(2) - 0.6 + shift(13), 0.1, 1.6 + shift(14)], 0.0, [1.1, 0.6]).thick(0.006),
        Board::flat([0.9 + shift(15), -1.7, 0.52], draw.between(16, -0.4, 0.4), [0.62, 0.8]).leaning(0.22).thick(0.02),
    ]
}

/// Walls with windows and doors; a lamp, trees and bollards before them.
pub fn stand(b: &mut ModelBuilder, m: &Finishes, draw: &Draw) {
    slab(b, "street.pavement", m.slabs, [-14.0, -3.2, -0.2], [14.0, 0.2, 0.0]);
    slab(b, "street.road", m.asphalt, [-14.0, -14.0, -0.32], [14.0, -3.2, -0.12]);
    let fronts = [m.brick, m.plaster[1], m.plaster[3], m.stone, m.plaster[2]];
    for shop in 0..3 {
        let front = fronts[(draw.below(20, 5) + 2 * shop) % 5];
        let paint = m.lacquer[(draw.below(21, 5) + shop) % 5];
        let at = DAffine3::from_translation(dvec3(middle(shop), 0.0, 0.0));
        b.stand(&format!("shop.{shop}"), &shop_front(m, front, paint), &[at]);
    }
    slab(b, "street.left", m.brick, [-14.0, 0.0, -0.2], [-1.5 * SHOP, 4.0, HEIGHT]);
    slab(b, "street.right", m.stone, [1.5 * SHOP, 0.0, -0.2], [14.0, 4.0, HEIGHT]);
    b.stand("lamp", &lamp(m), &[DAffine3::from_translation(dvec3(draw.between(22, -1.4, -0.6), -2.6, 0.0))]);
    for k in 0..2 {
        let x = draw.between(23 + k, 2.4, 3.6) * if k == 0 { 1.0 } else { -1.2 };
        b.stand(&format!("tree.{k}"), &tree(m, draw, k), &[DAffine3::from_translation(dvec3(x, -2.7, 0.0))]);
    }
    let bollard = [[0.0, 0.0], [0.09, 0.0], [0.08, 0.7], [0.1, 0.76], [0.06, 0.86], [0.0, 0.88]];
    let mut iron = Assembly::default();
    iron.piece("body", m.iron).lathe(DVec3::ZERO, &bollard.map(DVec2::from), 16);
    let places: Vec<DAffine3> = (0..6).map(|k| DAffine3::from_translation(dvec3(-5.6 + 2.2 * k as f64, -3.0, 0.0))).collect();
    b.stand("bollard", &iron, &places);
}

/// A front with a shop window, a door and two windows above.
fn shop_front(m: &Finishes, front: crate::assembly::Finish, paint: crate::assembly::Finish) -> Assembly {
    let mut out = Assembly::default();
    let half = 0.5 * SHOP;
    // Openings as x and z from low to high, and the wall between them.
    let openings = [[-1.75, 0.55, 0.5, 2.65], [0.85, 1.75, 0.0, 2.65], [-1.5, -0.5, 4.3, 5.8], [0.5, 1.5, 4.3, 5.8]];
    let wall = out.piece("wall", front);
    let mut part = |x0: f64, x1: f64, z0: f64, z1: f64| wall.cuboid(dvec3(x0, 0.0, z0), dvec3(x1, 0.35, z1));
    part(-half, half, 2.65, 4.3);
    part(-half, half, 5.8, HEIGHT);
    part(-half, -1.75, -0.2, 2.65);
    part(0.55, 0.85, -0.2, 2.65);
    part(1.75, half, -0.2, 2.65);
    part(-1.75, 0.55, -0.2, 0.5);
    part(-half, -1.5, 4.3, 5.8);
    part(-0.5, 0.5, 4.3, 5.8);
    part(1.5, half, 4.3, 5.8);
    for [x0, x1, z0, z1] in openings {
        let frame = out.piece("frame", paint);
        frame.cuboid(dvec3(x0, REVEAL - 0.04, z0), dvec3(x0 + 0.07, REVEAL + 0.04, z1));
        frame.cuboid(dvec3(x1 - 0.07, REVEAL - 0.04, z0), dvec3(x1, REVEAL + 0.04, z1));
        frame.cuboid(dvec3(x0, REVEAL - 0.04, z0), dvec3(x1, REVEAL + 0.04, z0 + 0.07));
        frame.cuboid(dvec3(x0, REVEAL - 0.04, z1 - 0.07), dvec3(x1, REVEAL + 0.04, z1));
        // What is behind the glass is dark and matte here: panes mirror what no field learns.
        out.piece("inside", m.trim).cuboid(dvec3(x0, REVEAL + 0.02, z0), dvec3(x1, REVEAL + 0.03, z1));
    }
    out.piece("door", paint).cuboid(dvec3(0.92, REVEAL - 0.02, 0.0), dvec3(1.68, REVEAL + 0.02, 1.1));
    let molding = [[0.0, 0.0], [0.06, 0.0], [0.12, 0.1], [0.2, 0.14], [0.2, 0.2], [0.0, 0.2]];
    out.piece("cornice", m.stone).molding(&molding.map(|[d, z]| DVec2::new(d, 3.66 + z)), -half, half);
    out.piece("cornice", m.stone).molding(&molding.map(|[d, z]| DVec2::new(1.4 * d, HEIGHT - 0.3 + z)), -half, half);
    out.piece("frame", paint).cuboid(dvec3(-half + 0.1, -0.05, 2.7), dvec3(half - 0.1, 0.0, 3.62));
    out
}

fn lamp(m: &Finishes) -> Assembly {
    let mut out = Assembly::default();
    let post = [[0.0, 0.0], [0.14, 0.0], [0.12, 0.5], [0.06, 0.6], [0.045, 3.3], [0.07, 3.34], [0.0, 3.36]];
    out.piece("post", m.iron).lathe(DVec3::ZERO, &post.map(DVec2::from), 16);
    out.piece("head", m.plaster[0]).ball(dvec3(0.0, 0.0, 3.52), 0.18, 20);
    out.piece("post", m.iron).cuboid(dvec3(-0.12, -0.12, 3.68), dvec3(0.12, 0.12, 3.72));
    out
}

/// A young tree: a stem, branches, and a crown of small balls that light passes between.
fn tree(m: &Finishes, draw: &Draw, which: u64) -> Assembly {
    let mut out = Assembly::default();
    let stem: Vec<DVec3> = (0..5).map(|k| dvec3(0.02 * k as f64, 0.0, 0.6 * k as f64)).collect();
    out.piece("stem", m.wood[1]).tube(&stem, &[0.07, 0.06, 0.055, 0.045, 0.03], 8);
    for k in 0..60 {
        let random = |axis: u64| draw.between(100 + 1000 * which + 4 * k + axis, -1.0, 1.0);
        let at = dvec3(0.65 * random(0), 0.55 * random(1), 2.75 + 0.7 * random(2));
        out.piece("leaf", m.leaf).ball(at, 0.07 + 0.03 * (1.0 + random(3)), 8);
        if k % 6 == 0 {
            out.piece("stem", m.wood[1]).tube(&[dvec3(0.05, 0.0, 1.7), at], &[0.02, 0.006], 5);
        }
    }
    out
}
