//! Parallel over chunks of rays, whose samples are joined in order.

use super::{BLOCK, MarchConfig, MarchRays, Marched, OccupancyBits};
use crate::math::multiversion;
use diorama_geom::contraction::Space;
use rayon::prelude::*;

/// Rays per task.
const RAYS: usize = 128;

/// Logarithm of [`BLOCK`].
const BLOCK_SHIFT: u32 = BLOCK.ilog2();

/// Samples of one task and their number per ray.
#[derive(Default)]
struct Piece {
    counts: Vec<u32>,
    samples: Marched,
}

/// Buffers that a march keeps between calls.
#[derive(Default)]
pub struct MarchScratch {
    pieces: Vec<Piece>,
}

/// Fills `out` with the samples of all rays.
///
/// # Panics
/// When the slices of `rays` do not fit together.
pub fn march(grid: &OccupancyBits, rays: &MarchRays, config: &MarchConfig, scratch: &mut MarchScratch, out: &mut Marched) {
    let n = rays.jitter.len();
    assert!(rays.origins.len() == n * 3 && rays.dirs.len() == n * 3 && rays.near_far.len() == n * 2, "march: shapes");
    let tasks = n.div_ceil(RAYS);
    if scratch.pieces.len() < tasks {
        scratch.pieces.resize_with(tasks, Piece::default);
    }
    let pieces = &mut scratch.pieces[..tasks];
    pieces.par_iter_mut().enumerate().for_each(|(task, piece)| {
        piece.counts.clear();
        piece.samples.clear();
        for r in task * RAYS..((task + 1) * RAYS).min(n) {
            let before = piece.samples.t.len();
            march_ray(grid, rays, r, config, &mut piece.samples);
            piece.counts.push((piece.samples.t.len() - before) as u32);
        }
    });
    out.clear();
    out.offsets.push(0);
    let mut total = 0;
    for piece in pieces {
        for c in &piece.counts {
            total += c;
            out.offsets.push(total);
        }
        out.t.extend_from_slice(&piece.samples.t);
        out.dt.extend_from_slice(&piece.samples.dt);
        out.cells.extend_from_slice(&piece.samples.cells);
    }
}

/// Adds the samples of ray `r` to `out`, whose offsets stay as they are; for callers that are parallel themselves.
pub fn march_ray(grid: &OccupancyBits, rays: &MarchRays, r: usize, config: &MarchConfig, out: &mut Marched) {
    let o = [rays.origins[r * 3], rays.origins[r * 3 + 1], rays.origins[r * 3 + 2]];
    let d = [rays.dirs[r * 3], rays.dirs[r * 3 + 1], rays.dirs[r * 3 + 2]];
    let inv = d.map(|v| if v == 0.0 { f32::INFINITY } else { 1.0 / v });
    let (near, far, jitter) = (rays.near_far[r * 2], rays.near_far[r * 2 + 1], rays.jitter[r]);
    let n = grid.resolution;
    let (last, edge_of_cell) = (n as i32 - 1, 1.0 / n as f32);
    let step = |t: f32| config.step(t);
    let mut t = if rays.resumed { near } else { (near + (jitter - 0.5) * step(near)).max(near) };
    let mut count = 0;
    while t < far && count < config.max_samples {
        let mut dt = step(t);
        let mid = t + 0.5 * dt;
        let x = [o[0] + mid * d[0], o[1] + mid * d[1], o[2] + mid * d[2]];
        let reach = larger(larger((x[0] - 0.5).abs(), (x[1] - 0.5).abs()), (x[2] - 0.5).abs());
        // The cube of cascade c: its edge doubles from one to the next.
        let (mut c, mut size) = (0, 1.0f32);
        while c + 1 < grid.cascades && (reach >= 0.5 * size || dt * n as f32 > size) {
            c += 1;
            size *= 2.0;
        }
        let low = 0.5 - 0.5 * size;
        let is_coarse = |dt: f32| c + 1 < grid.cascades && dt * n as f32 > size;
        let is_outside = reach >= 0.5 * size;
        if is_outside && !config.unbounded {
            t += dt;
            continue;
        }
        // Exact, as the size is a power of two.
        let scale = n as f32 * f32::from_bits((127 - c as u32) << 23);
        let width = size * edge_of_cell;
        let cell = x.map(|v| (((v - low) * scale) as i32).clamp(0, last));
        let index = ((c * n + cell[2] as usize) * n + cell[1] as usize) * n + cell[0] as usize;
        // Distances at which the ray leaves the cell, or its block, along each axis.
        let walls = |shift: u32| {
            let mut exits = [f32::INFINITY; 3];
            for k in 0..3 {
                let wall = low + (((cell[k] >> shift) + (d[k] > 0.0) as i32) << shift) as f32 * width;
                exits[k] = if d[k] != 0.0 { (wall - o[k]) * inv[k] } else { f32::INFINITY };
            }
            exits
        };
        if is_outside {
            take(out, t, dt, index);
            count += 1;
            t += dt;
            continue;
        }
        if grid.get(index) {
            // All samples whose midpoints lie in the cell, as long as their steps are no longer than it.
            let [x, y, z] = walls(0);
            let exit = x.min(y).min(z);
            loop {
                take(out, t, dt, index);
                count += 1;
                t += dt;
                dt = step(t);
                let stays = t + 0.5 * dt < exit && !is_coarse(dt);
                if !stays || t >= far || count == config.max_samples {
                    break;
                }
            }
            continue;
        }
        // Past the block if that is empty, else past one cell after the other up to the block's far side.
        let is_block_empty = grid.is_block_empty(c, cell.map(|v| v as usize));
        let mut exits = walls(if is_block_empty { BLOCK_SHIFT } else { 0 });
        let mut at = cell;
        'cells: loop {
            let jump = exits[nearest(exits)] + (jitter - 0.5) * dt;
            t = if jump > t { jump } else { t + dt };
            dt = step(t);
            if is_block_empty || t >= far || is_coarse(dt) {
                break;
            }
            let mid = t + 0.5 * dt;
            loop {
                let k = nearest(exits);
                if exits[k] > mid {
                    break;
                }
                at[k] += if d[k] > 0.0 { 1 } else { -1 };
                if at[k] >> BLOCK_SHIFT != cell[k] >> BLOCK_SHIFT {
                    break 'cells;
                }
                exits[k] += inv[k].abs() * width;
            }
            if grid.get(((c * n + at[2] as usize) * n + at[1] as usize) * n + at[0] as usize) {
                break;
            }
        }
    }
}

