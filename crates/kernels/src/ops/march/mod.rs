//! Ray marching through an occupancy grid (instant-ngp, section E.1): steps of length
//! `δ = clamp(t · cone, δ_min, δ_max)` in occupied cells, jumps to the cell's far side elsewhere.
//!
//! The grid has `cascades` nested cubes of `resolution³` cells around the model cube `[0, 1]³`;
//! cascade `c` is `2^c` times as large. A sample reads the finest cascade that contains its midpoint
//! and whose cells are no smaller than its step.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use rayon::prelude::*;

/// Edge of the blocks of cells, for each of which one flag says whether it is empty.
pub(crate) const BLOCK: usize = 8;

/// Which cells may hold matter, one bit each, `[cascades, z, y, x]`.
#[derive(Clone, Debug, PartialEq)]
pub struct OccupancyBits {
    pub resolution: usize,
    pub cascades: usize,
    bits: Vec<u64>,
    /// Whether a block of `8³` cells holds an occupied one, `[cascades, z, y, x]`.
    blocks: Vec<bool>,
}

impl OccupancyBits {
    /// All cells occupied.
    ///
    /// # Panics
    /// When the resolution is not a multiple of 8.
    pub fn full(resolution: usize, cascades: usize) -> Self {
        assert!(resolution.is_multiple_of(BLOCK) && cascades > 0, "occupancy grid: {resolution}^3 x {cascades}");
        let cells = cascades * resolution.pow(3);
        Self { resolution, cascades, bits: vec![u64::MAX; cells / 64], blocks: vec![true; cells / BLOCK.pow(3)] }
    }

    pub fn cells(&self) -> usize {
        self.cascades * self.resolution.pow(3)
    }

    #[inline(always)]
    pub fn get(&self, cell: usize) -> bool {
        self.bits[cell >> 6] >> (cell & 63) & 1 == 1
    }

    /// Whether the block that holds cell `at` of a cascade is empty.
    #[inline(always)]
    pub fn is_block_empty(&self, cascade: usize, at: [usize; 3]) -> bool {
        let n = self.resolution / BLOCK;
        !self.blocks[((cascade * n + at[2] / BLOCK) * n + at[1] / BLOCK) * n + at[0] / BLOCK]
    }

    /// Sets every cell by `occupied`, except the cells of a coarser cascade that a finer one covers: those are occupied where one of
    /// their finer cells is.
    pub fn fill_with(&mut self, occupied: impl Fn(usize) -> bool + Sync) {
        const WORDS: usize = 64;
        self.bits.par_chunks_mut(WORDS).enumerate().for_each(|(chunk, words)| {
            for (w, word) in words.iter_mut().enumerate() {
                let first = (chunk * WORDS + w) * 64;
                *word = (0..64).fold(0, |bits, i| bits | (occupied(first + i) as u64) << i);
            }
        });
        (1..self.cascades).for_each(|c| self.pool(c));
        let (n, bits) = (self.resolution, &self.bits);
        let edge = n / BLOCK;
        self.blocks.par_chunks_mut(edge).enumerate().for_each(|(row, blocks)| {
            let (y, z) = (row % edge * BLOCK, row / edge * BLOCK);
            for (x, block) in blocks.iter_mut().enumerate() {
                // Eight cells along x are one byte of a word.
                *block = (0..BLOCK * BLOCK).any(|k| {
                    let cell = ((z + k / BLOCK) * n + y + k % BLOCK) * n + x * BLOCK;
                    bits[cell >> 6] >> (cell & 63) & 0xff != 0
                });
            }
        });
    }

