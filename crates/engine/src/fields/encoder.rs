//! Encodings of position, which a field's network reads instead of coordinates.

use crate::params::ParamGroup;
use diorama_kernels::ops::field_step::{BlockEncoding, Positions};
use diorama_kernels::ops::frequency::{self, Frequency};
use diorama_kernels::ops::hash_grid::{self, HashGrid};
use diorama_kernels::ops::triangle_wave;
use diorama_kernels::ops::trilinear_corner_grid::{self as corner_grid, Corners};

/// An encoding of positions. Learned encodings hold their table.
#[derive(Clone, Debug)]
pub enum Encoder {
    /// Multiresolution hash grid over the field's space as `[0, 1]³` (Müller et al. 2022).
    Hash { grid: HashGrid, table: ParamGroup },
    /// Sines and cosines over the field's space as `[−1, 1]³` (Mildenhall et al. 2020).
    Frequency(Frequency),
    /// Triangle waves of as many bands over the field's space as `[−1, 1]³`.
    TriangleWave { bands: usize },
    /// Features at the corners of occupied voxels over the field's space as `[0, 1]³` (Hao et al. 2021).
    VoxelCorners { grid: VoxelGrid, table: ParamGroup },
}

/// Occupied voxels of a cube, and the rows of a feature table at their corners.
#[derive(Clone, Debug, PartialEq)]
pub struct VoxelGrid {
    pub resolution: usize,
    /// Features per corner.
    pub features: usize,
    /// Voxel of each cell, `[resolution³]`, x fastest; voxel 0 stands for all that is empty.
    cells: Vec<u32>,
    /// Rows of each voxel's corners, `[voxels, 8]`; row 0 belongs to voxel 0.
    rows: Vec<u32>,
    table_rows: usize,
}

impl VoxelGrid {
    /// Voxels where `is_occupied(x, y, z)`; neighbors share the rows of their corners.
    pub fn new(resolution: usize, features: usize, is_occupied: impl Fn(usize, usize, usize) -> bool) -> VoxelGrid {
        let edge = resolution + 1;
        let (mut cells, mut rows, mut of_corner) = (vec![0; resolution.pow(3)], vec![0; 8], vec![0u32; edge.pow(3)]);
        let mut count = 1;
        for i in 0..cells.len() {
            let (x, y, z) = (i % resolution, i / resolution % resolution, i / resolution / resolution);
            if !is_occupied(x, y, z) {
                continue;
            }
            cells[i] = (rows.len() / 8) as u32;
            for c in 0..8 {
                let at = ((z + (c >> 2 & 1)) * edge + y + (c >> 1 & 1)) * edge + x + (c & 1);
                if of_corner[at] == 0 {
                    of_corner[at] = count;
                    count += 1;
                }
                rows.push(of_corner[at]);
            }
        }
        VoxelGrid { resolution, features, cells, rows, table_rows: count as usize }
    }

    /// Numbers in the table, a multiple of a sparse group's line.
    pub fn params_len(&self) -> usize {
        (self.table_rows * self.features).next_multiple_of(16)
    }

    /// Voxel of each cell, `[resolution³]`, x fastest; voxel 0 stands for all that is empty.
    pub fn cells(&self) -> &[u32] {
        &self.cells
    }

    /// Rows of the voxels' corners, `[voxels, 8]`.
    pub fn rows(&self) -> &[u32] {
        &self.rows
    }

    /// Voxels `[N]` of points `[N, 3]` of `[0, 1]³`, and where in them the points lie, `[N, 3]`.
    pub fn locate(&self, unit: &[f32]) -> (Vec<u32>, Vec<f32>) {
        let n = self.resolution;
        let (mut voxels, mut local) = (Vec::with_capacity(unit.len() / 3), Vec::with_capacity(unit.len()));
        for p in unit.chunks_exact(3) {
            let scaled = [0, 1, 2].map(|k| p[k].clamp(0.0, 1.0) * n as f32);
            let cell = scaled.map(|v| (v as usize).min(n - 1));
            voxels.push(self.cells[(cell[2] * n + cell[1]) * n + cell[0]]);
            local.extend((0..3).map(|k| scaled[k] - cell[k] as f32));
        }
        (voxels, local)
    }
}

/// Samples as a field's network reads them.
#[derive(Clone, Debug, Default)]
pub struct Encoded {
    /// Positions in the encoder's coordinates, `[S, 3]`.
    pub unit: Vec<f32>,
    /// Level-major features `[L, S, F]` of encoders with a table; training replaces them by their gradients.
    pub features: Vec<f32>,
}

impl Encoder {
    /// Numbers per position.
    pub fn dims(&self) -> usize {
        match self {
            Encoder::Hash { grid, .. } => grid.output_dims(),
            Encoder::Frequency(f) => f.output_dims(),
            Encoder::TriangleWave { bands } => 3 * bands,
            Encoder::VoxelCorners { grid, .. } => grid.features,
        }
    }

    /// Whether the encoder's coordinates are `[−1, 1]³`, else `[0, 1]³`.
    pub fn is_centered(&self) -> bool {
        matches!(self, Encoder::Frequency(_) | Encoder::TriangleWave { .. })
    }

    /// Levels and features per level of encoders with a table; none: positions are encoded block by block.
    pub fn levels(&self) -> Option<(usize, usize)> {
        match self {
            Encoder::Hash { grid, .. } => Some((grid.levels.len(), grid.config.features)),
            Encoder::VoxelCorners { grid, .. } => Some((1, grid.features)),
            _ => None,
        }
    }

