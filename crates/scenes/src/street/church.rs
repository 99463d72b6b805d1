//! A church: the gabled front of its nave with portal and rose window, and a tower with belfry, clock and spire.

use super::arcade::{archivolt, portal};
use super::house::cornice_profile;
use super::joinery::{WindowStyle, door, window};
use super::layout::DEPTH;
use super::materials::Materials;
use super::roof::slab;
use super::wall::{Opening, frame, pane, wall};
use crate::assembly::Assembly;
use diorama_geom::glam::{DAffine3, DVec2, DVec3, dvec2, dvec3};
use std::f64::consts::{PI, TAU};

/// A molding at height `z` from `x[0]` to `x[1]`.
fn cornice(out: &mut Assembly, style: &WindowStyle, x: [f64; 2], z: f64, size: [f64; 2]) {
    let profile: Vec<DVec2> = cornice_profile(size[0], size[1]).iter().map(|p| *p + dvec2(0.0, z)).collect();
    out.piece("trim", style.trim).molding(&profile, x[0], x[1]);
}

/// The nave, `width` meters wide, with its front in the plane y = 0.
pub fn nave(m: &Materials, width: f64, style: &WindowStyle) -> Assembly {
    let mut out = Assembly::default();
    let (eaves, rise, half) = (10.5, 5.6, 0.5 * width);
    let entrance = Opening::arched(half, 2.2, 0.05, 4.3);
    let rose = Opening::circle(half, 8.0, 1.55);
    let side = |x: f64| Opening::arched(x, 0.9, 2.6, 6.6);
    let lower = [side(2.1), entrance, side(width - 2.1)];
    wall(
        out.piece("wall", m.blocks),
        [0.0, width],
        [-0.4, 6.9 - 0.8],
        0.35,
        &[Opening { top: 6.05, ..lower[0] }, entrance, Opening { top: 6.05, ..lower[2] }],
    );
    wall(out.piece("wall", m.blocks), [0.0, width], [6.1, eaves], 0.35, &[rose]);
    let glazing = WindowStyle { surround: 0.0, shutters: None, bars: 5, ..*style };
    for o in [&lower[0], &lower[2]] {
        let o = Opening { top: 6.05, ..*o };
        window(&mut out, m, &o, 0.3, &glazing, 0.0);
        archivolt(out.piece("trim", style.trim), &o, 0.2, 0.05);
    }
    door(&mut out, m, &entrance, 0.35, m.wood[3], m.blocks);
    portal(out.piece("trim", style.trim), &entrance, 3, 0.24);
    rose_window(&mut out, m, &rose, style);
    front_gable(&mut out, m, [width, eaves, rise], style);
    for x in [0.35, width - 0.35] {
        let stone = out.piece("trim", style.trim);
        stone.cuboid(dvec3(x - 0.33, -0.55, -0.4), dvec3(x + 0.33, 0.02, 5.2));
        stone.prism(&[dvec2(-0.55, 5.19), dvec2(0.02, 5.19), dvec2(0.02, 6.1)], |p, end| {
            dvec3(if end { x - 0.33 } else { x + 0.33 }, p.x, p.y)
        });
    }
    let shell = out.piece("wall", m.blocks);
    let (gap, w) = (0.012, width);
    shell.polygon(&[dvec3(gap, DEPTH, -0.4), dvec3(gap, 0.0, -0.4), dvec3(gap, 0.0, eaves), dvec3(gap, DEPTH, eaves)]);
    shell.polygon(&[dvec3(w - gap, 0.0, -0.4), dvec3(w - gap, DEPTH, -0.4), dvec3(w - gap, DEPTH, eaves), dvec3(w - gap, 0.0, eaves)]);
    shell.polygon(&[
        dvec3(w, DEPTH, -0.4),
        dvec3(0.0, DEPTH, -0.4),
        dvec3(0.0, DEPTH, eaves),
        dvec3(half, DEPTH, eaves + rise),
        dvec3(w, DEPTH, eaves),
    ]);
    super::wall::front(out.piece("interior", m.interior), [0.03, width - 0.03], [-0.3, eaves], 6.0);
    out
}

