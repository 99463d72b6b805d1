//! One unit per sample and channel; the table's gradient is added atomically.

use super::Corners;
use crate::gpu::{Accumulate, Buffer, Gpu, launch};
use cubecl::prelude::*;

/// Which rows the samples mix, on the device.
pub struct GpuCorners {
    /// `[voxels, 8]`
    pub rows: Buffer<u32>,
    /// `[S]`
    pub voxel: Buffer<u32>,
}

impl GpuCorners {
    pub fn upload(gpu: &Gpu, k: &Corners) -> Self {
        GpuCorners { rows: gpu.upload(k.rows), voxel: gpu.upload(k.voxel) }
    }

    /// Features `[S, C]` at places `[S, 3]` in their voxels.
    pub fn forward(&self, gpu: &Gpu, local: &Buffer, table: &Buffer, c: usize) -> Buffer {
        let s = self.voxel.len();
        let out = gpu.empty(s * c);
        launch!(
            gpu,
            mix,
            s * c,
            [self.rows => self.rows.len(), self.voxel => s, local => s * 3, table => table.len(), out => s * c],
            (s * c) as u32,
            c as u32,
        );
        out
    }

    /// Gradient of the places; that of the table is added to `d_table`.
    pub fn backward(&self, gpu: &Gpu, local: &Buffer, table: &Buffer, c: usize, d_out: &Buffer, d_table: &Buffer) -> Buffer {
        let s = self.voxel.len();
        let d_local = gpu.empty(s * 3);
        launch!(
            gpu,
            unmix::<Adder>,
            s * c,
            [self.rows => self.rows.len(), self.voxel => s, local => s * 3, d_out => s * c, d_table => table.len()],
            (s * c) as u32,
            c as u32,
        );
        launch!(
            gpu,
            slope,
            s,
            [
                self.rows => self.rows.len(),
                self.voxel => s,
                local => s * 3,
                table => table.len(),
                d_out => s * c,
                d_local => s * 3,
            ],
            s as u32,
            c as u32,
        );
        d_local
    }
}

/// Share of a corner along one axis.
#[cube]
fn share(u: f32, bit: u32) -> f32 {
    let mut w = 1.0 - u;
    if bit == 1 {
        w = u;
    }
    w
}

#[cube]
fn weight(local: &[f32], s: usize, corner: u32) -> f32 {
    share(local[s * 3], corner & 1) * share(local[s * 3 + 1], (corner >> 1) & 1) * share(local[s * 3 + 2], (corner >> 2) & 1)
}

#[cube(launch_unchecked)]
fn mix(rows: &[u32], voxel: &[u32], local: &[f32], table: &[f32], out: &mut [f32], n: u32, channels: u32) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let c = channels as usize;
    let s = unit / c;
    let k = unit % c;
    let mut sum = 0.0f32;
    for corner in 0..8u32 {
        let row = rows[voxel[s] as usize * 8 + corner as usize] as usize;
        sum += weight(local, s, corner) * table[row * c + k];
    }
    out[unit] = sum;
}

#[cube(launch_unchecked)]
fn unmix<A: Accumulate>(rows: &[u32], voxel: &[u32], local: &[f32], d_out: &[f32], d_table: &[Atomic<A::Cell>], n: u32, channels: u32) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let c = channels as usize;
    let s = unit / c;
    let k = unit % c;
    for corner in 0..8u32 {
        let row = rows[voxel[s] as usize * 8 + corner as usize] as usize;
        A::add(&d_table[row * c + k], weight(local, s, corner) * d_out[unit]);
    }
}

#[cube(launch_unchecked)]
fn slope(rows: &[u32], voxel: &[u32], local: &[f32], table: &[f32], d_out: &[f32], d_local: &mut [f32], n: u32, channels: u32) {
    let s = ABSOLUTE_POS;
    if s >= n as usize {
        terminate!();
    }
    let c = channels as usize;
    let x = local[s * 3];
    let y = local[s * 3 + 1];
    let z = local[s * 3 + 2];
    let mut gx = 0.0f32;
    let mut gy = 0.0f32;
    let mut gz = 0.0f32;
    for corner in 0..8u32 {
        let row = rows[voxel[s] as usize * 8 + corner as usize] as usize;
        let mut v = 0.0f32;
        for k in 0..c {
            v += table[row * c + k] * d_out[s * c + k];
        }
        let bx = corner & 1;
        let by = (corner >> 1) & 1;
        let bz = (corner >> 2) & 1;
        let wx = share(x, bx);
        let wy = share(y, by);
        let wz = share(z, bz);
        gx += v * wy * wz * (2.0 * f32::cast_from(bx) - 1.0);
        gy += v * wx * wz * (2.0 * f32::cast_from(by) - 1.0);
        gz += v * wx * wy * (2.0 * f32::cast_from(bz) - 1.0);
    }
    d_local[s * 3] = gx;
    d_local[s * 3 + 1] = gy;
    d_local[s * 3 + 2] = gz;
}
