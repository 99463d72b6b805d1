//! A European street of 60 × 40 m with a square: façades, an arcade, a church, a gate, trees, lamps and parked cars.
//!
//! Part names begin with the object: `house.3.wall`, `arcade.columns`, `church.tower.roof`, `ground.road`, `car.1.body`, `tree.2.leaves`.
//! What may hide a façade from a photographer begins with one of [`OCCLUDERS`].

mod arcade;
mod cameras;
mod car;
mod church;
mod furniture;
mod ground;
mod house;
mod houses;
mod joinery;
mod layout;
mod materials;
mod roof;
mod tree;
mod wall;

use crate::assembly::{ModelBuilder, place};
use diorama_geom::Model;
use diorama_geom::glam::{DAffine3, DVec3};
use layout::Layout;
use materials::Materials;

pub use cameras::{FOV, cameras};

/// Beginnings of the names of parts that stand in the street and are no part of its architecture.
pub const OCCLUDERS: [&str; 3] = ["car.", "tree.", "furniture."];

/// The street of a seed, z up, in meters; the road runs along x through the origin.
pub fn model(seed: u64) -> Model {
    build(seed, false)
}

/// The same without what stands behind cameras that look at its northern row, so that they see what casts shadows there.
pub fn northern_row(seed: u64) -> Model {
    build(seed, true)
}

fn build(seed: u64, is_row: bool) -> Model {
    let mut builder = ModelBuilder::default();
    let m = Materials::new(&mut builder, seed);
    let mut layout = Layout::new(seed);
    let in_row = |at: DVec3| at.y > layout::FACADE - 0.1 && at.x < layout::END;
    layout.trees.retain(|t| !is_row || t.at.y > 0.0);
    builder.stand("ground", &ground::ground(&m, &layout, seed), &[DAffine3::IDENTITY]);
    for (name, object, at) in houses::houses(&m).into_iter().filter(|h| !is_row || in_row(h.2.translation)) {
        builder.stand(&name, &object, &[at]);
    }
    let at = |p: &layout::Place| place(p.at, p.angle) * DAffine3::from_scale(DVec3::splat(p.size));
    let of = |places: &[layout::Place]| places.iter().map(at).collect::<Vec<_>>();
    for kind in 0..2 {
        let places: Vec<DAffine3> = layout.trees.iter().filter(|p| p.kind == kind).map(at).collect();
        let tree = tree::tree(&m, m.leaves[kind], [7.4, 8.0][kind], seed * 2 + kind as u64);
        builder.stand(&format!("tree.{}", kind + 1), &tree, &places);
    }
    let shapes = [car::HATCHBACK, car::SEDAN, car::VAN];
    for (k, p) in layout.cars.iter().enumerate() {
        let shape = shapes[[0, 1, 0, 1, 2, 0, 1, 0][p.kind]];
        let paint = m.lacquer[(p.kind + seed as usize) % m.lacquer.len()];
        builder.stand(&format!("car.{}", k + 1), &car::car(&m, &shape, paint), &[at(p)]);
    }
    builder.stand("furniture.lamp", &furniture::lamp(&m), &of(&layout.lamps));
    builder.stand("furniture.bench", &furniture::bench(&m), &of(&layout.benches));
    builder.stand("furniture.bollard", &furniture::bollard(&m), &of(&layout.bollards));
    builder.stand("furniture.fountain", &furniture::fountain(&m), &[DAffine3::from_translation(layout.fountain)]);
    builder.finish()
}