/// A wheel of tracery in a round opening.
fn rose_window(out: &mut Assembly, m: &Materials, o: &Opening, style: &WindowStyle) {
    let (center, radius) = (dvec2(o.x, 0.5 * (o.bottom + o.top)), 0.5 * o.width);
    let stone = out.piece("trim", style.trim);
    frame(stone, &o.outline(-0.28), &o.outline(0.0), [-0.1, 0.004]);
    frame(stone, &o.outline(0.0), &o.outline(0.12), [0.14, 0.3]);
    let hub = Opening::circle(center.x, center.y, 0.42);
    frame(stone, &hub.outline(0.0), &hub.outline(0.1), [0.15, 0.29]);
    for k in 0..10 {
        let angle = TAU * (k as f64 + 0.5) / 10.0;
        let d = dvec2(angle.cos(), angle.sin());
        let at = |r: f64| dvec3(center.x + d.x * r, 0.22, center.y + d.y * r);
        stone.tube(&[at(0.36), at(radius - 0.06)], &[0.045, 0.045], 6);
        let next = TAU * (k as f64 + 1.0) / 10.0;
        let p = center + dvec2(next.cos(), next.sin()) * (radius - 0.36);
        let ring = Opening::circle(p.x, p.y, 0.26);
        frame(stone, &ring.outline(0.0), &ring.outline(0.055), [0.16, 0.28]);
    }
    pane(out.piece("glass", m.glass), &o.outline(0.1), 0.225);
}

/// The triangle over the eaves with its coping, an oculus, a cross, and the roof behind it.
fn front_gable(out: &mut Assembly, m: &Materials, [width, eaves, rise]: [f64; 3], style: &WindowStyle) {
    let half = 0.5 * width;
    let stone = out.piece("wall", m.blocks);
    stone.polygon(&[dvec3(0.0, 0.0, eaves), dvec3(width, 0.0, eaves), dvec3(half, 0.0, eaves + rise)]);
    cornice(out, style, [0.012, width - 0.012], eaves - 0.15, [0.18, 0.3]);
    cornice(out, style, [0.012, width - 0.012], 6.1 - 0.1, [0.14, 0.22]);
    let roof = out.piece("roof", m.slate);
    let (y0, low, top) = (0.3, eaves + 0.1, eaves + rise + 0.1);
    slab(roof, [dvec3(0.004, DEPTH, low), dvec3(0.004, y0, low), dvec3(half, y0, top), dvec3(half, DEPTH, top)], 0.1);
    slab(roof, [dvec3(width - 0.004, y0, low), dvec3(width - 0.004, DEPTH, low), dvec3(half, DEPTH, top), dvec3(half, y0, top)], 0.1);
    // Coping along both edges of the gable.
    let trim = out.piece("trim", style.trim);
    let (t, d) = (0.3, rise / half);
    let strip = |x0: f64, x1: f64, z0: f64, z1: f64| vec![dvec2(x0, z0 - 0.12), dvec2(x1, z1 - 0.12), dvec2(x1, z1 + t), dvec2(x0, z0 + t)];
    trim.plate(&strip(-0.15, half, eaves - 0.15 * d, eaves + rise), -0.12, 0.42);
    trim.plate(&strip(half, width + 0.15, eaves + rise, eaves - 0.15 * d), -0.121, 0.421);
    let disk = Opening::circle(half, eaves + 2.0, 0.62);
    frame(trim, &disk.outline(0.0), &disk.outline(0.2), [-0.09, 0.004]);
    let top = eaves + rise + t;
    trim.cuboid(dvec3(half - 0.24, -0.1, top - 0.3), dvec3(half + 0.24, 0.4, top + 0.12));
    trim.cuboid(dvec3(half - 0.08, 0.07, top + 0.1), dvec3(half + 0.08, 0.23, top + 1.3));
    trim.cuboid(dvec3(half - 0.4, 0.08, top + 0.75), dvec3(half + 0.4, 0.22, top + 0.9));
}

