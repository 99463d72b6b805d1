//! Places with writing: a room, a corridor, a row of shops, a shelf of goods and advertising pillars, with boards whose pictures the caller
//! paints.
//!
//! [`Stage::of`] says where boards are and how large, so that writing can be set to fit; [`Stage::model`] builds the place with their
//! pictures. Parts are named by their object: `room.wall`, `lamp.pole`; the front of board `k` is `board.k.front`.

mod board;
mod corridor;
mod pillar;
mod room;
mod shelf;
mod street;
mod views;

use crate::assembly::{Finish, ModelBuilder};
use crate::textures as tx;
use diorama_geom::daylight::Daylight;
use diorama_geom::environment::Environment;
use diorama_geom::glam::{DVec2, DVec3};
use diorama_geom::rng::Rng;
use diorama_geom::sky::Sky;
use diorama_geom::{Camera, ImageU8, Model, Pose};

pub use board::Board;

/// Rows of the maps of the lights.
const LIGHT_ROWS: usize = 64;
/// Dust of an ordinary summer's day over that of the clearest.
const HAZE: f64 = 3.0;
/// Streams of random numbers.
const CHOICE: u64 = 61;
const LIGHT: u64 = 62;
const WALK: u64 = 63;

/// Kinds of places.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Family {
    /// A furnished room with posters.
    Room,
    /// A passage with notices on its walls and signs across it.
    Corridor,
    /// Shop fronts with signs above and before them.
    Street,
    /// A shelf of boxes and cans.
    Shelf,
    /// Round columns with posters that bend around them.
    Pillar,
}

impl Family {
    pub const ALL: [Family; 5] = [Family::Room, Family::Corridor, Family::Street, Family::Shelf, Family::Pillar];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Family::Room => "room",
            Family::Corridor => "corridor",
            Family::Street => "street",
            Family::Shelf => "shelf",
            Family::Pillar => "pillar",
        }
    }

    /// The family of a name.
    pub fn named(name: &str) -> Option<Family> {
        Family::ALL.into_iter().find(|f| f.name() == name)
    }

    /// Boards that it has room for.
    pub fn most_boards(self) -> usize {
        self.boards(&Draw::new(0)).len()
    }

    fn boards(self, draw: &Draw) -> Vec<Board> {
        match self {
            Family::Room => room::boards(draw),
            Family::Corridor => corridor::boards(draw),
            Family::Street => street::boards(draw),
            Family::Shelf => shelf::boards(draw),
            Family::Pillar => pillar::boards(draw),
        }
    }
}

/// Random numbers of a place, by name of what they decide.
pub(crate) struct Draw {
    rng: Rng,
    pub seed: u64,
}

impl Draw {
    fn new(seed: u64) -> Draw {
        Draw { rng: Rng::new(seed, CHOICE), seed }
    }

    /// Uniform between two numbers.
    pub fn between(&self, what: u64, low: f64, high: f64) -> f64 {
        low + (high - low) * self.rng.uniform(what) as f64
    }

    /// One of `n`.
    pub fn below(&self, what: u64, n: usize) -> usize {
        self.rng.below(what, n as u64) as usize
    }
}

/// A place before its boards are painted.
pub struct Stage {
    pub family: Family,
    pub boards: Vec<Board>,
    draw: Draw,
    /// Share of the distance to the boards by which the walk is nearer.
    closer: f64,
}

impl Stage {
    /// The place of a family and a seed with so many boards, at most [`Family::most_boards`].
    pub fn of(family: Family, seed: u64, boards: usize) -> Stage {
        let draw = Draw::new(seed);
        let mut all = family.boards(&draw);
        // Drawn without repetition, and kept in their order.
        while all.len() > boards {
            all.remove(draw.below(1000 + all.len() as u64, all.len()));
        }
        Stage { family, boards: all, draw, closer: 0.0 }
    }

    /// The same with the boards that are next to one of them, filmed from nearer: the walk is moved toward their middle by a share of its
    /// distance.
    pub fn closer(family: Family, seed: u64, boards: usize, share: f64) -> Stage {
        let draw = Draw::new(seed);
        let all = family.boards(&draw);
        let middle = |b: &Board| b.point(DVec2::ZERO);
        let first = middle(&all[draw.below(1000, all.len())]);
        let mut order: Vec<usize> = (0..all.len()).collect();
        order.sort_by(|a, b| middle(&all[*a]).distance(first).total_cmp(&middle(&all[*b]).distance(first)));
        order.truncate(boards);
        order.sort_unstable();
        Stage { family, boards: order.into_iter().map(|k| all[k]).collect(), draw, closer: share }
    }

    /// The place with its boards' pictures, RGB in sRGB and of the boards' proportions, z up, in meters.
    pub fn model(&self, pictures: &[ImageU8]) -> Model {
        let mut builder = ModelBuilder::default();
        let m = Finishes::new(&mut builder, self.draw.seed);
        match self.family {
            Family::Room => room::stand(&mut builder, &m, &self.draw),
            Family::Corridor => corridor::stand(&mut builder, &m, &self.draw),
            Family::Street => street::stand(&mut builder, &m, &self.draw),
            Family::Shelf => shelf::stand(&mut builder, &m, &self.draw),
            Family::Pillar => pillar::stand(&mut builder, &m, &self.draw),
        }
        for (k, (board, picture)) in self.boards.iter().zip(pictures).enumerate() {
            board.stand(&mut builder, k, picture, m.trim);
        }
        builder.finish()
    }

