//! An arcade: round arches on columns carry the upper storeys; behind them is a covered walk. And a gate: one large arch through a house.

use super::house::cornice_profile;
use super::joinery::{WindowStyle, door, shop, window};
use super::layout::DEPTH;
use super::materials::Materials;
use super::roof::{Roof, roof};
use super::wall::{Opening, front, ring, wall};
use crate::assembly::{Assembly, Finish, place};
use crate::surface::Surface;
use diorama_geom::glam::{DVec2, DVec3, dvec2, dvec3};
use std::f64::consts::PI;

/// Depth of the covered walk in meters.
pub const WALK: f64 = 3.4;

/// Thickness of the arcade's wall in meters.
const WALL: f64 = 0.62;

/// A column with base, swelling shaft, capital and abacus, `height` meters high.
fn column(surface: &mut Surface, at: DVec3, radius: f64, height: f64) {
    let r = radius;
    let square = |s: &mut Surface, half: f64, z0: f64, z1: f64| {
        s.cuboid(at + dvec3(-half, -half, z0), at + dvec3(half, half, z1));
    };
    square(surface, 1.45 * r, -0.2, 0.16);
    square(surface, 1.42 * r, height - 0.14, height);
    let mut profile = vec![dvec2(0.0, 0.15), dvec2(1.36 * r, 0.15)];
    let bulge = |z: f64, out: f64, h: f64| (0..=3).map(move |k| dvec2(out + 0.5 * h * (k as f64 / 3.0 * PI).sin(), z + h * k as f64 / 3.0));
    profile.extend(bulge(0.17, 1.25 * r, 0.1));
    profile.extend([dvec2(1.12 * r, 0.28), dvec2(1.12 * r, 0.32)]);
    profile.extend(bulge(0.33, 1.1 * r, 0.06));
    let (low, high) = (0.42, height - 0.5);
    profile.extend((0..=8).map(|k| {
        let t = k as f64 / 8.0;
        dvec2(r * (1.0 + 0.04 * (t * 2.2).sin() - 0.16 * t), low + (high - low) * t)
    }));
    profile.extend(bulge(high + 0.01, 0.88 * r, 0.05));
    profile.extend([dvec2(0.86 * r, high + 0.08), dvec2(0.92 * r, high + 0.16), dvec2(1.05 * r, high + 0.24), dvec2(1.3 * r, high + 0.32)]);
    profile.extend([dvec2(1.36 * r, high + 0.365), dvec2(0.0, high + 0.365)]);
    surface.lathe(at, &profile, 14);
}

/// The wall above a row of arches that spring at `spring`: both faces, soffits and the feet between the arches.
fn arches(surface: &mut Surface, x: [f64; 2], z: [f64; 2], openings: &[Opening]) {
    wall(surface, x, z, WALL, openings);
    let mut back = Surface::default();
    let mirrored: Vec<Opening> = openings.iter().rev().map(|o| Opening { x: -o.x, ..*o }).collect();
    // The rear face is the front of the mirrored wall, turned around; its reveals are those of the front already.
    wall(&mut back, [-x[1], -x[0]], z, 0.0, &mirrored);
    let turn = place(dvec3(0.0, WALL, 0.0), PI);
    surface.add(&back, turn);
    let mut from = x[0];
    for o in openings.iter().map(|o| [o.x - 0.5 * o.width, o.x + 0.5 * o.width]).chain([[x[1], x[1]]]) {
        surface.polygon(&[dvec3(from, WALL, z[0]), dvec3(o[0], WALL, z[0]), dvec3(o[0], 0.0, z[0]), dvec3(from, 0.0, z[0])]);
        from = o[1];
    }
}

