//! One unit per level and point; the table's gradient is added atomically.

use super::HashGrid;
use crate::gpu::{Accumulate, Buffer, CUBE, Gpu, Native, Swap, units};
use cubecl::prelude::*;

/// Numbers that describe a level to the kernels: cells, dense, first row, rows.
const LEVEL: usize = 4;

/// A grid whose description lies on the device.
pub struct GpuHashGrid {
    pub grid: HashGrid,
    levels: Buffer,
}

impl GpuHashGrid {
    pub fn new(gpu: &Gpu, grid: &HashGrid) -> Self {
        let levels: Vec<u32> = grid.levels.iter().flat_map(|l| [l.cells, l.dense as u32, l.offset as u32, l.rows as u32]).collect();
        GpuHashGrid { grid: grid.clone(), levels: gpu.upload_u32(&levels) }
    }

    fn work(&self, points: &Buffer) -> (usize, usize) {
        let s = points.len() / 3;
        (s, s * self.grid.levels.len())
    }

    /// Features `[L, S, F]` of points `[S, 3]`.
    pub fn forward(&self, gpu: &Gpu, points: &Buffer, table: &Buffer) -> Buffer {
        let (s, n) = self.work(points);
        let out = gpu.empty(s * self.grid.output_dims());
        if n > 0 {
            // SAFETY: units past `n` stop; rows come from the grid that sized the table.
            unsafe {
                encode::launch_unchecked(
                    &gpu.client,
                    units(n),
                    CubeDim::new_1d(CUBE),
                    points.arg(),
                    self.levels.arg(),
                    table.arg(),
                    out.arg(),
                    s as u32,
                    n as u32,
                    self.grid.config.features,
                );
            }
        }
        out
    }

    /// Adds to the gradient of the table.
    pub fn backward(&self, gpu: &Gpu, points: &Buffer, d_out: &Buffer, d_table: &Buffer) {
        let (s, n) = self.work(points);
        if n == 0 {
            return;
        }
        let launch = if gpu.native_atomics { scatter::launch_unchecked::<Native> } else { scatter::launch_unchecked::<Swap> };
        // SAFETY: as in `forward`.
        unsafe {
            launch(
                &gpu.client,
                units(n),
                CubeDim::new_1d(CUBE),
                points.arg(),
                self.levels.arg(),
                d_out.arg(),
                d_table.arg(),
                s as u32,
                n as u32,
                self.grid.config.features,
            );
        }
    }

    /// Gradient of the points `[S, 3]`.
    pub fn backward_positions(&self, gpu: &Gpu, points: &Buffer, table: &Buffer, d_out: &Buffer) -> Buffer {
        let (s, _) = self.work(points);
        let out = gpu.empty(s * 3);
        if s > 0 {
            // SAFETY: as in `forward`.
            unsafe {
                slope::launch_unchecked(
                    &gpu.client,
                    units(s),
                    CubeDim::new_1d(CUBE),
                    points.arg(),
                    self.levels.arg(),
                    table.arg(),
                    d_out.arg(),
                    out.arg(),
                    s as u32,
                    self.grid.levels.len() as u32,
                    self.grid.config.features,
                );
            }
        }
        out
    }

    /// `∂features/∂point`, `[L, S, F, 3]`.
    pub fn jacobian(&self, gpu: &Gpu, points: &Buffer, table: &Buffer) -> Buffer {
        let (s, n) = self.work(points);
        let out = gpu.empty(s * self.grid.output_dims() * 3);
        if n > 0 {
            // SAFETY: as in `forward`.
            unsafe {
                differentiate::launch_unchecked(
                    &gpu.client,
                    units(n),
                    CubeDim::new_1d(CUBE),
                    points.arg(),
                    self.levels.arg(),
                    table.arg(),
                    out.arg(),
                    s as u32,
                    n as u32,
                    self.grid.config.features,
                );
            }
        }
        out
    }

    /// Adds to the gradient of the table, given that of the Jacobian.
    pub fn jacobian_backward(&self, gpu: &Gpu, points: &Buffer, d_jacobian: &Buffer, d_table: &Buffer) {
        let (s, n) = self.work(points);
        if n == 0 {
            return;
        }
        let launch = if gpu.native_atomics { scatter_slopes::launch_unchecked::<Native> } else { scatter_slopes::launch_unchecked::<Swap> };
        // SAFETY: as in `forward`.
        unsafe {
            launch(
                &gpu.client,
                units(n),
                CubeDim::new_1d(CUBE),
                points.arg(),
                self.levels.arg(),
                d_jacobian.arg(),
                d_table.arg(),
                s as u32,
                n as u32,
                self.grid.config.features,
            );
        }
    }
}

