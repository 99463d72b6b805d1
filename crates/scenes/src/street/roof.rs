//! Roofs of houses, with gutters, chimneys and dormers.

use super::joinery::{WindowStyle, window};
use super::layout::DEPTH;
use super::materials::Materials;
use super::wall::{Opening, wall};
use crate::assembly::{Assembly, Finish};
use crate::surface::Surface;
use diorama_geom::glam::{DAffine3, DVec3, dvec2, dvec3};

/// Form of a roof.
#[derive(Clone)]
pub enum Roof {
    /// The ridge runs along the street; dormers stand at these places along it.
    Saddle { tiles: Finish, rise: f64, dormers: Vec<f64>, dormer_style: WindowStyle, chimneys: Vec<f64> },
    /// The ridge leads away from the street behind a gable; a stepped gable hides the roof's edge.
    Gable { tiles: Finish, rise: f64, is_stepped: bool, style: WindowStyle },
}

/// Adds a roof over walls that end at `z`.
pub fn roof(out: &mut Assembly, m: &Materials, roof: &Roof, width: f64, z: f64, walls: Finish) {
    match roof {
        Roof::Saddle { tiles, rise, dormers, dormer_style, chimneys } => {
            saddle(out, m, *tiles, width, z, *rise, walls);
            for &x in dormers {
                dormer(out, m, x, z, *rise, *tiles, dormer_style);
            }
            for &x in chimneys {
                chimney(out, m, x, 0.62 * DEPTH, z + 0.6 * rise, z + rise + 1.0);
            }
        }
        Roof::Gable { tiles, rise, is_stepped, style } => {
            gable(out, *tiles, width, z, *rise, *is_stepped);
            let wall = out.piece("wall", walls);
            wall.polygon(&[dvec3(width, DEPTH, z), dvec3(0.0, DEPTH, z), dvec3(0.5 * width, DEPTH, z + rise)]);
            if *is_stepped {
                stepped_gable(out, m, [width, z, *rise], walls, style);
            } else {
                wall.polygon(&[dvec3(0.0, 0.0, z), dvec3(width, 0.0, z), dvec3(0.5 * width, 0.0, z + rise)]);
            }
        }
    }
}

/// A slab over a slope: `corners` are the upper face, counterclockwise, with the eaves first.
pub fn slab(out: &mut Surface, corners: [DVec3; 4], thickness: f64) {
    let down = DVec3::NEG_Z * thickness;
    out.slope(&corners);
    let [a, b, c, d] = corners;
    out.polygon(&[d + down, c + down, b + down, a + down]);
    for (p, q) in [(a, b), (b, c), (c, d), (d, a)] {
        out.polygon(&[p + down, q + down, q, p]);
    }
}

/// Both slopes of a ridge along x, gutter, ridge tiles and the walls of the gables.
fn saddle(out: &mut Assembly, m: &Materials, tiles: Finish, width: f64, z: f64, rise: f64, walls: Finish) {
    let (eaves, half) = (0.5, 0.5 * DEPTH);
    let slope = rise / half;
    let (low, ridge) = (z + 0.1 - eaves * slope, z + 0.1 + rise);
    let (x0, x1) = (0.004, width - 0.004);
    let s = out.piece("roof", tiles);
    slab(s, [dvec3(x0, -eaves, low), dvec3(x1, -eaves, low), dvec3(x1, half, ridge), dvec3(x0, half, ridge)], 0.1);
    slab(s, [dvec3(x1, DEPTH + eaves, low), dvec3(x0, DEPTH + eaves, low), dvec3(x0, half, ridge), dvec3(x1, half, ridge)], 0.1);
    let n = (width / 0.8) as usize;
    for k in 0..n {
        let at = |t: f64| dvec3(x0 + (x1 - x0) * t / n as f64, half, ridge - 0.01);
        s.tube(&[at(k as f64), at(k as f64 + 0.98)], &[0.13, 0.105], 6);
    }
    let gap = 0.012;
    let side = out.piece("wall", walls);
    side.polygon(&[dvec3(gap, DEPTH, z), dvec3(gap, 0.0, z), dvec3(gap, half, z + rise)]);
    side.polygon(&[dvec3(width - gap, 0.0, z), dvec3(width - gap, DEPTH, z), dvec3(width - gap, half, z + rise)]);
    let zinc = out.piece("gutter", m.zinc);
    let y = -eaves - 0.07;
    zinc.tube(&[dvec3(x0 + 0.02, y, low - 0.06), dvec3(x1 - 0.02, y, low - 0.06)], &[0.075, 0.075], 8);
    let x = width - 0.2;
    let pipe = [dvec3(x, y, low - 0.1), dvec3(x, y, low - 0.25), dvec3(x, -0.11, low - 0.75), dvec3(x, -0.11, 0.0)];
    zinc.tube(&pipe, &[0.045; 4], 8);
}

