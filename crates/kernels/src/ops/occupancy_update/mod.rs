//! Upkeep of an occupancy grid (instant-ngp, section E.2): per cell the decayed maximum of the densities that were met in it,
//! `d ← max(decay · d, met)`, and the bits that marching reads, `d > min(threshold, mean d)`.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
mod scatter_max;
#[cfg(test)]
mod tests;

use super::march::OccupancyBits;

/// Density that stands for "never sampled, never occupied", for example because no camera sees the cell.
pub const UNSEEN: f32 = -1.0;

/// Density that stands for "not sampled yet": occupied until it is.
pub const UNKNOWN: f32 = f32::MAX;

/// Densities of a grid's cells, and the bits that follow from them.
#[derive(Clone, Debug)]
pub struct OccupancyGrid {
    /// What marching reads.
    pub bits: OccupancyBits,
    /// Decayed maximum density per cell; or [`UNSEEN`], or [`UNKNOWN`].
    pub density: Vec<f32>,
    /// Highest density met in each cell since the last update; 0 where none was.
    pub fresh: Vec<f32>,
    /// Cells that are sampled: all but the unseen ones.
    pub live: Vec<u32>,
    /// How much of a stored density survives an update of its cell.
    pub decay: f32,
    /// Density above which a cell of each cascade is occupied, unless the mean of the cascade's known densities is lower.
    pub thresholds: Vec<f32>,
}

impl OccupancyGrid {
    /// A grid of which nothing is known yet, with a threshold for each cascade of `resolution³` cells.
    ///
    /// # Panics
    /// When the resolution is not a multiple of 8, or there is no threshold.
    pub fn new(resolution: usize, thresholds: Vec<f32>) -> Self {
        let bits = OccupancyBits::full(resolution, thresholds.len());
        let cells = bits.cells();
        let live = (0..cells as u32).collect();
        OccupancyGrid { bits, density: vec![UNKNOWN; cells], fresh: vec![0.0; cells], live, decay: 0.8, thresholds }
    }
}
