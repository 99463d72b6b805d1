//! One unit per level and point; the table's gradient is added atomically. A row of two features is read as
//! one pair, and added to as one where the device can.

use super::HashGrid;
use crate::gpu::{Accumulate, Buffer, Gpu, Pair, Rows, launch};
use cubecl::prelude::*;

/// Numbers per level in the kernels' description: cells, whether dense, first row, rows.
const LEVEL: usize = 4;

/// A grid whose description lies on the device.
pub struct GpuHashGrid {
    pub grid: HashGrid,
    /// Description of each level for the kernels.
    pub levels: Buffer<u32>,
}

impl GpuHashGrid {
    pub fn new(gpu: &Gpu, grid: &HashGrid) -> Self {
        let levels: Vec<u32> = grid.levels.iter().flat_map(|l| [l.cells, l.dense as u32, l.offset as u32, l.rows as u32]).collect();
        GpuHashGrid { grid: grid.clone(), levels: gpu.upload(&levels) }
    }

    /// Points, and points times levels.
    fn work(&self, points: &Buffer) -> (usize, usize) {
        let s = points.len() / 3;
        (s, s * self.grid.levels.len())
    }

    /// Features `[L, S, F]` of points `[S, 3]`.
    pub fn forward(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, table: &Buffer) -> Buffer {
        let ((s, n), f) = (self.work(points), self.grid.config.features);
        let out = gpu.empty(n * f);
        if f == 2 {
            let (pairs, of): (Buffer<[f32; 2]>, Buffer<[f32; 2]>) = (out.cast(), table.cast());
            launch!(
                gpu,
                encode_pairs,
                n,
                [
                    rows.live => rows.at + 1,
                    points => s * 3,
                    self.levels => self.grid.levels.len() * LEVEL,
                    of => self.grid.params_len() / 2,
                    pairs => n,
                ],
                rows.place(),
                s as u32,
                n as u32,
            );
            return out;
        }
        launch!(
            gpu,
            encode,
            n,
            [
                rows.live => rows.at + 1,
                points => s * 3,
                self.levels => self.grid.levels.len() * LEVEL,
                table => self.grid.params_len(),
                out => n * f,
            ],
            rows.place(),
            s as u32,
            n as u32,
            f,
        );
        out
    }

    /// Adds to the gradient of the table.
    pub fn backward(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, d_out: &Buffer, d_table: &Buffer) {
        let ((s, n), f) = (self.work(points), self.grid.config.features);
        if f == 2 && gpu.has_pair_atomics() {
            let (d_out, d_table): (Buffer<[f32; 2]>, Buffer<[f32; 2]>) = (d_out.cast(), d_table.cast());
            launch!(
                gpu,
                scatter_pairs,
                n,
                [
                    rows.live => rows.at + 1,
                    points => s * 3,
                    self.levels => self.grid.levels.len() * LEVEL,
                    d_out => n,
                    d_table => self.grid.params_len() / 2,
                ],
                rows.place(),
                s as u32,
                n as u32,
            );
            return;
        }
        launch!(
            gpu,
            scatter::<Adder>,
            n,
            [
                rows.live => rows.at + 1,
                points => s * 3,
                self.levels => self.grid.levels.len() * LEVEL,
                d_out => n * f,
                d_table => self.grid.params_len(),
            ],
            rows.place(),
            s as u32,
            n as u32,
            f,
        );
    }

    /// `∂features/∂point`, `[L, S, F, 3]`.
    pub fn jacobian(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, table: &Buffer) -> Buffer {
        let ((s, n), f) = (self.work(points), self.grid.config.features);
        let out = gpu.empty(n * f * 3);
        launch!(
            gpu,
            differentiate,
            n,
            [
                rows.live => rows.at + 1,
                points => s * 3,
                self.levels => self.grid.levels.len() * LEVEL,
                table => self.grid.params_len(),
                out => n * f * 3,
            ],
            rows.place(),
            s as u32,
            n as u32,
            f,
        );
        out
    }

    /// Adds to the gradient of the table, given that of the Jacobian.
    pub fn jacobian_backward(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, d_jacobian: &Buffer, d_table: &Buffer) {
        let ((s, n), f) = (self.work(points), self.grid.config.features);
        launch!(
            gpu,
            scatter_slopes::<Adder>,
            n,
            [
                rows.live => rows.at + 1,
                points => s * 3,
                self.levels => self.grid.levels.len() * LEVEL,
                d_jacobian => n * f * 3,
                d_table => self.grid.params_len(),
            ],
            rows.place(),
            s as u32,
            n as u32,
            f,
        );
    }

