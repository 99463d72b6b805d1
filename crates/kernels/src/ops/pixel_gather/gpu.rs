//! One unit per pixel.

use crate::gpu::{Buffer, CUBE, Gpu, units};
use cubecl::prelude::*;

/// `[R, 4]` for the pixels `at` `[R]` of packed RGBA `[P]`, red in the lowest byte.
pub fn gather(gpu: &Gpu, pixels: &Buffer, at: &Buffer) -> Buffer {
    let out = gpu.empty(at.len() * 4);
    if !at.is_empty() {
        // SAFETY: units past the length stop; `at` indexes the pixels.
        unsafe {
            unpack::launch_unchecked(
                &gpu.client,
                units(at.len()),
                CubeDim::new_1d(CUBE),
                pixels.arg(),
                at.arg(),
                out.arg(),
                at.len() as u32,
            );
        }
    }
    out
}

#[cube(launch_unchecked)]
fn unpack(pixels: &[u32], at: &[u32], out: &mut [f32], n: u32) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    let pixel = pixels[at[i] as usize];
    #[unroll]
    for k in 0..4u32 {
        out[i * 4 + k as usize] = f32::cast_from((pixel >> (k * 8)) & 255) / 255.0;
    }
}
