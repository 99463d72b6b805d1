//! Multiresolution hash encoding (Müller et al. 2022, instant-ngp, section 3).
//!
//! Level `l` is a grid of `N_l = ⌊base · growth^l⌋` cells per axis over `[0, 1]³`. Each vertex owns a
//! row of `F` features; a point takes the trilinear mix of its cell's eight rows. Levels whose
//! vertices fit in the table are indexed directly, the others by
//! `(x ⊕ 2654435761 y ⊕ 805459861 z) mod T`. Points outside the cube are clamped to it.
//!
//! Features are level-major, `[L, S, F]`, so that a level's slice of the table stays in cache.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

/// Shape of the table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HashGridConfig {
    pub levels: usize,
    /// Features per row: 1, 2, 4 or 8.
    pub features: usize,
    /// `log2` of the most rows that a level may have.
    pub log2_size: u32,
    /// Cells per axis at the coarsest level.
    pub base: u32,
    /// Cells per axis at the finest level.
    pub finest: u32,
}

/// One level of the grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level {
    /// Cells per axis, `N_l`.
    pub cells: u32,
    /// Whether rows are indexed directly instead of hashed.
    pub dense: bool,
    /// First row in the table.
    pub offset: usize,
    /// Rows of this level, a multiple of 16.
    pub rows: usize,
}

/// A grid with its levels laid out.
#[derive(Clone, Debug, PartialEq)]
pub struct HashGrid {
    pub config: HashGridConfig,
    pub levels: Vec<Level>,
}

impl HashGrid {
    /// # Panics
    /// When the configuration is degenerate (no levels, features not in {1, 2, 4, 8}, `log2_size` not in 4..=28).
    pub fn new(config: HashGridConfig) -> HashGrid {
        assert!(config.levels > 0 && [1, 2, 4, 8].contains(&config.features), "bad hash grid {config:?}");
        assert!((4..=28).contains(&config.log2_size) && config.base > 0, "bad hash grid {config:?}");
        let growth =
            if config.levels > 1 { (config.finest as f64 / config.base as f64).powf(1.0 / (config.levels - 1) as f64) } else { 1.0 };
        let mut offset = 0;
        let levels = (0..config.levels)
            .map(|l| {
                // The small addend keeps the finest level at exactly `finest` cells.
                let cells = (config.base as f64 * growth.powi(l as i32) + 1e-6).floor() as u32;
                let vertices = (cells as u64 + 1).pow(3);
                let dense = vertices <= 1 << config.log2_size;
                let rows = if dense { (vertices as usize).next_multiple_of(16) } else { 1 << config.log2_size };
                let level = Level { cells, dense, offset, rows };
                offset += rows;
                level
            })
            .collect();
        HashGrid { config, levels }
    }

    /// Rows of the whole table.
    pub fn rows(&self) -> usize {
        self.levels.last().map_or(0, |l| l.offset + l.rows)
    }

    /// Numbers in the table, `rows · F`.
    pub fn params_len(&self) -> usize {
        self.rows() * self.config.features
    }

    /// Numbers that a point is encoded to, `L · F`.
    pub fn output_dims(&self) -> usize {
        self.levels.len() * self.config.features
    }
}

impl Level {
    /// Row of vertex (x, y, z) within the level.
    #[inline(always)]
    pub fn row(&self, x: u32, y: u32, z: u32) -> usize {
        if self.dense {
            let n = self.cells as usize + 1;
            x as usize + n * (y as usize + n * z as usize)
        } else {
            let h = x ^ y.wrapping_mul(2_654_435_761) ^ z.wrapping_mul(805_459_861);
            h as usize & (self.rows - 1)
        }
    }
}