    pub fn table(&self) -> Option<&ParamGroup> {
        match self {
            Encoder::Hash { table, .. } | Encoder::VoxelCorners { table, .. } => Some(table),
            _ => None,
        }
    }

    pub fn table_mut(&mut self) -> Option<&mut ParamGroup> {
        match self {
            Encoder::Hash { table, .. } | Encoder::VoxelCorners { table, .. } => Some(table),
            _ => None,
        }
    }

    /// A copy of the values alone, for rendering; it cannot be trained.
    pub fn for_rendering(&self) -> Encoder {
        match self {
            Encoder::Hash { grid, table } => Encoder::Hash { grid: grid.clone(), table: table.values_only() },
            Encoder::VoxelCorners { grid, table } => Encoder::VoxelCorners { grid: grid.clone(), table: table.values_only() },
            other => other.clone(),
        }
    }

    /// Reads the features of `unit` from the table, where there is one.
    pub fn forward(&self, unit: &[f32], features: &mut Vec<f32>) {
        features.resize(if self.levels().is_some() { unit.len() / 3 * self.dims() } else { 0 }, 0.0);
        match self {
            Encoder::Hash { grid, table } => hash_grid::cpu::forward(grid, unit, &table.values, features),
            Encoder::VoxelCorners { grid, table } => {
                let (voxel, local) = grid.locate(unit);
                let corners = Corners { rows: &grid.rows, voxel: &voxel };
                corner_grid::cpu::forward(&corners, &local, &table.values, grid.features, features);
            }
            Encoder::Frequency(_) | Encoder::TriangleWave { .. } => {}
        }
    }

    /// Rows `[n, dims]` of the samples from `first` on, as the network reads them.
    pub(super) fn rows(&self, encoded: &Encoded, first: usize, out: &mut [f32]) {
        let (dims, total) = (self.dims(), encoded.unit.len() / 3);
        let points = || &encoded.unit[first * 3..(first + out.len() / dims) * 3];
        match self {
            Encoder::Frequency(f) => frequency::cpu::forward(f, points(), out),
            Encoder::TriangleWave { bands } => triangle_wave::cpu::forward(3, *bands, points(), out),
            Encoder::Hash { .. } | Encoder::VoxelCorners { .. } => {
                let (levels, f) = self.levels().expect("an encoder with a table");
                for l in 0..levels {
                    let level = &encoded.features[(l * total + first) * f..];
                    for (row, v) in out.chunks_exact_mut(dims).zip(level.chunks_exact(f)) {
                        row[l * f..(l + 1) * f].copy_from_slice(v);
                    }
                }
            }
        }
    }

    /// Samples at `unit` with the table's `features` as the fused step takes them; `d_points` receives gradients of positions that are encoded there, and features of a
    /// table are replaced by their gradients if those are `wanted`.
    pub fn positions<'a>(&self, unit: &'a [f32], features: &'a mut [f32], d_points: Option<&'a mut [f32]>, wanted: bool) -> Positions<'a> {
        let in_block = match self {
            Encoder::Frequency(f) => BlockEncoding::Frequency(*f),
            Encoder::TriangleWave { bands } => BlockEncoding::TriangleWave { bands: *bands },
            Encoder::Hash { grid, .. } => {
                return Positions::Features { data: features, levels: grid.levels.len(), width: grid.config.features, wanted };
            }
            Encoder::VoxelCorners { grid, .. } => {
                return Positions::Features { data: features, levels: 1, width: grid.features, wanted };
            }
        };
        Positions::Encoded { encoding: in_block, points: unit, d_points }
    }

    /// Adds to the table's gradient that of the features, unless it is frozen.
    pub fn backward(&mut self, encoded: &Encoded) {
        match self {
            Encoder::Hash { grid, table } if !table.frozen => {
                hash_grid::cpu::backward(grid, &encoded.unit, &encoded.features, &mut table.grads, Some(&mut table.touched));
            }
            Encoder::VoxelCorners { grid, table } if !table.frozen => {
                let (voxel, local) = grid.locate(&encoded.unit);
                let corners = Corners { rows: &grid.rows, voxel: &voxel };
                let mut unread = vec![0.0; local.len()];
                corner_grid::cpu::backward(
                    &corners,
                    &local,
                    &table.values,
                    grid.features,
                    &encoded.features,
                    &mut unread,
                    &mut table.grads,
                );
                // What is empty stays so.
                table.grads[..grid.features].fill(0.0);
                table.touch();
            }
            _ => {}
        }
    }

    /// Gradients `[S, 3]` of `unit` from those of the features, overwritten.
    pub fn positions_backward(&self, encoded: &Encoded, d_unit: &mut [f32]) {
        match self {
            Encoder::Hash { grid, table } => {
                hash_grid::cpu::backward_positions(grid, &encoded.unit, &table.values, &encoded.features, d_unit);
            }
            Encoder::VoxelCorners { grid, table } => {
                let (voxel, local) = grid.locate(&encoded.unit);
                let corners = Corners { rows: &grid.rows, voxel: &voxel };
                let mut unread = vec![0.0; table.values.len()];
                corner_grid::cpu::backward(&corners, &local, &table.values, grid.features, &encoded.features, d_unit, &mut unread);
                d_unit.iter_mut().for_each(|d| *d *= grid.resolution as f32);
            }
            Encoder::Frequency(_) | Encoder::TriangleWave { .. } => {}
        }
    }
}
