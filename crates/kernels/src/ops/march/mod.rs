//! Ray marching through an occupancy grid (instant-ngp, section E.1): steps of length
//! `δ = clamp(t · cone, δ_min, δ_max)` in occupied cells, jumps to the cell's far side elsewhere.
//!
//! The grid has `cascades` nested cubes of `resolution³` cells around the model cube `[0, 1]³`;
//! cascade `c` is `2^c` times as large. A sample reads the finest cascade that contains its midpoint
//! and whose cells are no smaller than its step.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Which cells may hold matter, one bit each, `[cascades, z, y, x]`.
#[derive(Clone, Debug, PartialEq)]
pub struct OccupancyBits {
    pub resolution: usize,
    pub cascades: usize,
    pub bits: Vec<u64>,
}

impl OccupancyBits {
    /// All cells occupied.
    ///
    /// # Panics
    /// When the resolution is not a multiple of 4.
    pub fn full(resolution: usize, cascades: usize) -> Self {
        assert!(resolution.is_multiple_of(4) && cascades > 0, "occupancy grid: {resolution}^3 x {cascades}");
        Self { resolution, cascades, bits: vec![u64::MAX; cascades * resolution.pow(3) / 64] }
    }

    pub fn cells(&self) -> usize {
        self.cascades * self.resolution.pow(3)
    }

    #[inline(always)]
    pub fn get(&self, cell: usize) -> bool {
        self.bits[cell >> 6] >> (cell & 63) & 1 == 1
    }

    pub fn set(&mut self, cell: usize, occupied: bool) {
        let bit = 1u64 << (cell & 63);
        if occupied {
            self.bits[cell >> 6] |= bit;
        } else {
            self.bits[cell >> 6] &= !bit;
        }
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

/// How far apart samples lie.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MarchConfig {
    pub cone: f32,
    pub dt_min: f32,
    pub dt_max: f32,
    pub max_samples: usize,
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
    /// Whether the rays go on from an earlier march: the first sample then begins at near itself.
    pub resumed: bool,
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
