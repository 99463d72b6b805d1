//! Where paths begin.

use super::angles::sin_cos_turns;
use super::sampler::{Pair, pair};
use super::state::{Batch, DIMENSION, DIRECTION, FIELDS, ORIGIN, THROUGHPUT, put, sample, seed};
use crate::gpu::vector::{V3, along, scale, unit};
use crate::ops::ray_generation::gpu::{self as ray_generation, Direction, INTRINSICS};
use cubecl::prelude::*;

/// Direction in the camera through a point of pixel `x`, `y`; of a lens that is no pinhole with `bent`.
#[cube]
fn direction(camera: &[f32], x: u32, y: u32, at: Pair, #[comptime] bent: bool) -> V3 {
    if comptime!(bent) {
        let d = ray_generation::direction(camera, 0usize, f32::cast_from(x) + at.first, f32::cast_from(y) + at.second, 1.0f32);
        V3 { x: d.x, y: d.y, z: d.z }
    } else {
        let dx = (f32::cast_from(x) - camera[INTRINSICS + 2] + at.first) / camera[INTRINSICS];
        let dy = (f32::cast_from(y) - camera[INTRINSICS + 3] + at.second) / camera[INTRINSICS + 1];
        unit(V3 { x: dx, y: dy, z: 1.0f32.runtime() })
    }
}

/// A vector of the camera in the world.
#[cube]
fn rotated(camera: &[f32], d: V3) -> V3 {
    let w = ray_generation::rotate_to_world(camera, 0usize, &Direction { x: d.x, y: d.y, z: d.z });
    V3 { x: w.x, y: w.y, z: w.z }
}

/// Begins all paths at the camera, or on its lens of a radius that images the plane at distance `focus` sharply.
#[cube(launch_unchecked)]
pub fn start(
    camera: &[f32],
    paths: &mut [u32],
    samples: &mut [f32],
    queue: &mut [u32],
    counts: &mut [u32],
    b: Batch,
    width: u32,
    bounces: u32,
    radius: f32,
    focus: f32,
    #[comptime] bent: bool,
) {
    let path = ABSOLUTE_POS;
    if path >= b.paths as usize {
        terminate!();
    }
    queue[path] = u32::cast_from(path);
    if path == 0 {
        counts[0] = b.paths;
        for i in 1..bounces + 2 {
            counts[i as usize] = 0u32;
        }
    }
    let pixel = b.first_pixel + u32::cast_from(path) % b.pixels;
    let random = seed(&b, path);
    let index = sample(&b, path);
    let mut d = direction(camera, pixel % width, pixel / width, pair(random, index, 1u32), bent);
    let mut origin = V3 { x: camera[3], y: camera[7], z: camera[11] };
    if radius > 0.0 && d.z > 0.0 {
        let lens = pair(random, index, 2u32);
        let around = sin_cos_turns(lens.second);
        let out = radius * lens.first.sqrt();
        let from = V3 { x: out * around.cosine, y: out * around.sine, z: 0.0f32.runtime() };
        d = unit(along(scale(d, focus / d.z), -1.0, from));
        origin = along(origin, 1.0, rotated(camera, from));
    }
    put(paths, ORIGIN, path, &b, origin);
    put(paths, DIRECTION, path, &b, rotated(camera, d));
    put(paths, THROUGHPUT, path, &b, V3 { x: 1.0f32.runtime(), y: 1.0f32.runtime(), z: 1.0f32.runtime() });
    paths[DIMENSION * b.paths as usize + path] = 2u32;
    for i in 0..FIELDS {
        samples[i * b.paths as usize + path] = 0.0f32;
    }
}
