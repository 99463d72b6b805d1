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
    let (near, jitter) = (rays.near_far[r * 2], rays.jitter[r]);
    let t = if rays.resumed { near } else { (near + (jitter - 0.5) * config.step(near)).max(near) };
    let mut march = RayMarch { ray: Ray::new(rays, r), grid, config, t, count: 0, out };
    while march.t < march.ray.far && march.count < config.max_samples {
        march.advance();
    }
}

/// A ray of model space.
struct Ray {
    origin: [f32; 3],
    dir: [f32; 3],
    /// `1 / dir`
    inverse: [f32; 3],
    far: f32,
    jitter: f32,
}

impl Ray {
    #[inline(always)]
    fn new(rays: &MarchRays, r: usize) -> Self {
        let origin = [rays.origins[r * 3], rays.origins[r * 3 + 1], rays.origins[r * 3 + 2]];
        let dir = [rays.dirs[r * 3], rays.dirs[r * 3 + 1], rays.dirs[r * 3 + 2]];
        let inverse = dir.map(|v| if v == 0.0 { f32::INFINITY } else { 1.0 / v });
        Ray { origin, dir, inverse, far: rays.near_far[r * 2 + 1], jitter: rays.jitter[r] }
    }
}

/// The cube of a cascade, `low + [0, size]³`, divided into `cells³` cells.
#[derive(Clone, Copy)]
struct Cube {
    cascade: usize,
    cells: usize,
    low: f32,
    size: f32,
    /// Whether a coarser cascade follows.
    has_coarser: bool,
}

impl Cube {
    /// The finest cascade that holds a point at `reach` from the center (by its greatest coordinate) and whose cells are no shorter than
    /// the step `dt`; the coarsest where there is none.
    #[inline(always)]
    fn around(grid: &OccupancyBits, reach: f32, dt: f32) -> Self {
        let n = grid.resolution;
        // The edge doubles from one cascade to the next.
        let (mut cascade, mut size) = (0, 1.0f32);
        while cascade + 1 < grid.cascades && (reach >= 0.5 * size || dt * n as f32 > size) {
            cascade += 1;
            size *= 2.0;
        }
        Cube { cascade, cells: n, low: 0.5 - 0.5 * size, size, has_coarser: cascade + 1 < grid.cascades }
    }

    /// Whether a step is too long for the cells of this cascade.
    #[inline(always)]
    fn is_too_fine(&self, dt: f32) -> bool {
        self.has_coarser && dt * self.cells as f32 > self.size
    }

    /// The cell that holds a point, or the one at the wall next to it.
    #[inline(always)]
    fn cell(&self, x: [f32; 3]) -> [i32; 3] {
        let last = self.cells as i32 - 1;
        // Exact, as the size is a power of two.
        let scale = self.cells as f32 * f32::from_bits((127 - self.cascade as u32) << 23);
        x.map(|v| (((v - self.low) * scale) as i32).clamp(0, last))
    }

    /// Place of a cell in the grid's memory.
    #[inline(always)]
    fn index(&self, cell: [i32; 3]) -> usize {
        let n = self.cells;
        ((self.cascade * n + cell[2] as usize) * n + cell[1] as usize) * n + cell[0] as usize
    }

    /// Edge of a cell.
    #[inline(always)]
    fn cell_width(&self) -> f32 {
        self.size * (1.0 / self.cells as f32)
    }

    /// Distances at which a ray leaves, along each axis, the block of `2^shift` cells per axis that holds a cell.
    #[inline(always)]
    fn exits(&self, ray: &Ray, cell: [i32; 3], shift: u32) -> [f32; 3] {
        let width = self.cell_width();
        std::array::from_fn(|k| {
            let wall = self.low + (((cell[k] >> shift) + (ray.dir[k] > 0.0) as i32) << shift) as f32 * width;
            if ray.dir[k] != 0.0 { (wall - ray.origin[k]) * ray.inverse[k] } else { f32::INFINITY }
        })
    }
}

/// A march along one ray: where it stands, and the samples that it has taken.
struct RayMarch<'a> {
    ray: Ray,
    grid: &'a OccupancyBits,
    config: &'a MarchConfig,
    t: f32,
    count: usize,
    out: &'a mut Marched,
}

impl RayMarch<'_> {
    /// Takes samples in the cell ahead if it is occupied, else skips the empty space.
    #[inline(always)]
    fn advance(&mut self) {
        let dt = self.config.step(self.t);
        let mid = self.t + 0.5 * dt;
        let (o, d) = (self.ray.origin, self.ray.dir);
        let x = [o[0] + mid * d[0], o[1] + mid * d[1], o[2] + mid * d[2]];
        let reach = larger(larger((x[0] - 0.5).abs(), (x[1] - 0.5).abs()), (x[2] - 0.5).abs());
        let cube = Cube::around(self.grid, reach, dt);
        let is_outside = reach >= 0.5 * cube.size;
        if is_outside && !self.config.unbounded {
            self.t += dt;
            return;
        }
        let cell = cube.cell(x);
        let index = cube.index(cell);
        if is_outside {
            self.take(dt, index);
        } else if self.grid.get(index) {
            self.sample_cell(&cube, cell, index, dt);
        } else {
            self.skip_empty(&cube, cell, dt);
        }
    }

    /// Takes all samples whose midpoints lie in the cell, as long as their steps are no longer than it.
    #[inline(always)]
    fn sample_cell(&mut self, cube: &Cube, cell: [i32; 3], index: usize, mut dt: f32) {
        let [x, y, z] = cube.exits(&self.ray, cell, 0);
        let exit = x.min(y).min(z);
        loop {
            self.take(dt, index);
            dt = self.config.step(self.t);
            let stays = self.t + 0.5 * dt < exit && !cube.is_too_fine(dt);
            if !stays || self.t >= self.ray.far || self.count == self.config.max_samples {
                break;
            }
        }
    }

    /// Skips the block of an empty cell if that is empty, else one cell after the other up to the block's far side.
    #[inline(always)]
    fn skip_empty(&mut self, cube: &Cube, cell: [i32; 3], mut dt: f32) {
        let (ray, width) = (&self.ray, cube.cell_width());
        let is_block_empty = self.grid.is_block_empty(cube.cascade, cell.map(|v| v as usize));
        let mut exits = cube.exits(ray, cell, if is_block_empty { BLOCK_SHIFT } else { 0 });
        let mut at = cell;
        loop {
            let jump = exits[nearest(exits)] + (ray.jitter - 0.5) * dt;
            self.t = if jump > self.t { jump } else { self.t + dt };
            dt = self.config.step(self.t);
            if is_block_empty || self.t >= ray.far || cube.is_too_fine(dt) {
                return;
            }
            let mid = self.t + 0.5 * dt;
            loop {
                let k = nearest(exits);
                if exits[k] > mid {
                    break;
                }
                at[k] += if ray.dir[k] > 0.0 { 1 } else { -1 };
                if at[k] >> BLOCK_SHIFT != cell[k] >> BLOCK_SHIFT {
                    return;
                }
                exits[k] += ray.inverse[k].abs() * width;
            }
            if self.grid.get(cube.index(at)) {
                return;
            }
        }
    }

    #[inline(always)]
    fn take(&mut self, dt: f32, cell: usize) {
        self.out.cells.push(cell as u32);
        self.out.t.push(self.t);
        self.out.dt.push(dt);
        self.count += 1;
        self.t += dt;
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