/// A dormer with a window and a small saddle roof.
fn dormer(out: &mut Assembly, m: &Materials, x: f64, z: f64, rise: f64, tiles: Finish, style: &WindowStyle) {
    let slope = rise / (0.5 * DEPTH);
    let front = 0.55;
    let base = z + 0.1 + front * slope - 0.15;
    let (w, h) = (1.3, 1.55);
    let mut own = Assembly::default();
    let o = Opening::rectangle(0.0, 0.85, 0.32, 1.4);
    wall(own.piece("dormers", style.wood), [-0.5 * w, 0.5 * w], [-0.3, h], 0.12, &[o]);
    window(&mut own, m, &o, 0.1, &WindowStyle { surround: 0.0, shutters: None, ..*style }, 0.25);
    let depth = (h + 0.65) / slope + 0.4;
    let cheeks = own.piece("dormers", style.wood);
    let a = 0.5 * w;
    cheeks.polygon(&[dvec3(-a, depth, -0.3), dvec3(-a, 0.0, -0.3), dvec3(-a, 0.0, h), dvec3(-a, depth, h)]);
    cheeks.polygon(&[dvec3(a, 0.0, -0.3), dvec3(a, depth, -0.3), dvec3(a, depth, h), dvec3(a, 0.0, h)]);
    let peak = 0.6;
    cheeks.polygon(&[dvec3(-a, 0.0, h), dvec3(a, 0.0, h), dvec3(0.0, 0.0, h + peak)]);
    let roof = own.piece("roof", tiles);
    let b = a + 0.14;
    let low = h + 0.06 - 0.14 * peak / a;
    let top = h + 0.06 + peak;
    slab(roof, [dvec3(-b, depth, low), dvec3(-b, -0.18, low), dvec3(0.0, -0.18, top), dvec3(0.0, depth, top)], 0.06);
    slab(roof, [dvec3(b, -0.18, low), dvec3(b, depth, low), dvec3(0.0, depth, top), dvec3(0.0, -0.18, top)], 0.06);
    own.piece("interior", m.interior).cuboid(dvec3(-a + 0.02, 0.5, -0.25), dvec3(a - 0.02, 0.9, h - 0.02));
    out.add(&own, DAffine3::from_translation(dvec3(x, front, base)));
}

/// A chimney of bricks with a cap and two pots.
fn chimney(out: &mut Assembly, m: &Materials, x: f64, y: f64, low: f64, high: f64) {
    out.piece("chimney", m.brick).cuboid(dvec3(x - 0.5, y - 0.3, low - 1.5), dvec3(x + 0.5, y + 0.3, high));
    out.piece("chimney", m.stone[1]).cuboid(dvec3(x - 0.57, y - 0.37, high - 0.02), dvec3(x + 0.57, y + 0.37, high + 0.12));
    for side in [-0.24, 0.24] {
        let pot = [[0.0, 0.0], [0.14, 0.0], [0.11, 0.4], [0.14, 0.42], [0.14, 0.47], [0.1, 0.47], [0.1, 0.3], [0.0, 0.3]];
        out.piece("chimney", m.clay).lathe(dvec3(x + side, y, high + 0.1), &pot.map(|p| p.into()), 8);
    }
}

