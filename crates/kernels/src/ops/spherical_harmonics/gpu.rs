//! One unit per direction, the CPU's polynomials.

use super::cpu::{C1, C2, C3, C20, C22, C30, C31, C32, C33};
use crate::gpu::{Buffer, Gpu, launch};
use cubecl::prelude::*;

/// `[N, 3]` to `[N, degree²]`.
pub fn forward(gpu: &Gpu, degree: usize, dirs: &Buffer) -> Buffer {
    let n = dirs.len() / 3;
    let out = gpu.empty(n * degree * degree);
    launch!(gpu, encode, n, [dirs => n * 3, out => n * degree * degree], n as u32, degree);
    out
}

/// Gradient of the directions.
pub fn backward(gpu: &Gpu, degree: usize, dirs: &Buffer, d_out: &Buffer) -> Buffer {
    let n = dirs.len() / 3;
    let out = gpu.empty(n * 3);
    launch!(gpu, slope, n, [dirs => n * 3, d_out => n * degree * degree, out => n * 3], n as u32, degree);
    out
}

#[cube(launch_unchecked)]
fn encode(dirs: &[f32], out: &mut [f32], n: u32, #[comptime] degree: usize) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    let x = dirs[i * 3];
    let y = dirs[i * 3 + 1];
    let z = dirs[i * 3 + 2];
    let at = i * comptime!(degree * degree);
    out[at] = 0.282_094_8;
    if comptime!(degree > 1) {
        out[at + 1] = -C1 * y;
        out[at + 2] = C1 * z;
        out[at + 3] = -C1 * x;
    }
    if comptime!(degree > 2) {
        out[at + 4] = C2 * x * y;
        out[at + 5] = -C2 * y * z;
        out[at + 6] = C20 * z * z - 0.315_391_57;
        out[at + 7] = -C2 * x * z;
        out[at + 8] = C22 * (x * x - y * y);
    }
    if comptime!(degree > 3) {
        let xx = x * x;
        let yy = y * y;
        let zz = z * z;
        out[at + 9] = C3 * y * (yy - 3.0 * xx);
        out[at + 10] = C31 * x * y * z;
        out[at + 11] = C32 * y * (1.0 - 5.0 * zz);
        out[at + 12] = C30 * z * (5.0 * zz - 3.0);
        out[at + 13] = C32 * x * (1.0 - 5.0 * zz);
        out[at + 14] = C33 * z * (xx - yy);
        out[at + 15] = C3 * x * (3.0 * yy - xx);
    }
}

#[cube(launch_unchecked)]
fn slope(dirs: &[f32], d: &[f32], out: &mut [f32], n: u32, #[comptime] degree: usize) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    let x = dirs[i * 3];
    let y = dirs[i * 3 + 1];
    let z = dirs[i * 3 + 2];
    let at = i * comptime!(degree * degree);
    let mut gx = 0.0f32;
    let mut gy = 0.0f32;
    let mut gz = 0.0f32;
    if comptime!(degree > 1) {
        gx -= C1 * d[at + 3];
        gy -= C1 * d[at + 1];
        gz += C1 * d[at + 2];
    }
    if comptime!(degree > 2) {
        gx += C2 * (y * d[at + 4] - z * d[at + 7]) + 2.0 * C22 * x * d[at + 8];
        gy += C2 * (x * d[at + 4] - z * d[at + 5]) - 2.0 * C22 * y * d[at + 8];
        gz += 2.0 * C20 * z * d[at + 6] - C2 * (y * d[at + 5] + x * d[at + 7]);
    }
    if comptime!(degree > 3) {
        let xx = x * x;
        let yy = y * y;
        let zz = z * z;
        gx += C31 * y * z * d[at + 10] - 6.0 * C3 * x * y * d[at + 9];
        gx += C32 * (1.0 - 5.0 * zz) * d[at + 13] + 2.0 * C33 * x * z * d[at + 14] + 3.0 * C3 * (yy - xx) * d[at + 15];
        gy += 3.0 * C3 * (yy - xx) * d[at + 9] + C31 * x * z * d[at + 10] + C32 * (1.0 - 5.0 * zz) * d[at + 11];
        gy += 6.0 * C3 * x * y * d[at + 15] - 2.0 * C33 * y * z * d[at + 14];
        gz += C31 * x * y * d[at + 10] - 10.0 * C32 * y * z * d[at + 11] + C30 * (15.0 * zz - 3.0) * d[at + 12];
        gz += C33 * (xx - yy) * d[at + 14] - 10.0 * C32 * x * z * d[at + 13];
    }
    out[i * 3] = gx;
    out[i * 3 + 1] = gy;
    out[i * 3 + 2] = gz;
}