    /// Sets the cells of `cascade` that the finer cascade before it covers.
    fn pool(&mut self, cascade: usize) {
        let n = self.resolution;
        let words = n.pow(3) / 64;
        let (finer, own) = self.bits[(cascade - 1) * words..(cascade + 1) * words].split_at_mut(words);
        let get = |x: usize, y: usize, z: usize| {
            let cell = (z * n + y) * n + x;
            finer[cell >> 6] >> (cell & 63) & 1 == 1
        };
        let inner = n / 4..3 * n / 4;
        own.par_chunks_mut(n * n / 64).enumerate().filter(|(z, _)| inner.contains(z)).for_each(|(z, slice)| {
            for y in inner.clone() {
                for x in inner.clone() {
                    let first = [x, y, z].map(|v| 2 * (v - n / 4));
                    let any = (0..8).any(|k| get(first[0] + k % 2, first[1] + k / 2 % 2, first[2] + k / 4));
                    let (word, bit) = ((y * n + x) / 64, (y * n + x) % 64);
                    slice[word] = slice[word] & !(1 << bit) | (any as u64) << bit;
                }
            }
        });
    }

    /// Share of occupied cells.
    pub fn fill(&self) -> f64 {
        self.bits.iter().map(|b| b.count_ones() as u64).sum::<u64>() as f64 / self.cells() as f64
    }

    /// Lowest corner and edge of a cascade's cube in model space.
    pub fn cube(cascade: usize) -> (f32, f32) {
        let size = (1u32 << cascade) as f32;
        (0.5 - 0.5 * size, size)
    }
}

/// Spacing of samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MarchConfig {
    pub cone: f32,
    pub dt_min: f32,
    pub dt_max: f32,
    /// Distance beyond which samples are spaced evenly in disparity instead: steps are `t / disparity_from` times as long.
    pub disparity_from: f32,
    /// Whether space beyond the outermost cascade is occupied, instead of empty.
    pub unbounded: bool,
    pub max_samples: usize,
}

impl Default for MarchConfig {
    /// Steps of constant length, within the cascades alone.
    fn default() -> Self {
        MarchConfig { cone: 0.0, dt_min: 1.0 / 1024.0, dt_max: 1.0, disparity_from: f32::MAX, unbounded: false, max_samples: 1024 }
    }
}

impl MarchConfig {
    /// The same marching with steps `by` times as long.
    pub fn stretched(self, by: f32) -> Self {
        MarchConfig { cone: self.cone * by, dt_min: self.dt_min * by, dt_max: self.dt_max * by, ..self }
    }

    /// Length of the step that begins at `t`.
    #[inline(always)]
    pub fn step(&self, t: f32) -> f32 {
        // A branch that is nearly always predicted costs less than the division.
        let growth = if t > self.disparity_from { t / self.disparity_from } else { 1.0 };
        (t * self.cone * growth).clamp(self.dt_min, self.dt_max)
    }
}

/// Rays in model space.
#[derive(Clone, Copy, Debug)]
pub struct MarchRays<'a> {
    /// `[R, 3]`
    pub origins: &'a [f32],
    /// Unit length, `[R, 3]`.
    pub dirs: &'a [f32],
    /// Where each ray enters and leaves the scene; empty when near ≥ far, `[R, 2]`.
    pub near_far: &'a [f32],
    /// Offset of the samples within a step, in [0, 1), `[R]`.
    pub jitter: &'a [f32],
    /// Whether the rays continue an earlier march: the first sample then begins exactly at near.
    pub resumed: bool,
}

/// Coordinates in which positions are given.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Space {
    /// Coordinates of the rays.
    Model,
    /// The cube of this width around the model cube's center as `[0, 1]³`.
    Cube(f32),
    /// All of space, contracted beyond the cube of this width, as `[0, 1]³`.
    Contracted(f32),
    /// As [`Space::Cube`], but as `[−1, 1]³`.
    Centered(f32),
    /// As [`Space::Contracted`], but as `[−1, 1]³`.
    ContractedCentered(f32),
}

/// Packed samples that marching writes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Marched {
    /// `[R + 1]`
    pub offsets: Vec<u32>,
    /// `[S]`
    pub t: Vec<f32>,
    /// `[S]`
    pub dt: Vec<f32>,
    /// Occupied cell that each sample was found in, `[S]`; empty for samples placed without a grid.
    pub cells: Vec<u32>,
}

impl Marched {
    /// Removes all samples and keeps the memory.
    pub fn clear(&mut self) {
        self.offsets.clear();
        self.t.clear();
        self.dt.clear();
        self.cells.clear();
    }
}
