//! Plain loops in f64, cell by cell.

use super::{OccupancyGrid, UNKNOWN};
use diorama_geom::rng::Rng;

/// Cascade and coordinates of a cell.
fn place(grid: &OccupancyGrid, cell: usize) -> (usize, [usize; 3]) {
    let n = grid.bits.resolution;
    (cell / n.pow(3), [cell % n, cell / n % n, cell / n / n % n])
}

fn cell_of(grid: &OccupancyGrid, cascade: usize, at: [usize; 3]) -> usize {
    let n = grid.bits.resolution;
    ((cascade * n + at[2]) * n + at[1]) * n + at[0]
}

/// Points `[count, 3]` and cells `[count]` as [`OccupancyGrid::probe`] draws them.
pub fn probe(grid: &OccupancyGrid, rng: &Rng, counter: u64, count: usize, block: usize) -> (Vec<f64>, Vec<u32>) {
    let (mut points, mut cells) = (Vec::new(), Vec::new());
    for i in 0..count as u64 {
        let first = (counter * count as u64 + i) * 4;
        let drawn = grid.live[rng.below(first, grid.live.len() as u64) as usize];
        let (cascade, at) = place(grid, drawn as usize);
        let size = 2f64.powi(cascade as i32);
        let corner = at.map(|v| v / block * block);
        for (k, corner) in (1..).zip(corner) {
            let along = corner as f64 + block as f64 * rng.uniform(first + k) as f64;
            points.push(0.5 - 0.5 * size + along * size / grid.bits.resolution as f64);
        }
        cells.push(cell_of(grid, cascade, corner) as u32);
    }
    (points, cells)
}

/// A grid after an update.
pub struct Updated {
    pub density: Vec<f64>,
    pub occupied: Vec<bool>,
}

/// What an update makes of a grid, given densities `met` in cells and densities `probed` for blocks of `block³` cells that begin at cells.
pub fn update(grid: &OccupancyGrid, met: &[(u32, f32)], probed: &[(u32, f32)], block: usize) -> Updated {
    let mut fresh: Vec<f64> = grid.fresh.iter().map(|f| *f as f64).collect();
    let mut note = |cell: usize, sigma: f32| {
        if sigma >= 0.0 {
            fresh[cell] = fresh[cell].max((sigma as f64).max(f32::MIN_POSITIVE as f64));
        }
    };
    met.iter().for_each(|(cell, sigma)| note(*cell as usize, *sigma));
    for (cell, sigma) in probed {
        let (cascade, at) = place(grid, *cell as usize);
        for k in 0..block.pow(3) {
            note(cell_of(grid, cascade, [at[0] + k % block, at[1] + k / block % block, at[2] + k / block / block]), *sigma);
        }
    }
    let fold = |(d, f): (&f32, &f64)| match *d {
        d if *f == 0.0 || d < 0.0 => d as f64,
        UNKNOWN => *f,
        d => (d as f64 * grid.decay as f64).max(*f),
    };
    let density: Vec<f64> = grid.density.iter().zip(&fresh).map(fold).collect();
    let mut occupied = Vec::new();
    for (most, own) in grid.thresholds.iter().zip(density.chunks(grid.bits.resolution.pow(3))) {
        let known: Vec<f64> = own.iter().copied().filter(|d| *d >= 0.0 && *d != UNKNOWN as f64).collect();
        let mean = known.iter().sum::<f64>() / known.len().max(1) as f64;
        occupied.extend(own.iter().map(|d| *d > mean.min(*most as f64)));
    }
    cover(grid, &mut occupied);
    Updated { density, occupied }
}

/// Cells of a coarser cascade that a finer one covers are occupied where one of its eight finer cells is.
fn cover(grid: &OccupancyGrid, occupied: &mut [bool]) {
    let n = grid.bits.resolution;
    for cell in n.pow(3)..occupied.len() {
        let (cascade, at) = place(grid, cell);
        if at.iter().all(|v| (n / 4..3 * n / 4).contains(v)) {
            let finer = |k: usize| cell_of(grid, cascade - 1, [0, 1, 2].map(|a| 2 * (at[a] - n / 4) + (k >> a & 1)));
            occupied[cell] = (0..8).any(|k| occupied[finer(k)]);
        }
    }
}