/// A coordinate's cell, the place in it, and its slope: cells per unit, 0 where it was clamped.
#[derive(CubeType)]
struct Axis {
    cell: u32,
    at: f32,
    slope: f32,
}

#[cube]
fn locate(x: f32, cells: u32) -> Axis {
    let inside = clamp(x, 0.0, 1.0);
    let scale = f32::cast_from(cells);
    let p = inside * scale;
    let cell = min(u32::cast_from(p.floor()), cells - 1);
    let mut slope = 0.0f32;
    if inside == x {
        slope = scale;
    }
    Axis { cell, at: p - f32::cast_from(cell), slope }
}

#[cube]
fn weight(at: f32, #[comptime] bit: u32) -> f32 {
    if comptime!(bit == 1) { at } else { 1.0 - at }
}

#[cube]
fn slope_of(slope: f32, #[comptime] bit: u32) -> f32 {
    if comptime!(bit == 1) { slope } else { -slope }
}

/// Row of a vertex in the table.
#[cube]
fn row(levels: &[u32], l: usize, x: u32, y: u32, z: u32) -> usize {
    let n = levels[l * LEVEL] + 1;
    let mut row = x + n * (y + n * z);
    if levels[l * LEVEL + 1] == 0 {
        row = (x ^ (y * 2_654_435_761u32) ^ (z * 805_459_861u32)) & (levels[l * LEVEL + 3] - 1);
    }
    (levels[l * LEVEL + 2] + row) as usize
}

#[cube(launch_unchecked)]
fn encode(points: &[f32], levels: &[u32], table: &[f32], out: &mut [f32], s: u32, n: u32, #[comptime] f: usize) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let l = unit / s as usize;
    let p = unit % s as usize;
    let cells = levels[l * LEVEL];
    let x = locate(points[p * 3], cells);
    let y = locate(points[p * 3 + 1], cells);
    let z = locate(points[p * 3 + 2], cells);
    let mut sum = Array::<f32>::new(f);
    #[unroll]
    for k in 0..f {
        sum[k] = 0.0;
    }
    #[unroll]
    for c in 0..8u32 {
        let bits = comptime!((c & 1, (c >> 1) & 1, (c >> 2) & 1));
        let w = weight(x.at, comptime!(bits.0)) * weight(y.at, comptime!(bits.1)) * weight(z.at, comptime!(bits.2));
        let at = row(levels, l, x.cell + comptime!(bits.0), y.cell + comptime!(bits.1), z.cell + comptime!(bits.2)) * f;
        #[unroll]
        for k in 0..f {
            sum[k] += w * table[at + k];
        }
    }
    #[unroll]
    for k in 0..f {
        out[unit * f + k] = sum[k];
    }
}

#[cube(launch_unchecked)]
fn scatter<A: Accumulate>(
    points: &[f32],
    levels: &[u32],
    d_out: &[f32],
    d_table: &[Atomic<A::Cell>],
    s: u32,
    n: u32,
    #[comptime] f: usize,
) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let l = unit / s as usize;
    let p = unit % s as usize;
    let cells = levels[l * LEVEL];
    let x = locate(points[p * 3], cells);
    let y = locate(points[p * 3 + 1], cells);
    let z = locate(points[p * 3 + 2], cells);
    #[unroll]
    for c in 0..8u32 {
        let bits = comptime!((c & 1, (c >> 1) & 1, (c >> 2) & 1));
        let w = weight(x.at, comptime!(bits.0)) * weight(y.at, comptime!(bits.1)) * weight(z.at, comptime!(bits.2));
        let at = row(levels, l, x.cell + comptime!(bits.0), y.cell + comptime!(bits.1), z.cell + comptime!(bits.2)) * f;
        #[unroll]
        for k in 0..f {
            A::add(&d_table[at + k], w * d_out[unit * f + k]);
        }
    }
}

