//! Parallel over cells; results do not depend on the number of threads.

use super::scatter_max::scatter_max;
use super::{OccupancyGrid, UNKNOWN};
use crate::ops::march::OccupancyBits;
use diorama_geom::rng::Rng;
use rayon::prelude::*;

/// Cells or points per task.
const TASK: usize = 1 << 12;

impl OccupancyGrid {
    /// Recomputes the bits, and which cells are live, from the densities.
    pub fn refresh(&mut self) {
        self.live = (0..self.density.len() as u32).filter(|&i| self.density[i as usize] >= 0.0).collect();
        self.refresh_bits();
    }

    fn refresh_bits(&mut self) {
        let cells = self.bits.resolution.pow(3);
        let limits: Vec<f32> = self
            .thresholds
            .iter()
            .zip(self.density.chunks(cells))
            .map(|(most, own)| {
                let parts: Vec<(f64, usize)> = own.par_chunks(TASK).map(known_sum).collect();
                let (sum, known) = parts.iter().fold((0.0, 0), |a, p| (a.0 + p.0, a.1 + p.1));
                most.min((sum / known.max(1) as f64) as f32)
            })
            .collect();
        let density = &self.density;
        self.bits.fill_with(|cell| density[cell] > limits[cell / cells]);
    }

    /// Notes densities `[N]` that were met in `cells` `[N]`, except negative ones; they count at the next update.
    pub fn record(&mut self, cells: &[u32], sigma: &[f32]) {
        scatter_max(cells, sigma, &mut self.fresh);
    }

    /// Random points `[count, 3]` of live cells, and the first cells `[count]` of the blocks of `block³` cells that they stand for.
    ///
    /// # Panics
    /// When no cell is live.
    pub fn probe(&self, rng: &Rng, counter: u64, count: usize, block: usize) -> (Vec<f32>, Vec<u32>) {
        let n = self.bits.resolution;
        let mut points = vec![0.0; count * 3];
        let mut cells = vec![0u32; count];
        let live = &self.live;
        points.par_chunks_mut(TASK * 3).zip(cells.par_chunks_mut(TASK)).enumerate().for_each(|(task, (points, cells))| {
            for (i, (point, cell)) in points.chunks_exact_mut(3).zip(cells).enumerate() {
                let base = (counter * count as u64 + (task * TASK + i) as u64) * 4;
                let at = live[rng.below(base, live.len() as u64) as usize] as usize;
                let c = at / n.pow(3);
                let (low, size) = OccupancyBits::cube(c);
                let corner = [at % n, at / n % n, at / n / n % n].map(|v| v / block * block);
                for k in 0..3 {
                    let u = rng.uniform(base + 1 + k as u64);
                    point[k] = low + (corner[k] as f32 + u * block as f32) * size / n as f32;
                }
                *cell = (((c * n + corner[2]) * n + corner[1]) * n + corner[0]) as u32;
            }
        });
        (points, cells)
    }

    /// Folds in the densities `[count]` of probed blocks and all that was recorded, and decides anew about every cell.
    pub fn update(&mut self, cells: &[u32], sigma: &[f32], block: usize) {
        for k in 0..block.pow(3) as u32 {
            let (n, b) = (self.bits.resolution as u32, block as u32);
            let offset = k % b + n * (k / b % b) + n * n * (k / b / b);
            let of_block: Vec<u32> = cells.iter().map(|c| c + offset).collect();
            scatter_max(&of_block, sigma, &mut self.fresh);
        }
        let decay = self.decay;
        self.density.par_chunks_mut(TASK).zip(self.fresh.par_chunks_mut(TASK)).for_each(|(density, fresh)| {
            for (d, f) in density.iter_mut().zip(fresh) {
                let looked = *f > 0.0 && *d >= 0.0;
                let folded = if *d == UNKNOWN { *f } else { (*d * decay).max(*f) };
                *d = if looked { folded } else { *d };
                *f = 0.0;
            }
        });
        self.refresh_bits();
    }
}

/// Sum and number of the densities that were ever sampled.
fn known_sum(density: &[f32]) -> (f64, usize) {
    density.iter().filter(|d| **d >= 0.0 && **d != UNKNOWN).fold((0.0, 0), |(s, n), d| (s + *d as f64, n + 1))
}
