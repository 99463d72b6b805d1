//! One unit per ray.

use crate::gpu::{Buffer, Gpu, launch};
use cubecl::prelude::*;

/// `[R, 2]` for origins and dirs `[R, 3]`; near ≥ far where a ray misses.
pub fn intersect(gpu: &Gpu, origins: &Buffer, dirs: &Buffer, min: [f32; 3], max: [f32; 3], near_plane: f32) -> Buffer {
    let n = origins.len() / 3;
    let (out, bounds) = (gpu.empty(n * 2), gpu.upload(&[min, max].concat()));
    launch!(gpu, clip, n, [origins => n * 3, dirs => n * 3, bounds => 6, out => n * 2], n as u32, near_plane);
    out
}

#[cube(launch_unchecked)]
fn clip(origins: &[f32], dirs: &[f32], bounds: &[f32], out: &mut [f32], n: u32, near_plane: f32) {
    let r = ABSOLUTE_POS;
    if r >= n as usize {
        terminate!();
    }
    let mut near = near_plane;
    let mut far = 1e30f32;
    for k in 0..3usize {
        let o = origins[r * 3 + k];
        let d = dirs[r * 3 + k];
        if d == 0.0 {
            if o < bounds[k] || o > bounds[k + 3] {
                far = -1e30f32;
            }
        } else {
            let a = (bounds[k] - o) / d;
            let b = (bounds[k + 3] - o) / d;
            near = max(near, min(a, b));
            far = min(far, max(a, b));
        }
    }
    if near >= far {
        near = 0.0;
        far = 0.0;
    }
    out[r * 2] = near;
    out[r * 2 + 1] = far;
}