    /// Gradient of the points `[S, 3]`.
    pub fn backward_positions(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, table: &Buffer, d_out: &Buffer) -> Buffer {
        let ((s, n), f) = (self.work(points), self.grid.config.features);
        let out = gpu.empty(s * 3);
        launch!(
            gpu,
            slope,
            s,
            [
                rows.live => rows.at + 1,
                points => s * 3,
                self.levels => self.grid.levels.len() * LEVEL,
                table => self.grid.params_len(),
                d_out => n * f,
                out => s * 3,
            ],
            rows.place(),
            s as u32,
            self.grid.levels.len() as u32,
            f,
        );
        out
    }
}

/// A coordinate's cell, the place in it, and its slope: cells per unit, 0 where it was clamped.
#[derive(CubeType)]
struct Axis {
    cell: u32,
    at: f32,
    slope: f32,
}

/// Place of a point in a level.
#[derive(CubeType)]
struct Place {
    level: usize,
    x: Axis,
    y: Axis,
    z: Axis,
}

/// A corner of a point's cell: first number of its row, weight, and the weight's derivatives with respect to the point.
#[derive(CubeType)]
struct Corner {
    row: usize,
    weight: f32,
    dx: f32,
    dy: f32,
    dz: f32,
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
fn place(points: &[f32], levels: &[u32], level: usize, p: usize) -> Place {
    let cells = levels[level * LEVEL];
    Place { level, x: locate(points[p * 3], cells), y: locate(points[p * 3 + 1], cells), z: locate(points[p * 3 + 2], cells) }
}

#[cube]
fn share(a: &Axis, #[comptime] bit: u32) -> f32 {
    if comptime!(bit == 1) { a.at } else { 1.0 - a.at }
}

#[cube]
fn slope_of(a: &Axis, #[comptime] bit: u32) -> f32 {
    if comptime!(bit == 1) { a.slope } else { -a.slope }
}

/// Corner `c` lies one cell on along axis `k` where bit `k` of `c` is set.
#[cube]
fn corner(place: &Place, levels: &[u32], #[comptime] c: u32, #[comptime] features: usize) -> Corner {
    let bits = comptime!((c & 1, (c >> 1) & 1, (c >> 2) & 1));
    let x = place.x.cell + comptime!(bits.0);
    let y = place.y.cell + comptime!(bits.1);
    let z = place.z.cell + comptime!(bits.2);
    let l = place.level * LEVEL;
    let n = levels[l] + 1;
    let mut row = x + n * (y + n * z);
    if levels[l + 1] == 0 {
        row = (x ^ (y * 2_654_435_761u32) ^ (z * 805_459_861u32)) & (levels[l + 3] - 1);
    }
    let wx = share(&place.x, comptime!(bits.0));
    let wy = share(&place.y, comptime!(bits.1));
    let wz = share(&place.z, comptime!(bits.2));
    Corner {
        row: (levels[l + 2] + row) as usize * features,
        weight: wx * wy * wz,
        dx: slope_of(&place.x, comptime!(bits.0)) * wy * wz,
        dy: slope_of(&place.y, comptime!(bits.1)) * wx * wz,
        dz: slope_of(&place.z, comptime!(bits.2)) * wx * wy,
    }
}

#[cube(launch_unchecked)]
fn encode(live: &[u32], points: &[f32], levels: &[u32], table: &[f32], out: &mut [f32], at: u32, s: u32, n: u32, #[comptime] f: usize) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize || unit % s as usize >= live[at as usize] as usize {
        terminate!();
    }
    let place = place(points, levels, unit / s as usize, unit % s as usize);
    let mut sum = Array::<f32>::new(f);
    #[unroll]
    for k in 0..f {
        sum[k] = 0.0;
    }
    #[unroll]
    for c in 0..8u32 {
        let corner = corner(&place, levels, c, f);
        #[unroll]
        for k in 0..f {
            sum[k] += corner.weight * table[corner.row + k];
        }
    }
    #[unroll]
    for k in 0..f {
        out[unit * f + k] = sum[k];
    }
}

/// [`encode`] of two features.
#[cube(launch_unchecked)]
fn encode_pairs(live: &[u32], points: &[f32], levels: &[u32], table: &[Pair], out: &mut [Pair], at: u32, s: u32, n: u32) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize || unit % s as usize >= live[at as usize] as usize {
        terminate!();
    }
    let place = place(points, levels, unit / s as usize, unit % s as usize);
    let mut sum = Pair::new(0.0f32);
    #[unroll]
    for c in 0..8u32 {
        let corner = corner(&place, levels, c, 1usize);
        sum += Pair::new(corner.weight) * table[corner.row];
    }
    out[unit] = sum;
}