/// A moulded ring on the wall around an arch.
pub fn archivolt(surface: &mut Surface, o: &Opening, width: f64, out: f64) {
    let (outer, inner) = (o.outline(-width), o.outline(0.0));
    // Points of the arch only.
    let over = 2..outer.len();
    let at = |p: DVec2, y: f64| dvec3(p.x, y, p.y);
    for k in over.start..over.end - 1 {
        let (a, b, c, d) = (outer[k], outer[k + 1], inner[k + 1], inner[k]);
        surface.polygon(&[at(a, -out), at(b, -out), at(c, -out), at(d, -out)]);
        surface.polygon(&[at(a, 0.0), at(b, 0.0), at(b, -out), at(a, -out)]);
        surface.polygon(&[at(d, -out), at(c, -out), at(c, 0.0), at(d, 0.0)]);
    }
    for (k, is_right) in [(over.start, true), (over.end - 1, false)] {
        let (a, d) = (outer[k], inner[k]);
        let [a, d] = if is_right { [a, d] } else { [d, a] };
        surface.polygon(&[at(d, 0.0), at(a, 0.0), at(a, -out), at(d, -out)]);
    }
}

/// A building of `bays` arches with two upper storeys.
pub struct Arcade {
    pub width: f64,
    pub bays: usize,
    pub walls: Finish,
    pub style: WindowStyle,
    pub roof: Roof,
}

impl Arcade {
    /// The pieces of the building.
    pub fn build(&self, m: &Materials) -> Assembly {
        let mut out = Assembly::default();
        let (spring, floor) = (2.75, 5.0);
        let pitch = (self.width - 1.2) / self.bays as f64;
        let middle = |k: usize| 0.6 + pitch * (k as f64 + 0.5);
        let width = pitch - 0.62;
        let openings: Vec<Opening> = (0..self.bays).map(|k| Opening::arched(middle(k), width, spring, spring + 0.5 * width)).collect();
        arches(out.piece("wall", m.blocks), [0.0, self.width], [spring, floor], &openings);
        let stone = out.piece("columns", self.style.trim);
        for k in 1..self.bays {
            column(stone, dvec3(0.6 + pitch * k as f64, 0.5 * WALL, 0.0), 0.21, spring + 0.004);
        }
        for o in &openings {
            let trim = out.piece("trim", self.style.trim);
            archivolt(trim, o, 0.24, 0.06);
            let key = [dvec2(-0.13, -0.05), dvec2(0.13, -0.05), dvec2(0.19, 0.5), dvec2(-0.19, 0.5)];
            trim.plate(&key.map(|p| p + dvec2(o.x, o.top)), -0.11, 0.1);
        }
        // Corner piers.
        for [a, b] in [[0.006, 0.91 - 0.004], [self.width - 0.91 + 0.004, self.width - 0.006]] {
            out.piece("wall", m.blocks).cuboid(dvec3(a, 0.004, -0.4), dvec3(b, WALL - 0.004, spring - 0.12));
            out.piece("trim", self.style.trim).cuboid(dvec3(a - 0.002, -0.07, spring - 0.12), dvec3(b + 0.05, WALL + 0.05, spring + 0.003));
        }
        self.walk(&mut out, m, floor, middle);
        let mut z = floor;
        for (height, window_height) in [(4.0, 2.3), (3.5, 1.9)] {
            self.storey(&mut out, m, [z, z + height], window_height, middle);
            z += height;
        }
        self.shell(&mut out, m, floor, z);
        roof(&mut out, m, &self.roof, self.width, z, self.walls);
        out
    }

