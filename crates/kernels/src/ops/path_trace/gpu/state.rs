//! Numbers of paths `[field, path]` and of their samples.

use super::sampler::hash;
use crate::gpu::vector::{V3, luminance};
use crate::ops::path_trace::Pixel;
use crate::ops::ray_triangles::gpu::Found;
use cubecl::prelude::*;

/// Words of a path; where its fields begin follows.
pub const PATH: usize = 22;
pub const ORIGIN: usize = 0;
pub const DIRECTION: usize = 3;
pub const THROUGHPUT: usize = 6;
pub const DENSITY: usize = 9;
/// Dimensions of the sampler that were used.
pub const DIMENSION: usize = 10;
/// What the ray met: triangle, placed tree, distance, weights of two corners.
pub const TRIANGLE: usize = 11;
pub const PLACED: usize = 12;
pub const DISTANCE: usize = 13;
pub const WEIGHTS: usize = 14;
/// Direction to the light that the path asks for, and what arrives from there unless something is in the way.
pub const TOWARD: usize = 16;
pub const ARRIVAL: usize = 19;

/// Where the fields of a sample begin; see [`Pixel`].
pub const COLOR: usize = 0;
pub const ALBEDO: usize = 3;
pub const NORMAL: usize = 6;
pub const DEPTH: usize = 9;
pub const OPACITY: usize = 10;
pub const DIRECT: u32 = 11;
pub const UNSHADOWED: usize = 12;
pub const SUN: u32 = 13;
pub const BACKDROP: usize = 14;
pub const SQUARE: usize = 18;
pub const FIELDS: usize = Pixel::LEN;

/// The paths of a launch.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub struct Batch {
    pub paths: u32,
    /// Pixels, which have equally many paths: path `i` belongs to pixel `i` modulo their number.
    pub pixels: u32,
    /// Index in the picture of the first pixel.
    pub first_pixel: u32,
    /// Index of the first sample of each pixel.
    pub first_sample: u32,
    /// The part of the pixels' seeds that they share.
    pub seed: u32,
}

/// Seed of a path's random numbers.
#[cube]
pub fn seed(b: &Batch, path: usize) -> u32 {
    hash((b.first_pixel + u32::cast_from(path) % b.pixels) ^ b.seed)
}

/// Index of a path's sample among those of its pixel.
#[cube]
pub fn sample(b: &Batch, path: usize) -> u32 {
    b.first_sample + u32::cast_from(path) / b.pixels
}

/// One number of a path.
#[cube]
pub fn number(paths: &mut [u32], field: usize, path: usize, b: &Batch) -> f32 {
    f32::reinterpret(paths[field * b.paths as usize + path])
}

/// Three numbers of a path.
#[cube]
pub fn vector(paths: &mut [u32], field: usize, path: usize, b: &Batch) -> V3 {
    V3 { x: number(paths, field, path, b), y: number(paths, field + 1, path, b), z: number(paths, field + 2, path, b) }
}

/// Writes one number of a path.
#[cube]
pub fn put_number(paths: &mut [u32], field: usize, path: usize, b: &Batch, v: f32) {
    paths[field * b.paths as usize + path] = u32::reinterpret(v);
}

/// Writes three numbers of a path.
#[cube]
pub fn put(paths: &mut [u32], field: usize, path: usize, b: &Batch, v: V3) {
    put_number(paths, field, path, b, v.x);
    put_number(paths, field + 1, path, b, v.y);
    put_number(paths, field + 2, path, b, v.z);
}

/// Adds to a color of a sample.
#[cube]
pub fn add(samples: &mut [f32], field: usize, path: usize, b: &Batch, v: V3) {
    let n = b.paths as usize;
    samples[field * n + path] += v.x;
    samples[(field + 1) * n + path] += v.y;
    samples[(field + 2) * n + path] += v.z;
}

/// Writes a number of a sample.
#[cube]
pub fn note(samples: &mut [f32], field: usize, path: usize, b: &Batch, v: f32) {
    samples[field * b.paths as usize + path] = v;
}

/// What a path's ray met.
#[cube]
pub fn hit(paths: &mut [u32], path: usize, b: &Batch) -> Found {
    let n = b.paths as usize;
    Found {
        t: number(paths, DISTANCE, path, b),
        u: number(paths, WEIGHTS, path, b),
        v: number(paths, WEIGHTS + 1, path, b),
        triangle: paths[TRIANGLE * n + path],
        placed: paths[PLACED * n + path],
    }
}

/// Writes what a path's ray met.
#[cube]
pub fn put_hit(paths: &mut [u32], path: usize, b: &Batch, found: &Found) {
    let n = b.paths as usize;
    paths[TRIANGLE * n + path] = found.triangle;
    paths[PLACED * n + path] = found.placed;
    put_number(paths, DISTANCE, path, b, found.t);
    put_number(paths, WEIGHTS, path, b, found.u);
    put_number(paths, WEIGHTS + 1, path, b, found.v);
}

/// Adds the samples of each pixel to its sums `[19, pixels]`, one after the other.
#[cube(launch_unchecked)]
pub fn accumulate(samples: &[f32], sums: &mut [f32], b: Batch) {
    let pixel = ABSOLUTE_POS;
    let pixels = b.pixels as usize;
    if pixel >= pixels {
        terminate!();
    }
    let n = b.paths as usize;
    for field in 0..FIELDS {
        let mut sum = sums[field * pixels + pixel];
        for k in 0..n / pixels {
            let path = k * pixels + pixel;
            let mut value = samples[field * n + path];
            if field == SQUARE {
                let color = V3 { x: samples[path], y: samples[n + path], z: samples[2 * n + path] };
                value = luminance(color) * luminance(color);
            }
            if field == BACKDROP || field == BACKDROP + 1 || field == BACKDROP + 2 {
                value = samples[(field - BACKDROP) * n + path] * samples[(BACKDROP + 3) * n + path];
            }
            sum += value;
        }
        sums[field * pixels + pixel] = sum;
    }
}
