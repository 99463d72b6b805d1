//! Houses in a row: storeys of bays under a roof. A house faces −y, its left end is x = 0, it stands on z = 0.

use super::joinery::{WindowStyle, balcony, door, planter, shop, window};
use super::layout::DEPTH;
use super::materials::Materials;
use super::roof::{Roof, roof};
use super::wall::{Opening, front, wall};
use crate::assembly::{Assembly, Finish};
use crate::textures::Noise;
use diorama_geom::glam::{DVec2, dvec2, dvec3};

/// What a bay of a storey has.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Bay {
    Blind,
    Window,
    /// A window down to the floor with a balcony.
    Balcony,
    Door,
    Shop,
    /// A shop with an awning of one of two cloths.
    ShopAwning(usize),
}

/// A storey: its height, and the bays from left to right.
#[derive(Clone, Debug)]
pub struct Storey {
    pub height: f64,
    pub bays: Vec<Bay>,
    /// Width and height of its windows, and whether they are arched.
    pub window: [f64; 2],
    pub is_arched: bool,
}

/// A house.
#[derive(Clone)]
pub struct House {
    pub width: f64,
    pub storeys: Vec<Storey>,
    pub walls: Finish,
    /// The wall of the ground floor.
    pub base: Finish,
    pub style: WindowStyle,
    pub door: Finish,
    pub roof: Roof,
    pub has_quoins: bool,
    pub has_planters: bool,
    pub seed: u64,
}

/// Profile of a cornice that stands out by `out`, from 0 up to `height`.
pub fn cornice_profile(out: f64, height: f64) -> Vec<DVec2> {
    [[-0.05, 0.0], [0.2, 0.0], [0.25, 0.22], [0.45, 0.3], [0.55, 0.5], [0.9, 0.58], [0.9, 0.8], [1.0, 0.84], [1.0, 1.0], [-0.05, 1.0]]
        .map(|[x, z]| dvec2(if x < 0.0 { x } else { x * out }, z * height))
        .to_vec()
}

impl House {
    /// The pieces of the house.
    pub fn build(&self, m: &Materials) -> Assembly {
        let mut out = Assembly::default();
        let mut z = 0.0;
        for (level, storey) in self.storeys.iter().enumerate() {
            self.storey(&mut out, m, level, storey, z);
            z += storey.height;
            let is_last = level + 1 == self.storeys.len();
            let profile = if is_last { cornice_profile(0.42, 0.45) } else { cornice_profile(0.13, 0.2) };
            let low = z - if is_last { 0.45 } else { 0.1 };
            let shifted: Vec<DVec2> = profile.iter().map(|p| *p + dvec2(0.0, low)).collect();
            let end = if is_last { 0.0 } else { 0.012 };
            out.piece("trim", self.style.trim).molding(&shifted, end, self.width - end);
        }
        self.shell(&mut out, m, z);
        if self.has_quoins {
            let stone = out.piece("trim", self.style.trim);
            let n = ((z - 0.6) / 0.42) as usize;
            for k in 0..n {
                let (low, reach) = (0.42 * k as f64, if k % 2 == 0 { 0.62 } else { 0.4 });
                stone.cuboid(dvec3(0.006, -0.035, low), dvec3(reach, 0.02, low + 0.4));
                stone.cuboid(dvec3(self.width - reach, -0.035, low), dvec3(self.width - 0.006, 0.02, low + 0.4));
            }
        }
        roof(&mut out, m, &self.roof, self.width, z, self.walls);
        out
    }