/// A square tower of `width` meters; its front is in the plane y = 0.
pub fn tower(m: &Materials, width: f64, style: &WindowStyle) -> Assembly {
    let mut out = Assembly::default();
    let center = dvec3(0.5 * width, 0.5 * width, 0.0);
    let top = 19.0;
    for side in 0..4 {
        let mut face = Assembly::default();
        let mid = 0.5 * width;
        let lower = Opening::arched(mid, 0.8, 4.0, 6.4);
        let belfry = [Opening::arched(mid - 0.95, 1.2, 14.2, 17.6), Opening::arched(mid + 0.95, 1.2, 14.2, 17.6)];
        wall(face.piece("wall", m.blocks), [0.0, width], [-0.4, 7.5], 0.4, if side == 0 { std::slice::from_ref(&lower) } else { &[] });
        wall(face.piece("wall", m.blocks), [0.0, width], [7.5, 13.4], 0.4, &[]);
        wall(face.piece("wall", m.blocks), [0.0, width], [13.4, top], 0.45, &belfry);
        if side == 0 {
            window(&mut face, m, &lower, 0.3, &WindowStyle { surround: 0.0, shutters: None, bars: 4, ..*style }, 0.0);
            archivolt(face.piece("trim", style.trim), &lower, 0.2, 0.05);
        }
        for o in &belfry {
            archivolt(face.piece("trim", style.trim), o, 0.22, 0.06);
            let louvers = face.piece("louvers", m.wood[3]);
            for k in 0..9 {
                let z = 14.25 + 0.33 * k as f64;
                let blade = [dvec2(-0.1, z), dvec2(-0.06, z), dvec2(-0.36, z + 0.3), dvec2(-0.4, z + 0.3)];
                louvers.molding(&blade, o.x - 0.62, o.x + 0.62);
            }
        }
        clock(&mut face, m, dvec2(mid, 11.3), style);
        for (z, size) in [(7.4, [0.14, 0.25]), (13.2, [0.16, 0.3]), (top - 0.35, [0.35, 0.45])] {
            // The corner of two faces is mitered by a block.
            cornice(&mut face, style, [0.0, width], z, size);
            face.piece("trim", style.trim).cuboid(dvec3(-size[0] - 0.02, -size[0] - 0.02, z - 0.03), dvec3(0.3, 0.3, z + size[1] + 0.03));
        }
        out.add(&face, turn(center, side));
    }
    let buttress = out.piece("wall", m.blocks);
    for x in [-0.3, width - 0.5] {
        buttress.cuboid(dvec3(x, -0.45, -0.4), dvec3(x + 0.8, 0.4, 7.35));
    }
    spire(&mut out, m, center, top + 0.1, width);
    out
}

/// A quarter turn about the tower's axis.
fn turn(center: DVec3, quarter: usize) -> DAffine3 {
    DAffine3::from_translation(center) * DAffine3::from_rotation_z(0.5 * PI * quarter as f64) * DAffine3::from_translation(-center)
}

/// A clock face with gilded hours and hands.
fn clock(out: &mut Assembly, m: &Materials, at: DVec2, style: &WindowStyle) {
    let face = Opening::circle(at.x, at.y, 1.05);
    frame(out.piece("trim", style.trim), &face.outline(-0.16), &face.outline(0.0), [-0.12, 0.004]);
    pane(out.piece("clock", m.trim), &face.outline(0.0), -0.03);
    let gold = out.piece("gold", m.gold);
    let bar = |angle: f64, r: [f64; 2], half: f64| {
        let (d, n) = (dvec2(angle.sin(), angle.cos()), dvec2(angle.cos(), -angle.sin()));
        [at + d * r[0] - n * half, at + d * r[0] + n * half, at + d * r[1] + n * half, at + d * r[1] - n * half]
    };
    for k in 0..12 {
        gold.plate(&bar(TAU * k as f64 / 12.0, [0.8, 0.97], 0.035), -0.06, -0.02);
    }
    gold.plate(&bar(1.1, [-0.12, 0.8], 0.03), -0.075, -0.062);
    gold.plate(&bar(5.2, [-0.1, 0.52], 0.045), -0.09, -0.078);
}

/// An eight-sided spire over a square base with a gilded ball and a cross.
fn spire(out: &mut Assembly, m: &Materials, center: DVec3, z: f64, width: f64) {
    let half = 0.5 * width + 0.25;
    let at = |x: f64, y: f64, z: f64| center + dvec3(x, y, z);
    let slate = out.piece("roof", m.slate);
    let (octagon, shoulder, peak) = (0.42 * width, z + 1.6, z + 9.0);
    let tip = at(0.0, 0.0, peak);
    for k in 0..4 {
        let turned = |p: DVec3| turn(center, k).transform_point3(p);
        // Half the edge of a regular octagon whose sides are `octagon` from the middle.
        let e = octagon * (PI / 8.0).tan();
        let (a, b) = (at(-half, -half, z), at(half, -half, z));
        let (c, d) = (at(e, -octagon, shoulder), at(-e, -octagon, shoulder));
        let f = at(octagon, -e, shoulder);
        slate.slope(&[a, b, c, d].map(turned));
        slate.slope(&[b, f, c].map(turned));
        slate.slope(&[d, c, tip].map(turned));
        slate.slope(&[c, f, tip].map(turned));
    }
    slate.polygon(&[at(-half, half, z), at(half, half, z), at(half, -half, z), at(-half, -half, z)]);
    let gold = out.piece("gold", m.gold);
    gold.ball(tip + dvec3(0.0, 0.0, 0.12), 0.26, 16);
    gold.cuboid(tip + dvec3(-0.04, -0.04, 0.2), tip + dvec3(0.04, 0.04, 1.6));
    gold.cuboid(tip + dvec3(-0.42, -0.035, 1.05), tip + dvec3(0.42, 0.035, 1.14));
}