    /// Light of the place: daylight that also falls through the roofs and windows of closed ones.
    pub fn light(&self) -> Daylight {
        let rng = Rng::new(self.draw.seed, LIGHT);
        let is_inside = matches!(self.family, Family::Room | Family::Corridor | Family::Shelf);
        if is_inside || rng.uniform(0) < 0.4 {
            let warm = rng.uniform(1) as f64;
            let tint = [0.9 + 0.15 * warm, 1.0, 1.08 - 0.2 * warm];
            return Daylight::of(Environment::from_fn(LIGHT_ROWS, |d| {
                tint.map(|c| if d.z > 0.0 { c * (1.0 + 2.0 * d.z) / 3.0 } else { 0.05 * c })
            }));
        }
        let elevation = (25.0 + 35.0 * rng.uniform(2) as f64).to_radians();
        let azimuth = (130.0 + 100.0 * rng.uniform(3) as f64).to_radians();
        let clear = Sky::clear(elevation, azimuth);
        Daylight::clear(&Sky { dust: HAZE, ..clear }, LIGHT_ROWS)
    }

    /// `n` cameras of a person who walks past and films, for images of any size.
    pub fn cameras(&self, n: usize, width: u32, height: u32) -> Vec<(Camera, Pose)> {
        let path: views::CameraPath = match self.family {
            Family::Room => room::PATH,
            Family::Corridor => corridor::PATH,
            Family::Street => street::PATH,
            Family::Shelf => shelf::PATH,
            Family::Pillar => pillar::PATH,
        };
        let middle = self.boards.iter().map(|b| b.point(DVec2::ZERO)).sum::<DVec3>() / self.boards.len().max(1) as f64;
        path.cameras(n, (width, height), (middle, self.closer), &Rng::new(self.draw.seed, WALK))
    }
}

/// Materials of all places.
pub(crate) struct Finishes {
    /// White, cream, gray green, pale blue.
    pub plaster: [Finish; 4],
    pub brick: Finish,
    pub stone: Finish,
    pub slabs: Finish,
    pub asphalt: Finish,
    /// Light and dark.
    pub wood: [Finish; 2],
    /// Red, blue, green, yellow, gray, with a mild gloss.
    pub lacquer: [Finish; 5],
    pub iron: Finish,
    pub steel: Finish,
    pub leaf: Finish,
    pub trim: Finish,
}

impl Finishes {
    fn new(b: &mut ModelBuilder, seed: u64) -> Finishes {
        let plaster = b.tiled("plaster", &tx::plaster(seed), 2.0);
        let stone = b.tiled("stone", &tx::stone(seed), 1.5);
        Finishes {
            plaster: [
                b.tinted(plaster, "plaster.white", [0.95, 0.94, 0.9]),
                b.tinted(plaster, "plaster.cream", [0.9, 0.8, 0.62]),
                b.tinted(plaster, "plaster.green", [0.55, 0.62, 0.5]),
                b.tinted(plaster, "plaster.blue", [0.5, 0.6, 0.7]),
            ],
            brick: b.tiled("brick", &tx::bricks(seed), 2.0),
            stone: b.tinted(stone, "stone.sandstone", [0.75, 0.62, 0.45]),
            slabs: b.tiled("slabs", &tx::slabs(seed), 2.4),
            asphalt: b.tiled("asphalt", &tx::asphalt(seed), 3.0),
            wood: [
                b.tiled("wood.light", &tx::wood(seed, [0.5, 0.32, 0.17], [0.3, 0.17, 0.09]), 0.8),
                b.tiled("wood.dark", &tx::wood(seed + 1, [0.22, 0.11, 0.06], [0.1, 0.055, 0.045]), 0.8),
            ],
            lacquer: [
                b.plain("lacquer.red", [0.5, 0.07, 0.06], 0.35, 0.0),
                b.plain("lacquer.blue", [0.07, 0.16, 0.42], 0.35, 0.0),
                b.plain("lacquer.green", [0.08, 0.3, 0.12], 0.35, 0.0),
                b.plain("lacquer.yellow", [0.7, 0.48, 0.07], 0.35, 0.0),
                b.plain("lacquer.gray", [0.3, 0.31, 0.32], 0.4, 0.0),
            ],
            iron: b.plain("iron", [0.06, 0.062, 0.065], 0.45, 0.0),
            steel: b.plain("steel", [0.5, 0.5, 0.5], 0.45, 1.0),
            leaf: b.plain("leaf", [0.1, 0.25, 0.06], 0.6, 0.0),
            trim: b.plain("trim", [0.25, 0.25, 0.26], 0.5, 0.0),
        }
    }
}

/// A wall, floor or ceiling: a box from one corner to the other.
pub(crate) fn slab(builder: &mut ModelBuilder, name: &str, finish: Finish, low: [f64; 3], high: [f64; 3]) {
    let mut object = crate::assembly::Assembly::default();
    object.piece("body", finish).cuboid(DVec3::from(low), DVec3::from(high));
    builder.stand(name, &object, &[diorama_geom::glam::DAffine3::IDENTITY]);
}

#[cfg(test)]
mod tests;
