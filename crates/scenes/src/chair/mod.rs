//! An armchair of turned and carved wood with gilded fittings and a cushion of brocade; all its surfaces are closed.
//!
//! It stands on z = 0, its front looks along −y, it is about 1.1 m high. Textures repeat, so texture coordinates overlap.
//! Parts are named `chair.legs`, `chair.gilding`, `chair.cushion` and so on.

mod cushion;
mod frame;

use crate::assembly::{Assembly, ModelBuilder};
use crate::textures as tx;
use diorama_geom::glam::{DAffine3, DVec3, dvec3};
use diorama_geom::{Camera, Model, Pose};

/// Middle of the chair in meters.
pub const CENTER: DVec3 = dvec3(0.0, 0.02, 0.55);

/// Distance of the cameras from the middle in meters.
pub const DISTANCE: f64 = 2.6;

/// Field of view over the shorter side of the image in radians.
pub const FOV: f64 = 0.59;

/// The chair of a seed, which draws the grain of its wood, its gilding and its cloth.
pub fn model(seed: u64) -> Model {
    let mut builder = ModelBuilder::default();
    let wood = builder.tiled("walnut", &tx::wood(seed, [0.34, 0.17, 0.08], [0.12, 0.062, 0.05]), 0.5);
    let dark = builder.tiled("ebony", &tx::wood(seed + 1, [0.1, 0.075, 0.06], [0.05, 0.046, 0.045]), 0.4);
    let gold = builder.tiled("gilding", &tx::gilding(seed), 0.2);
    let cloth = builder.tiled("brocade", &tx::brocade(seed), 0.24);
    let mut chair = Assembly::default();
    frame::legs(&mut chair, wood, gold);
    frame::seat(&mut chair, wood, dark, gold);
    frame::back(&mut chair, wood, dark, gold);
    frame::arms(&mut chair, wood, gold);
    cushion::cushion(&mut chair, cloth, gold);
    builder.stand("chair", &chair, &[DAffine3::IDENTITY]);
    builder.finish()
}

/// `n` cameras spread evenly over a sphere around the chair, from a little below its seat to almost straight above; for images of any size.
pub fn cameras(n: usize, width: u32, height: u32) -> Vec<(Camera, Pose)> {
    let shorter = width.min(height) as f64;
    let fov_x = 2.0 * ((0.5 * FOV).tan() * width as f64 / shorter).atan();
    let camera = Camera::pinhole(width, height, fov_x);
    let pose = |i: usize| {
        let z = -0.12 + 1.06 * (i as f64 + 0.5) / n as f64;
        let (r, angle) = ((1.0 - z * z).sqrt(), i as f64 * 2.399_963_229_728_653);
        let eye = CENTER + DISTANCE * dvec3(r * angle.cos(), r * angle.sin(), z);
        (camera, Pose::look_at(eye, CENTER, DVec3::Z))
    };
    (0..n).map(pose).collect()
}