/// The larger of two numbers, neither of which is NaN: one instruction, unlike `f32::max`.
#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// Axis of the nearest wall.
#[inline(always)]
fn nearest(exits: [f32; 3]) -> usize {
    let first = if exits[1] < exits[0] { 1 } else { 0 };
    if exits[2] < exits[first] { 2 } else { first }
}

#[inline(always)]
fn take(out: &mut Marched, t: f32, dt: f32, cell: usize) {
    out.cells.push(cell as u32);
    out.t.push(t);
    out.dt.push(dt);
}

multiversion! {
    /// Points of model space, given by coordinate, to `[0, 1]³` over `space`, in place.
    ///
    /// # Panics
    /// When the coordinates are not of one length.
    pub fn normalize(space: Space, points: &mut [Vec<f32>; 3]) {
        let [xs, ys, zs] = points;
        let n = xs.len();
        let (xs, ys, zs) = (&mut xs[..n], &mut ys[..n], &mut zs[..n]);
        match space {
            Space::Cube(edge) => {
                for v in [xs, ys, zs] {
                    v.iter_mut().for_each(|v| *v = (*v - 0.5) / edge + 0.5);
                }
            }
            Space::Contracted(edge) => {
                let inner = 2.0 / edge;
                for i in 0..n {
                    let p = [xs[i], ys[i], zs[i]].map(|v| inner * (v - 0.5));
                    let m = p[0].abs().max(p[1].abs()).max(p[2].abs()).max(1.0);
                    // 1 within the inner cube, where m is 1.
                    let s = 0.25 * (2.0 - 1.0 / m) / m;
                    (xs[i], ys[i], zs[i]) = (p[0] * s + 0.5, p[1] * s + 0.5, p[2] * s + 0.5);
                }
            }
        }
    }
}

/// Midpoints `o + (t + δ/2) d` of packed samples, `[S, 3]`, in model space.
pub fn positions(rays: &MarchRays, samples: &Marched, out: &mut Vec<f32>) {
    out.resize(samples.t.len() * 3, 0.0);
    let mut rest = &mut out[..];
    let mut tasks = Vec::with_capacity(samples.offsets.len() / RAYS + 1);
    let n = samples.offsets.len() - 1;
    for first in (0..n).step_by(RAYS) {
        let last = (first + RAYS).min(n);
        let (own, tail) = rest.split_at_mut((samples.offsets[last] - samples.offsets[first]) as usize * 3);
        rest = tail;
        tasks.push((first, last, own));
    }
    tasks.into_par_iter().for_each(|(first, last, own)| {
        let mut at = 0;
        for r in first..last {
            let (o, d) = (&rays.origins[r * 3..r * 3 + 3], &rays.dirs[r * 3..r * 3 + 3]);
            for i in samples.offsets[r] as usize..samples.offsets[r + 1] as usize {
                let t = samples.t[i] + 0.5 * samples.dt[i];
                for k in 0..3 {
                    own[at + k] = o[k] + t * d[k];
                }
                at += 3;
            }
        }
    });
}

/// Gradients `[R, 3]` of the rays' origins and directions from those of [`positions`] `[S, 3]`, overwritten.
pub fn positions_backward(samples: &Marched, d_positions: &[f32], d_origins: &mut [f32], d_dirs: &mut [f32]) {
    d_origins.fill(0.0);
    d_dirs.fill(0.0);
    for (r, span) in samples.offsets.windows(2).enumerate() {
        for i in span[0] as usize..span[1] as usize {
            let t = samples.t[i] + 0.5 * samples.dt[i];
            for k in 0..3 {
                d_origins[r * 3 + k] += d_positions[i * 3 + k];
                d_dirs[r * 3 + k] += t * d_positions[i * 3 + k];
            }
        }
    }
}