#[cube(launch_unchecked)]
fn slope(points: &[f32], levels: &[u32], table: &[f32], d_out: &[f32], out: &mut [f32], s: u32, n_levels: u32, #[comptime] f: usize) {
    let p = ABSOLUTE_POS;
    if p >= s as usize {
        terminate!();
    }
    let mut gx = 0.0f32;
    let mut gy = 0.0f32;
    let mut gz = 0.0f32;
    for l in 0..n_levels as usize {
        let cells = levels[l * LEVEL];
        let x = locate(points[p * 3], cells);
        let y = locate(points[p * 3 + 1], cells);
        let z = locate(points[p * 3 + 2], cells);
        #[unroll]
        for c in 0..8u32 {
            let bits = comptime!((c & 1, (c >> 1) & 1, (c >> 2) & 1));
            let wx = weight(x.at, comptime!(bits.0));
            let wy = weight(y.at, comptime!(bits.1));
            let wz = weight(z.at, comptime!(bits.2));
            let at = row(levels, l, x.cell + comptime!(bits.0), y.cell + comptime!(bits.1), z.cell + comptime!(bits.2)) * f;
            let mut v = 0.0f32;
            #[unroll]
            for k in 0..f {
                v += table[at + k] * d_out[(l * s as usize + p) * f + k];
            }
            gx += v * slope_of(x.slope, comptime!(bits.0)) * wy * wz;
            gy += v * slope_of(y.slope, comptime!(bits.1)) * wx * wz;
            gz += v * slope_of(z.slope, comptime!(bits.2)) * wx * wy;
        }
    }
    out[p * 3] = gx;
    out[p * 3 + 1] = gy;
    out[p * 3 + 2] = gz;
}

#[cube(launch_unchecked)]
fn differentiate(points: &[f32], levels: &[u32], table: &[f32], out: &mut [f32], s: u32, n: u32, #[comptime] f: usize) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let l = unit / s as usize;
    let p = unit % s as usize;
    let cells = levels[l * LEVEL];
    let x = locate(points[p * 3], cells);
    let y = locate(points[p * 3 + 1], cells);
    let z = locate(points[p * 3 + 2], cells);
    let mut sum = Array::<f32>::new(f * 3);
    #[unroll]
    for k in 0..f * 3 {
        sum[k] = 0.0;
    }
    #[unroll]
    for c in 0..8u32 {
        let bits = comptime!((c & 1, (c >> 1) & 1, (c >> 2) & 1));
        let wx = weight(x.at, comptime!(bits.0));
        let wy = weight(y.at, comptime!(bits.1));
        let wz = weight(z.at, comptime!(bits.2));
        let dx = slope_of(x.slope, comptime!(bits.0)) * wy * wz;
        let dy = slope_of(y.slope, comptime!(bits.1)) * wx * wz;
        let dz = slope_of(z.slope, comptime!(bits.2)) * wx * wy;
        let at = row(levels, l, x.cell + comptime!(bits.0), y.cell + comptime!(bits.1), z.cell + comptime!(bits.2)) * f;
        #[unroll]
        for k in 0..f {
            sum[k * 3] += dx * table[at + k];
            sum[k * 3 + 1] += dy * table[at + k];
            sum[k * 3 + 2] += dz * table[at + k];
        }
    }
    #[unroll]
    for k in 0..f * 3 {
        out[unit * f * 3 + k] = sum[k];
    }
}

#[cube(launch_unchecked)]
fn scatter_slopes<A: Accumulate>(
    points: &[f32],
    levels: &[u32],
    d_jacobian: &[f32],
    d_table: &[Atomic<A::Cell>],
    s: u32,
    n: u32,
    #[comptime] f: usize,
) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let l = unit / s as usize;
    let p = unit % s as usize;
    let cells = levels[l * LEVEL];
    let x = locate(points[p * 3], cells);
    let y = locate(points[p * 3 + 1], cells);
    let z = locate(points[p * 3 + 2], cells);
    #[unroll]
    for c in 0..8u32 {
        let bits = comptime!((c & 1, (c >> 1) & 1, (c >> 2) & 1));
        let wx = weight(x.at, comptime!(bits.0));
        let wy = weight(y.at, comptime!(bits.1));
        let wz = weight(z.at, comptime!(bits.2));
        let dx = slope_of(x.slope, comptime!(bits.0)) * wy * wz;
        let dy = slope_of(y.slope, comptime!(bits.1)) * wx * wz;
        let dz = slope_of(z.slope, comptime!(bits.2)) * wx * wy;
        let at = row(levels, l, x.cell + comptime!(bits.0), y.cell + comptime!(bits.1), z.cell + comptime!(bits.2)) * f;
        #[unroll]
        for k in 0..f {
            let d = (unit * f + k) * 3;
            A::add(&d_table[at + k], dx * d_jacobian[d] + dy * d_jacobian[d + 1] + dz * d_jacobian[d + 2]);
        }
    }
}
