//! What stands in the street: lamps, benches, bollards, a fountain.

use super::materials::Materials;
use crate::assembly::Assembly;
use diorama_geom::glam::{DVec2, DVec3, dvec2, dvec3};
use std::f64::consts::TAU;

/// A cast-iron lamp on z = 0 with a four-sided lantern.
pub fn lamp(m: &Materials) -> Assembly {
    let mut out = Assembly::default();
    let iron = out.piece("post", m.iron);
    let post = [
        [0.0, -0.1],
        [0.2, -0.1],
        [0.2, 0.12],
        [0.16, 0.16],
        [0.13, 0.5],
        [0.15, 0.54],
        [0.15, 0.6],
        [0.09, 0.68],
        [0.06, 1.1],
        [0.075, 1.13],
        [0.075, 1.18],
        [0.05, 1.22],
        [0.04, 3.1],
        [0.06, 3.145],
        [0.06, 3.18],
        [0.03, 3.24],
        [0.025, 3.42],
        [0.09, 3.46],
        [0.09, 3.49],
        [0.0, 3.49],
    ];
    iron.lathe(DVec3::ZERO, &post.map(DVec2::from), 10);
    for side in [-1.0, 1.0] {
        iron.tube(&[dvec3(0.0, 0.0, 3.0), dvec3(0.42 * side, 0.0, 3.0)], &[0.018, 0.018], 6);
        iron.ball(dvec3(0.42 * side, 0.0, 3.0), 0.035, 8);
    }
    let (low, high, z0, z1) = (0.14, 0.22, 3.5, 3.95);
    let corner = |k: usize, r: f64, z: f64| {
        let a = TAU * (k as f64 + 0.5) / 4.0;
        dvec3(a.cos() * r * 1.414, a.sin() * r * 1.414, z)
    };
    for k in 0..4 {
        let iron = out.piece("post", m.iron);
        iron.tube(&[corner(k, low, z0 - 0.02), corner(k, high, z1 + 0.02)], &[0.014, 0.014], 4);
        iron.tube(&[corner(k, high, z1), corner(k + 1, high, z1)], &[0.016, 0.016], 4);
        iron.tube(&[corner(k, low, z0), corner(k + 1, low, z0)], &[0.014, 0.014], 4);
        out.piece("glass", m.glass).polygon(&[corner(k, low, z0), corner(k + 1, low, z0), corner(k + 1, high, z1), corner(k, high, z1)]);
        let iron = out.piece("post", m.iron);
        iron.polygon(&[corner(k, 0.27, z1 + 0.01), corner(k + 1, 0.27, z1 + 0.01), dvec3(0.0, 0.0, z1 + 0.24)]);
        iron.polygon(&[corner(k + 1, 0.27, z1 + 0.01), corner(k, 0.27, z1 + 0.01), dvec3(0.0, 0.0, z1 + 0.01)]);
    }
    let bulb = [[0.0, 3.5], [0.03, 3.5], [0.03, 3.56], [0.055, 3.66], [0.045, 3.74], [0.0, 3.77]];
    out.piece("bulb", m.curtain).lathe(DVec3::ZERO, &bulb.map(DVec2::from), 10);
    out.piece("post", m.iron).ball(dvec3(0.0, 0.0, 4.22), 0.05, 8);
    out
}

/// A bench on z = 0 that faces −y.
pub fn bench(m: &Materials) -> Assembly {
    let mut out = Assembly::default();
    let wood = out.piece("seat", m.wood[3]);
    for k in 0..4 {
        let y = -0.22 + 0.12 * k as f64;
        wood.cuboid(dvec3(-0.85, y, 0.42), dvec3(0.85, y + 0.095, 0.46));
    }
    for k in 0..3 {
        let (y, z) = (0.265 + 0.03 * k as f64, 0.56 + 0.12 * k as f64);
        wood.cuboid(dvec3(-0.85, y, z), dvec3(0.85, y + 0.03, z + 0.095));
    }
    let iron = out.piece("frame", m.iron);
    for x in [-0.66, 0.66] {
        let bar = |s: &mut crate::surface::Surface, path: &[DVec3]| s.tube(path, &vec![0.022; path.len()], 8);
        bar(iron, &[dvec3(x, -0.2, -0.05), dvec3(x, -0.2, 0.4), dvec3(x, 0.25, 0.4), dvec3(x, 0.37, 0.95)]);
        bar(iron, &[dvec3(x, 0.34, -0.05), dvec3(x, 0.24, 0.4)]);
        bar(iron, &[dvec3(x, -0.2, 0.4), dvec3(x, -0.22, 0.62), dvec3(x, 0.26, 0.66)]);
    }
    out
}

/// A bollard of granite on z = 0.
pub fn bollard(m: &Materials) -> Assembly {
    let mut out = Assembly::default();
    let profile = [[0.0, -0.1], [0.17, -0.1], [0.15, 0.62], [0.18, 0.66], [0.18, 0.72], [0.14, 0.8], [0.07, 0.85], [0.0, 0.86]];
    out.piece("stone", m.stone[2]).lathe(DVec3::ZERO, &profile.map(DVec2::from), 12);
    out
}

/// A fountain on z = 0: an eight-sided basin with water, and a bowl on a column.
pub fn fountain(m: &Materials) -> Assembly {
    let mut out = Assembly::default();
    let stone = out.piece("stone", m.stone[1]);
    let basin = [
        [0.0, -0.1],
        [2.35, -0.1],
        [2.35, 0.14],
        [2.05, 0.14],
        [2.05, 0.22],
        [1.9, 0.26],
        [1.9, 0.6],
        [2.02, 0.66],
        [2.02, 0.8],
        [1.66, 0.8],
        [1.66, 0.3],
        [0.0, 0.3],
    ];
    stone.lathe(DVec3::ZERO, &basin.map(DVec2::from), 8);
    let column = [
        [0.0, 0.29],
        [0.5, 0.29],
        [0.5, 0.7],
        [0.38, 0.78],
        [0.24, 0.9],
        [0.2, 1.3],
        [0.3, 1.45],
        [0.22, 1.55],
        [0.3, 1.66],
        [0.75, 1.8],
        [0.95, 1.95],
        [1.0, 2.02],
        [0.9, 2.02],
        [0.7, 1.9],
        [0.2, 1.82],
        [0.14, 2.3],
        [0.22, 2.4],
        [0.12, 2.52],
        [0.1, 2.7],
        [0.0, 2.7],
    ];
    stone.lathe(DVec3::ZERO, &column.map(DVec2::from), 24);
    stone.ball(dvec3(0.0, 0.0, 2.84), 0.19, 16);
    let water = out.piece("water", m.water);
    let disk = |r: f64, z: f64, n: usize| -> Vec<DVec3> {
        (0..n).map(|k| dvec3(r * (TAU * k as f64 / n as f64).cos(), r * (TAU * k as f64 / n as f64).sin(), z)).collect()
    };
    water.polygon(&disk(1.68, 0.62, 8));
    water.polygon(&disk(0.87, 1.98, 24));
    for k in 0..4 {
        let a = TAU * (k as f64 + 0.5) / 4.0;
        let d = dvec2(a.cos(), a.sin());
        let at = |r: f64, z: f64| (d * r).extend(z);
        out.piece("spouts", m.zinc).tube(&[at(0.2, 1.2), at(0.42, 1.18), at(0.5, 1.1)], &[0.04, 0.032, 0.03], 8);
    }
    out
}