/// Both slopes of a ridge along y; behind a stepped gable they begin further back and do not overhang.
fn gable(out: &mut Assembly, tiles: Finish, width: f64, z: f64, rise: f64, is_stepped: bool) {
    let half = 0.5 * width;
    let surface = out.piece("roof", tiles);
    let (overhang, y0) = if is_stepped { (0.0, 0.35) } else { (0.25, -0.3) };
    let slope = rise / half;
    let (low, ridge) = (z + 0.1 - overhang * slope, z + 0.1 + rise);
    let (x0, x1) = (-overhang + 0.004, width + overhang - 0.004);
    slab(surface, [dvec3(x0, DEPTH, low), dvec3(x0, y0, low), dvec3(half, y0, ridge), dvec3(half, DEPTH, ridge)], 0.1);
    slab(surface, [dvec3(x1, y0, low), dvec3(x1, DEPTH, low), dvec3(half, DEPTH, ridge), dvec3(half, y0, ridge)], 0.1);
}

/// Tiers of a wall that get narrower by steps, each with coping stones, the lower ones with windows.
fn stepped_gable(out: &mut Assembly, m: &Materials, [width, z, rise]: [f64; 3], walls: Finish, style: &WindowStyle) {
    let steps = 5;
    let height = (rise + 0.9) / steps as f64;
    let thickness = 0.36;
    for k in 0..steps {
        let inset = 0.5 * (width - 1.2) * k as f64 / (steps - 1) as f64 * 0.98;
        let (x0, x1) = (inset, width - inset);
        let (z0, z1) = (z + height * k as f64, z + height * (k + 1) as f64);
        let n = [3, 2, 1, 0, 0][k];
        let openings: Vec<Opening> =
            (0..n).map(|i| Opening::arched(0.5 * width + 1.9 * (i as f64 - 0.5 * (n as f64 - 1.0)), 0.8, z0 + 0.18, z1 - 0.12)).collect();
        wall(out.piece("wall", walls), [x0, x1], [z0, z1], 0.18, &openings);
        for o in &openings {
            window(out, m, o, 0.16, &WindowStyle { surround: 0.0, shutters: None, bars: 1, ..*style }, 0.2);
        }
        let side = out.piece("wall", walls);
        let y = thickness;
        side.polygon(&[dvec3(x0, y, z0), dvec3(x0, 0.0, z0), dvec3(x0, 0.0, z1), dvec3(x0, y, z1)]);
        side.polygon(&[dvec3(x1, 0.0, z0), dvec3(x1, y, z0), dvec3(x1, y, z1), dvec3(x1, 0.0, z1)]);
        side.polygon(&[dvec3(x1, y, z0), dvec3(x0, y, z0), dvec3(x0, y, z1), dvec3(x1, y, z1)]);
        let next = 0.5 * (width - 1.2) * (k + 1) as f64 / (steps - 1) as f64 * 0.98;
        let coping = out.piece("trim", style.trim);
        if k + 1 < steps {
            for (a, b) in [(x0 - 0.06, next - 0.003), (width - next + 0.003, x1 + 0.06)] {
                coping.cuboid(dvec3(a, -0.08, z1 - 0.004), dvec3(b, thickness + 0.06, z1 + 0.11));
            }
        } else {
            coping.cuboid(dvec3(x0 - 0.06, -0.08, z1 - 0.004), dvec3(x1 + 0.06, thickness + 0.06, z1 + 0.13));
            let finial = [[0.0, 0.0], [0.16, 0.0], [0.1, 0.14], [0.07, 0.2], [0.17, 0.36], [0.17, 0.46], [0.1, 0.6], [0.0, 0.68]];
            coping.lathe(dvec3(0.5 * width, 0.15, z1 + 0.12), &finial.map(|p| dvec2(p[0], p[1])), 14);
        }
    }
}