    fn storey(&self, out: &mut Assembly, m: &Materials, level: usize, storey: &Storey, z: f64) {
        let noise = Noise::new(self.seed, 73 + level as u64);
        let n = storey.bays.len();
        let margin = 0.5;
        let pitch = (self.width - 2.0 * margin) / n as f64;
        let low = if level == 0 { -0.4 } else { z };
        let mut openings: Vec<(Opening, Bay)> = Vec::new();
        for (k, &bay) in storey.bays.iter().enumerate() {
            let x = margin + pitch * (k as f64 + 0.5);
            let [w, h] = storey.window;
            let sill = z + if level == 0 { 1.05 } else { 0.85 };
            let opening = match bay {
                Bay::Blind => continue,
                Bay::Window => Opening { is_arched: storey.is_arched, ..Opening::rectangle(x, w, sill, sill + h) },
                Bay::Balcony => Opening { is_arched: storey.is_arched, ..Opening::rectangle(x, w + 0.1, z + 0.16, sill + h) },
                Bay::Door => Opening { is_arched: storey.is_arched, ..Opening::rectangle(x, 1.35, 0.05, (storey.height - 0.75).min(3.0)) },
                Bay::Shop | Bay::ShopAwning(_) => Opening::rectangle(x, pitch - 0.75, 0.02, storey.height - 1.05),
            };
            openings.push((opening, bay));
        }
        let finish = if level == 0 { self.base } else { self.walls };
        let holes: Vec<Opening> = openings.iter().map(|o| o.0).collect();
        let depth = 0.2;
        wall(out.piece("wall", finish), [0.0, self.width], [low, z + storey.height], depth, &holes);
        for (k, (o, bay)) in openings.iter().enumerate() {
            let chance = |channel: u64| noise.value(k as i64, level as i64, channel) as f64;
            match *bay {
                Bay::Door => door(out, m, o, depth, self.door, self.style.trim),
                Bay::Shop => shop(out, m, o, depth, self.door, None),
                Bay::ShopAwning(cloth) => shop(out, m, o, depth, self.door, Some(m.awning[cloth])),
                _ => {
                    let curtain = if chance(0) < 0.65 { 0.12 + 0.25 * chance(1) } else { 0.0 };
                    let style = if *bay == Bay::Balcony { WindowStyle { shutters: None, ..self.style } } else { self.style };
                    window(out, m, o, depth - 0.03, &style, curtain);
                }
            }
            if *bay == Bay::Balcony {
                balcony(out, m, [o.x - 0.5 * o.width - 0.45, o.x + 0.5 * o.width + 0.45], z + 0.14, self.style.trim, 0.85);
            }
            if *bay == Bay::Window && self.has_planters && level > 0 && chance(2) < 0.6 {
                planter(out, m, [o.x - 0.5 * o.width, o.x + 0.5 * o.width], -0.2, o.bottom + 0.025, self.seed * 64 + k as u64);
                out.piece("iron", m.iron)
                    .cuboid(dvec3(o.x - 0.5 * o.width, -0.315, o.bottom - 0.05), dvec3(o.x + 0.5 * o.width, -0.13, o.bottom + 0.022));
            }
        }
    }

    /// Side and back walls, floors and a wall inside, so that a look through a window ends in a room.
    fn shell(&self, out: &mut Assembly, m: &Materials, top: f64) {
        let (w, gap) = (self.width, 0.012);
        let side = out.piece("wall", self.walls);
        side.polygon(&[dvec3(gap, DEPTH, -0.4), dvec3(gap, 0.0, -0.4), dvec3(gap, 0.0, top), dvec3(gap, DEPTH, top)]);
        side.polygon(&[dvec3(w - gap, 0.0, -0.4), dvec3(w - gap, DEPTH, -0.4), dvec3(w - gap, DEPTH, top), dvec3(w - gap, 0.0, top)]);
        side.polygon(&[dvec3(w, DEPTH, -0.4), dvec3(0.0, DEPTH, -0.4), dvec3(0.0, DEPTH, top), dvec3(w, DEPTH, top)]);
        let room = out.piece("interior", m.interior);
        front(room, [gap + 0.01, w - gap - 0.01], [-0.3, top], 3.2);
        let mut z = 0.0;
        for storey in &self.storeys {
            z += storey.height;
            room.cuboid(dvec3(gap + 0.01, 0.22, z - 0.32), dvec3(w - gap - 0.01, 3.19, z - 0.02));
        }
        room.cuboid(dvec3(gap + 0.01, 0.5, -0.2), dvec3(w - gap - 0.01, 3.19, 0.0));
    }
}