    /// The covered walk: a rear wall with doors and shops, a ceiling with beams, end walls.
    fn walk(&self, out: &mut Assembly, m: &Materials, floor: f64, middle: impl Fn(usize) -> f64) {
        let pitch = middle(1) - middle(0);
        let filled: Vec<(Opening, bool)> = (0..self.bays)
            .map(|k| match k % 3 {
                1 => (Opening::arched(middle(k), 1.5, 0.05, 3.3), true),
                _ => (Opening::rectangle(middle(k), pitch - 1.1, 0.03, 2.9), false),
            })
            .collect();
        let mut own = Assembly::default();
        let holes: Vec<Opening> = filled.iter().map(|f| f.0).collect();
        wall(own.piece("wall", self.walls), [0.02, self.width - 0.02], [-0.4, floor], 0.2, &holes);
        for (k, (o, is_door)) in filled.iter().enumerate() {
            if *is_door {
                door(&mut own, m, o, 0.2, m.wood[3], self.style.trim);
            } else {
                shop(&mut own, m, o, 0.2, m.wood[1 + k % 2], None);
            }
        }
        out.add(&own, place(dvec3(0.0, WALK, 0.0), 0.0));
        let (x0, x1) = (0.02, self.width - 0.02);
        let ceiling = out.piece("ceiling", m.plaster[2]);
        ceiling.polygon(&[
            dvec3(x0, WALK, floor - 0.05),
            dvec3(x1, WALK, floor - 0.05),
            dvec3(x1, WALL, floor - 0.05),
            dvec3(x0, WALL, floor - 0.05),
        ]);
        for x in [x0, x1] {
            let corners = [dvec3(x, WALK, -0.4), dvec3(x, WALL - 0.01, -0.4), dvec3(x, WALL - 0.01, floor), dvec3(x, WALK, floor)];
            let inward: Vec<DVec3> = if x == x0 { corners.iter().rev().copied().collect() } else { corners.to_vec() };
            out.piece("wall", self.walls).polygon(&inward);
        }
        let beams = out.piece("beams", m.wood[3]);
        for k in 0..=self.bays * 2 {
            let x = (0.6 + 0.5 * pitch * k as f64).clamp(0.2, self.width - 0.2);
            beams.cuboid(dvec3(x - 0.09, WALL - 0.03, floor - 0.3), dvec3(x + 0.09, WALK + 0.05, floor - 0.04));
        }
    }

    fn storey(&self, out: &mut Assembly, m: &Materials, z: [f64; 2], height: f64, middle: impl Fn(usize) -> f64) {
        let openings: Vec<Opening> =
            (0..self.bays).map(|k| Opening::rectangle(middle(k), 1.15, z[0] + 0.95, z[0] + 0.95 + height)).collect();
        wall(out.piece("wall", self.walls), [0.0, self.width], z, 0.2, &openings);
        for (k, o) in openings.iter().enumerate() {
            window(out, m, o, 0.18, &self.style, [0.3, 0.0, 0.2, 0.4][k % 4]);
        }
        let trim = out.piece("trim", self.style.trim);
        let profile: Vec<DVec2> = cornice_profile(0.2, 0.3).iter().map(|p| *p + dvec2(0.0, z[0] - 0.12)).collect();
        trim.molding(&profile, 0.012, self.width - 0.012);
    }

    fn shell(&self, out: &mut Assembly, m: &Materials, floor: f64, top: f64) {
        let (w, gap) = (self.width, 0.012);
        let side = out.piece("wall", self.walls);
        side.polygon(&[dvec3(gap, DEPTH, -0.4), dvec3(gap, 0.0, -0.4), dvec3(gap, 0.0, top), dvec3(gap, DEPTH, top)]);
        side.polygon(&[dvec3(w - gap, 0.0, -0.4), dvec3(w - gap, DEPTH, -0.4), dvec3(w - gap, DEPTH, top), dvec3(w - gap, 0.0, top)]);
        side.polygon(&[dvec3(w, DEPTH, -0.4), dvec3(0.0, DEPTH, -0.4), dvec3(0.0, DEPTH, top), dvec3(w, DEPTH, top)]);
        let profile: Vec<DVec2> = cornice_profile(0.45, 0.5).iter().map(|p| *p + dvec2(0.0, top - 0.5)).collect();
        out.piece("trim", self.style.trim).molding(&profile, 0.0, w);
        let room = out.piece("interior", m.interior);
        front(room, [0.03, w - 0.03], [floor, top], 3.6);
        front(room, [0.03, w - 0.03], [0.0, floor], WALK + 2.0);
        for z in [floor + 0.3, floor + 4.0, top] {
            room.cuboid(dvec3(0.03, 0.22, z - 0.3), dvec3(w - 0.03, 3.59, z - 0.02));
        }
    }
}

