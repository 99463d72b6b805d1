//! Parallel over chunks of rays, whose samples are joined in order.

use super::{BLOCK, MarchConfig, MarchRays, Marched, OccupancyBits};
use rayon::prelude::*;

/// Rays per task.
const RAYS: usize = 128;

/// Samples of one task: counts per ray, starts and lengths.
#[derive(Default)]
struct Piece {
    counts: Vec<u32>,
    t: Vec<f32>,
    dt: Vec<f32>,
    cells: Vec<u32>,
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
        piece.t.clear();
        piece.dt.clear();
        piece.cells.clear();
        for r in task * RAYS..((task + 1) * RAYS).min(n) {
            let before = piece.t.len();
            march_ray(grid, rays, r, config, piece);
            piece.counts.push((piece.t.len() - before) as u32);
        }
    });
    out.offsets.clear();
    out.t.clear();
    out.dt.clear();
    out.cells.clear();
    out.offsets.push(0);
    let mut total = 0;
    for piece in pieces {
        for c in &piece.counts {
            total += c;
            out.offsets.push(total);
        }
        out.t.extend_from_slice(&piece.t);
        out.dt.extend_from_slice(&piece.dt);
        out.cells.extend_from_slice(&piece.cells);
    }
}

fn march_ray(grid: &OccupancyBits, rays: &MarchRays, r: usize, config: &MarchConfig, piece: &mut Piece) {
    let o = [rays.origins[r * 3], rays.origins[r * 3 + 1], rays.origins[r * 3 + 2]];
    let d = [rays.dirs[r * 3], rays.dirs[r * 3 + 1], rays.dirs[r * 3 + 2]];
    let inv = d.map(|v| if v == 0.0 { f32::INFINITY } else { 1.0 / v });
    let (near, far, jitter) = (rays.near_far[r * 2], rays.near_far[r * 2 + 1], rays.jitter[r]);
    let n = grid.resolution;
    let step = |t: f32| config.step(t);
    let mut t = if rays.resumed { near } else { (near + (jitter - 0.5) * step(near)).max(near) };
    let mut count = 0;
    while t < far && count < config.max_samples {
        let dt = step(t);
        let mid = t + 0.5 * dt;
        let x = [o[0] + mid * d[0], o[1] + mid * d[1], o[2] + mid * d[2]];
        let reach = (x[0] - 0.5).abs().max((x[1] - 0.5).abs()).max((x[2] - 0.5).abs());
        let mut c = 0;
        while c + 1 < grid.cascades && (reach >= 0.5 * (1u32 << c) as f32 || dt * n as f32 > (1u32 << c) as f32) {
            c += 1;
        }
        let (low, size) = OccupancyBits::cube(c);
        if reach >= 0.5 * size && !config.unbounded {
            t += dt;
            continue;
        }
        let scale = n as f32 / size;
        let cell = x.map(|v| (((v - low) * scale) as usize).min(n - 1));
        let index = ((c * n + cell[2]) * n + cell[1]) * n + cell[0];
        if reach >= 0.5 * size || grid.get(index) {
            piece.cells.push(index as u32);
            piece.t.push(t);
            piece.dt.push(dt);
            count += 1;
            t += dt;
            continue;
        }
        // Past the cell, or past its block if that is empty.
        let edge = if grid.is_block_empty(c, cell) { BLOCK } else { 1 };
        let mut exit = f32::INFINITY;
        for k in 0..3 {
            let wall = low + ((cell[k] / edge + (d[k] > 0.0) as usize) * edge) as f32 / scale;
            let e = (wall - o[k]) * inv[k];
            if d[k] != 0.0 && e < exit {
                exit = e;
            }
        }
        let jump = exit + (jitter - 0.5) * dt;
        t = if jump > t { jump } else { t + dt };
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
