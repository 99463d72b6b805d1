//! One unit per pixel.

use crate::gpu::{Buffer, Gpu, launch};
use cubecl::prelude::*;
use diorama_geom::PixelFormat;

/// `[R, 4]` for the pixels `at` `[R]` of packed RGBA.
pub fn gather(gpu: &Gpu, format: PixelFormat, pixels: &Buffer<u32>, at: &Buffer<u32>) -> Buffer {
    let n = at.len();
    let out = gpu.empty(n * 4);
    launch!(gpu, unpack, n, [pixels => pixels.len(), at => n, out => n * 4], n as u32, code(format));
    out
}

/// Number of a format, as kernels take it.
pub(crate) fn code(format: PixelFormat) -> u32 {
    match format {
        PixelFormat::Unorm8 => 0,
        PixelFormat::Unorm16 => 1,
        PixelFormat::Half => 2,
    }
}

/// Channel `k` of a pixel.
#[cube]
pub(crate) fn channel(pixels: &[u32], at: usize, #[comptime] k: usize, #[comptime] format: u32) -> f32 {
    if comptime!(format == 0) {
        f32::cast_from((pixels[at] >> comptime!(8 * k as u32)) & 255) / 255.0
    } else {
        let bits = (pixels[at * 2 + comptime!(k / 2)] >> comptime!(16 * (k % 2) as u32)) & 0xffff;
        if comptime!(format == 1) { f32::cast_from(bits) / 65535.0 } else { half(bits) }
    }
}

/// A finite half float: the bits of a float whose exponent is 112 too low. Devices may take the smallest ones for 0.
#[cube]
fn half(bits: u32) -> f32 {
    let mut out = f32::reinterpret((bits & 0x7fff) << 13) * comptime!(2.0f32.powi(112));
    if bits >= 0x8000 {
        out = -out;
    }
    out
}

#[cube(launch_unchecked)]
fn unpack(pixels: &[u32], at: &[u32], out: &mut [f32], n: u32, #[comptime] format: u32) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    out[i * 4] = channel(pixels, at[i] as usize, 0usize, format);
    out[i * 4 + 1] = channel(pixels, at[i] as usize, 1usize, format);
    out[i * 4 + 2] = channel(pixels, at[i] as usize, 2usize, format);
    out[i * 4 + 3] = channel(pixels, at[i] as usize, 3usize, format);
}