/// A gatehouse, `width` meters wide: a passage for the road under one storey.
pub fn gatehouse(m: &Materials, width: f64, style: &WindowStyle, tiles: &Roof) -> Assembly {
    let mut out = Assembly::default();
    let passage = Opening::arched(0.5 * width, 6.6, -0.4, 6.0);
    let (walls, floor, top) = (m.blocks, 7.2, 11.4);
    wall(out.piece("wall", walls), [0.0, width], [-0.4, floor], DEPTH, &[passage]);
    archivolt(out.piece("trim", style.trim), &passage, 0.5, 0.09);
    let mut rear = Surface::default();
    wall(&mut rear, [-width, 0.0], [-0.4, floor], 0.0, &[Opening { x: -passage.x, ..passage }]);
    let turn = place(dvec3(0.0, DEPTH, 0.0), PI);
    out.piece("wall", walls).add(&rear, turn);
    let openings: Vec<Opening> = (0..4).map(|k| Opening::arched(width * (0.2 + 0.2 * k as f64), 0.95, floor + 0.9, floor + 3.0)).collect();
    wall(out.piece("wall", walls), [0.0, width], [floor, top], 0.25, &openings);
    for o in &openings {
        window(&mut out, m, o, 0.2, style, 0.0);
    }
    for (low, reach, tall) in [(floor - 0.15, 0.16, 0.3), (top - 0.5, 0.4, 0.5)] {
        let profile: Vec<DVec2> = cornice_profile(reach, tall).iter().map(|p| *p + dvec2(0.0, low)).collect();
        out.piece("trim", style.trim).molding(&profile, 0.0, width);
    }
    let side = out.piece("wall", walls);
    side.polygon(&[dvec3(0.012, DEPTH, -0.4), dvec3(0.012, 0.0, -0.4), dvec3(0.012, 0.0, top), dvec3(0.012, DEPTH, top)]);
    let x = width - 0.012;
    side.polygon(&[dvec3(x, 0.0, -0.4), dvec3(x, DEPTH, -0.4), dvec3(x, DEPTH, top), dvec3(x, 0.0, top)]);
    side.polygon(&[dvec3(width, DEPTH, floor), dvec3(0.0, DEPTH, floor), dvec3(0.0, DEPTH, top), dvec3(width, DEPTH, top)]);
    let room = out.piece("interior", m.interior);
    front(room, [0.03, width - 0.03], [floor, top], 3.0);
    room.cuboid(dvec3(0.03, 0.27, floor), dvec3(width - 0.03, 2.99, floor + 0.3));
    roof(&mut out, m, tiles, width, top, walls);
    out
}

/// Nested arches around an opening, each set further back.
pub fn portal(surface: &mut Surface, o: &Opening, steps: usize, step: f64) {
    for k in 0..steps {
        let (outer, inner) = (o.outline(-step * (k + 1) as f64), o.outline(-step * k as f64));
        let y = -0.12 * (k + 1) as f64;
        let at = |p: DVec2| dvec3(p.x, y, p.y);
        for e in 1..outer.len() {
            let n = (e + 1) % outer.len();
            surface.polygon(&[at(outer[e]), at(outer[n]), at(inner[n]), at(inner[e])]);
        }
        ring(surface, &inner, 1, [y, y + 0.12]);
        if k + 1 == steps {
            let reversed: Vec<DVec2> = outer.iter().rev().copied().collect();
            // The last edge of the reversed outline is the threshold, which is left out.
            let n = reversed.len();
            for e in 0..n - 2 {
                let (a, b) = (reversed[e], reversed[e + 1]);
                surface.polygon(&[dvec3(a.x, y, a.y), dvec3(b.x, y, b.y), dvec3(b.x, 0.0, b.y), dvec3(a.x, 0.0, a.y)]);
            }
            let (a, b) = (reversed[n - 1], reversed[0]);
            surface.polygon(&[dvec3(a.x, y, a.y), dvec3(b.x, y, b.y), dvec3(b.x, 0.0, b.y), dvec3(a.x, 0.0, a.y)]);
        }
    }
}
