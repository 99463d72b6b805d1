//! Cases of the op, for its tests and for `bench check`.

use super::{OccupancyGrid, UNKNOWN, UNSEEN, reference};
#[cfg(feature = "gpu")]
use crate::{
    gpu::{Gpu, GpuError, Rows, table::Table},
    ops::march::gpu::Space,
    ops::march::{OccupancyBits, gpu::GpuOccupancy},
    ops::occupancy_update::gpu::GpuOccupancyGrid,
};
use diorama_geom::rng::Rng;
use diorama_testkit::{random, random_unit};

/// Points of an update.
pub const POINTS: usize = 3000;

/// Grids of which nothing is known yet, with a corner that is never sampled.
pub fn grids() -> Vec<OccupancyGrid> {
    let of = |thresholds: Vec<f32>| {
        let mut grid = OccupancyGrid::new(16, thresholds);
        grid.density[..40].fill(UNSEEN);
        grid.refresh();
        grid
    };
    [vec![6.0], vec![6.0; 3], vec![6.0, 3.0, 1.5]].map(of).into()
}

/// Updates one after the other: what is drawn, and what it finds.
pub struct Update {
    pub rng: Rng,
    pub counter: u64,
    /// Edge of the blocks that share a point.
    pub block: usize,
    /// Densities at the points.
    pub probed: Vec<f32>,
    /// Densities of samples that lie in the same cells, the last one first; some are negative.
    pub met: Vec<f32>,
}

pub fn updates() -> Vec<Update> {
    let of = |(counter, block): (u64, usize)| Update {
        rng: Rng::new(5, 6),
        counter,
        block,
        // Every seventh is exactly 0, which counts as looked at.
        probed: random_unit(POINTS, counter + 1).iter().zip(0..).map(|(u, i)| if i % 7 == 0 { 0.0 } else { u * u * 20.0 }).collect(),
        met: random(POINTS, counter + 2).iter().map(|s| s * 9.0).collect(),
    };
    [(0, 2), (16, 2), (1 << 30, 1)].map(of).into()
}

impl Update {
    /// The grid after the update, given the cells that are probed.
    pub fn want(&self, grid: &OccupancyGrid, cells: &[u32]) -> reference::Updated {
        let met: Vec<(u32, f32)> = cells.iter().rev().copied().zip(self.met.iter().copied()).collect();
        let probed: Vec<(u32, f32)> = cells.iter().copied().zip(self.probed.iter().copied()).collect();
        reference::update(grid, &met, &probed, self.block)
    }

    /// The same on the CPU.
    pub fn apply(&self, grid: &mut OccupancyGrid, cells: &[u32]) {
        grid.record(&cells.iter().rev().copied().collect::<Vec<u32>>(), &self.met);
        grid.update(cells, &self.probed, self.block);
    }
}

/// Densities with −2 for what was not sampled yet, whose number would swamp all errors.
pub fn comparable(density: impl IntoIterator<Item = f64>) -> Vec<f64> {
    density.into_iter().map(|d| if d == UNKNOWN as f64 { -2.0 } else { d }).collect()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    const OP: &str = "occupancy update";
    for mut grid in grids() {
        let on_gpu = GpuOccupancyGrid::upload(gpu, &grid);
        for u in updates() {
            let shape = format!("cascades={} {:?} step {} block {}", grid.bits.cascades, grid.thresholds, u.counter, u.block);
            let (points, cells) = reference::probe(&grid, &u.rng, u.counter, POINTS, u.block);
            let (points_gpu, cells_gpu) = on_gpu.probe(gpu, &u.rng, u.counter, POINTS, u.block, Space::Model);
            table.close(OP, "points", &shape, &points_gpu, &points)?;
            table.equal(OP, "cells", &shape, &cells_gpu, &cells)?;
            let want = u.want(&grid, &cells);
            let met: Vec<u32> = cells.iter().rev().copied().collect();
            on_gpu.record(gpu, &Rows::all(gpu, POINTS), &gpu.upload(&met), &gpu.upload(&u.met));
            on_gpu.update(gpu, &cells_gpu, &gpu.upload(&u.probed), u.block);
            let density = comparable(on_gpu.read(gpu)?.0.iter().map(|d| *d as f64));
            let density: Vec<f32> = density.iter().map(|d| *d as f32).collect();
            table.close(OP, "densities", &shape, &gpu.upload(&density), &comparable(want.density))?;
            let mut bits = OccupancyBits::full(grid.bits.resolution, grid.bits.cascades);
            bits.fill_with(|cell| want.occupied[cell]);
            let wrong = on_gpu.bits.differences(gpu, &GpuOccupancy::upload(gpu, &bits))?;
            table.row(OP, "bits", shape, if wrong == 0 { Ok(0.0) } else { Err(format!("{wrong} words differ")) });
            u.apply(&mut grid, &cells);
        }
    }
    Ok(())
}