/// [`scatter`] of two features.
#[cube(launch_unchecked)]
fn scatter_pairs(live: &[u32], points: &[f32], levels: &[u32], d_out: &[Pair], d_table: &[Atomic<Pair>], at: u32, s: u32, n: u32) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize || unit % s as usize >= live[at as usize] as usize {
        terminate!();
    }
    let place = place(points, levels, unit / s as usize, unit % s as usize);
    let d = d_out[unit];
    #[unroll]
    for c in 0..8u32 {
        let corner = corner(&place, levels, c, 1usize);
        d_table[corner.row].fetch_add(Pair::new(corner.weight) * d);
    }
}

#[cube(launch_unchecked)]
fn scatter<A: Accumulate>(
    live: &[u32],
    points: &[f32],
    levels: &[u32],
    d_out: &[f32],
    d_table: &[Atomic<A::Cell>],
    at: u32,
    s: u32,
    n: u32,
    #[comptime] f: usize,
) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize || unit % s as usize >= live[at as usize] as usize {
        terminate!();
    }
    let place = place(points, levels, unit / s as usize, unit % s as usize);
    #[unroll]
    for c in 0..8u32 {
        let corner = corner(&place, levels, c, f);
        #[unroll]
        for k in 0..f {
            A::add(&d_table[corner.row + k], corner.weight * d_out[unit * f + k]);
        }
    }
}

#[cube(launch_unchecked)]
fn slope(
    live: &[u32],
    points: &[f32],
    levels: &[u32],
    table: &[f32],
    d_out: &[f32],
    out: &mut [f32],
    at: u32,
    s: u32,
    n_levels: u32,
    #[comptime] f: usize,
) {
    let p = ABSOLUTE_POS;
    if p >= live[at as usize] as usize {
        terminate!();
    }
    let mut gx = 0.0f32;
    let mut gy = 0.0f32;
    let mut gz = 0.0f32;
    for l in 0..n_levels as usize {
        let place = place(points, levels, l, p);
        #[unroll]
        for c in 0..8u32 {
            let corner = corner(&place, levels, c, f);
            let mut v = 0.0f32;
            #[unroll]
            for k in 0..f {
                v += table[corner.row + k] * d_out[(l * s as usize + p) * f + k];
            }
            gx += v * corner.dx;
            gy += v * corner.dy;
            gz += v * corner.dz;
        }
    }
    out[p * 3] = gx;
    out[p * 3 + 1] = gy;
    out[p * 3 + 2] = gz;
}

#[cube(launch_unchecked)]
fn differentiate(
    live: &[u32],
    points: &[f32],
    levels: &[u32],
    table: &[f32],
    out: &mut [f32],
    at: u32,
    s: u32,
    n: u32,
    #[comptime] f: usize,
) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize || unit % s as usize >= live[at as usize] as usize {
        terminate!();
    }
    let place = place(points, levels, unit / s as usize, unit % s as usize);
    let mut sum = Array::<f32>::new(f * 3);
    #[unroll]
    for k in 0..f * 3 {
        sum[k] = 0.0;
    }
    #[unroll]
    for c in 0..8u32 {
        let corner = corner(&place, levels, c, f);
        #[unroll]
        for k in 0..f {
            let v = table[corner.row + k];
            sum[k * 3] += corner.dx * v;
            sum[k * 3 + 1] += corner.dy * v;
            sum[k * 3 + 2] += corner.dz * v;
        }
    }
    #[unroll]
    for k in 0..f * 3 {
        out[unit * f * 3 + k] = sum[k];
    }
}

#[cube(launch_unchecked)]
fn scatter_slopes<A: Accumulate>(
    live: &[u32],
    points: &[f32],
    levels: &[u32],
    d_jacobian: &[f32],
    d_table: &[Atomic<A::Cell>],
    at: u32,
    s: u32,
    n: u32,
    #[comptime] f: usize,
) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize || unit % s as usize >= live[at as usize] as usize {
        terminate!();
    }
    let place = place(points, levels, unit / s as usize, unit % s as usize);
    #[unroll]
    for c in 0..8u32 {
        let corner = corner(&place, levels, c, f);
        #[unroll]
        for k in 0..f {
            let d = (unit * f + k) * 3;
            let g = corner.dx * d_jacobian[d] + corner.dy * d_jacobian[d + 1] + corner.dz * d_jacobian[d + 2];
            A::add(&d_table[corner.row + k], g);
        }
    }
}
