//! One unit per sample and channel; the table's gradient is added atomically.

use super::Corners;
use crate::gpu::{Accumulate, Buffer, Gpu, Rows, launch};
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

    /// Adds the gradient of the table to `d_table`.
    pub fn table_backward(&self, gpu: &Gpu, local: &Buffer, c: usize, d_out: &Buffer, d_table: &Buffer) {
        let s = self.voxel.len();
        launch!(
            gpu,
            scatter_gradients::<Adder>,
            s * c,
            [self.rows => self.rows.len(), self.voxel => s, local => s * 3, d_out => s * c, d_table => d_table.len()],
            (s * c) as u32,
            c as u32,
        );
    }

    /// Gradient `[S, 3]` of the places, in voxels whose edge is so long.
    pub fn places_backward(&self, gpu: &Gpu, local: &Buffer, table: &Buffer, c: usize, d_out: &Buffer, edge: f32) -> Buffer {
        let s = self.voxel.len();
        let d_local = gpu.empty(s * 3);
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
            1.0 / edge,
        );
        d_local
    }
}

/// Which voxels of a cube are occupied, on the device.
pub struct GpuVoxels {
    resolution: usize,
    /// Voxel of each cell, `[resolution³]`, x fastest; 0 where it is empty.
    cells: Buffer<u32>,
    /// Rows of the table at each voxel's corners, `[voxels, 8]`.
    rows: Buffer<u32>,
}

impl GpuVoxels {
    /// # Panics
    /// When there are not `resolution³` cells.
    pub fn upload(gpu: &Gpu, resolution: usize, cells: &[u32], rows: &[u32]) -> Self {
        assert_eq!(cells.len(), resolution.pow(3), "voxels: cells");
        GpuVoxels { resolution, cells: gpu.upload(cells), rows: gpu.upload(rows) }
    }

    /// Voxels of points `[S, 3]` of `[0, 1]³`, and where in them the points lie, `[S, 3]`; rows that are not live lie in voxel 0.
    pub fn locate(&self, gpu: &Gpu, rows: &Rows, points: &Buffer) -> (GpuCorners, Buffer) {
        let s = rows.most;
        let (voxel, local) = (gpu.empty(s), gpu.empty(s * 3));
        launch!(
            gpu,
            find,
            s,
            [rows.live => rows.at + 1, points => s * 3, self.cells => self.cells.len(), voxel => s, local => s * 3],
            rows.place(),
            s as u32,
            self.resolution as u32,
        );
        (GpuCorners { rows: self.rows.clone(), voxel }, local)
    }

    /// Edge of a voxel as a share of the cube's.
    pub fn edge(&self) -> f32 {
        1.0 / self.resolution as f32
    }
}

/// Clears the gradient of the row that all empty voxels share, so that they stay empty.
pub fn keep_empty(gpu: &Gpu, c: usize, d_table: &Buffer) {
    launch!(gpu, clear, c, [d_table => c], c as u32);
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
fn find(live: &[u32], points: &[f32], cells: &[u32], voxel: &mut [u32], local: &mut [f32], at: u32, most: u32, resolution: u32) {
    let s = ABSOLUTE_POS;
    if s >= most as usize {
        terminate!();
    }
    let n = resolution as usize;
    let is_live = s < live[at as usize] as usize;
    let mut index = 0usize;
    let mut stride = 1usize;
    for k in 0..3usize {
        let mut v = 0.0f32;
        if is_live {
            v = min(max(points[s * 3 + k], 0.0), 1.0) * f32::cast_from(resolution);
        }
        let cell = min(u32::cast_from(v), resolution - 1);
        local[s * 3 + k] = v - f32::cast_from(cell);
        index += cell as usize * stride;
        stride *= n;
    }
    let mut of = 0u32;
    if is_live {
        of = cells[index];
    }
    voxel[s] = of;
}

#[cube(launch_unchecked)]
fn clear(d_table: &mut [f32], n: u32) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    d_table[i] = 0.0;
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
fn scatter_gradients<A: Accumulate>(
    rows: &[u32],
    voxel: &[u32],
    local: &[f32],
    d_out: &[f32],
    d_table: &[Atomic<A::Cell>],
    n: u32,
    channels: u32,
) {
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
fn slope(rows: &[u32], voxel: &[u32], local: &[f32], table: &[f32], d_out: &[f32], d_local: &mut [f32], n: u32, channels: u32, scale: f32) {
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
    d_local[s * 3] = scale * gx;
    d_local[s * 3 + 1] = scale * gy;
    d_local[s * 3 + 2] = scale * gz;
}
