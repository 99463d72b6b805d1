//! One unit per point, cell or word of bits.

use super::{OccupancyGrid, UNKNOWN};
use crate::gpu::random::{Wide, below, halves, key, product, sum, uniform, widened};
use crate::gpu::{Buffer, Gpu, GpuError, Rows, launch};
use crate::ops::march::gpu::{GpuOccupancy, Space, put};
use cubecl::prelude::*;
use diorama_geom::rng::Rng;

/// Parts in which densities are summed.
const PARTS: usize = 1024;

/// [`OccupancyGrid`] on the device.
pub struct GpuOccupancyGrid {
    /// What marching reads.
    pub bits: GpuOccupancy,
    /// Decayed maximum density per cell; negative: never occupied; the greatest number: not sampled yet.
    density: Buffer,
    /// Bits of the highest density met since the last update; they order as the densities do.
    fresh: Buffer<u32>,
    /// Cells that are sampled.
    live: Buffer<u32>,
    decay: f32,
    /// Density above which a cell of each cascade is occupied, unless the cascade's mean is lower.
    thresholds: Buffer,
}

impl GpuOccupancyGrid {
    pub fn upload(gpu: &Gpu, grid: &OccupancyGrid) -> Self {
        GpuOccupancyGrid {
            bits: GpuOccupancy::upload(gpu, &grid.bits),
            density: gpu.upload(&grid.density),
            fresh: gpu.upload(&grid.fresh).cast(),
            live: gpu.upload(&grid.live),
            decay: grid.decay,
            thresholds: gpu.upload(&grid.thresholds),
        }
    }

    /// Densities and what was met since the last update.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn read(&self, gpu: &Gpu) -> Result<(Vec<f32>, Vec<f32>), GpuError> {
        Ok((gpu.read(&self.density)?, gpu.read(&self.fresh.cast())?))
    }

    /// [`OccupancyGrid::record`] for some rows.
    pub fn record(&self, gpu: &Gpu, rows: &Rows, cells: &Buffer<u32>, sigma: &Buffer) {
        self.note(gpu, rows, cells, sigma, 1);
    }

    /// [`GpuOccupancyGrid::record`] for blocks of `block³` cells that begin at the given ones.
    fn note(&self, gpu: &Gpu, rows: &Rows, cells: &Buffer<u32>, sigma: &Buffer, block: usize) {
        launch!(
            gpu,
            highest,
            rows.most * block.pow(3),
            [rows.live => rows.at + 1, cells => rows.most, sigma => rows.most, self.fresh => self.density.len()],
            rows.place(),
            block as u32,
            self.bits.resolution as u32,
        );
    }

    /// Random points `[count, 3]` of live cells in a field's coordinates, and the cells `[count]`; where blocks of
    /// `block³` cells share a point, the block's first cell.
    pub fn probe(&self, gpu: &Gpu, rng: &Rng, counter: u64, count: usize, block: usize, space: Space) -> (Buffer, Buffer<u32>) {
        let (points, cells) = (gpu.empty(count * 3), gpu.empty(count));
        let ((key_high, key_low), (high, low)) = (key(rng), halves(counter.wrapping_mul(count as u64).wrapping_mul(4)));
        let (kind, width) = space.arg();
        if count > 0 && !self.live.is_empty() {
            launch!(
                gpu,
                probe,
                count,
                [self.live => self.live.len(), points => count * 3, cells => count],
                count as u32,
                self.live.len() as u32,
                self.bits.resolution as u32,
                block as u32,
                key_high,
                key_low,
                high,
                low,
                width,
                kind,
            );
        }
        (points, cells)
    }

    /// Folds in the densities `[count]` of probed cells and all that was met, and decides anew about every cell.
    pub fn update(&self, gpu: &Gpu, cells: &Buffer<u32>, sigma: &Buffer, block: usize) {
        if self.live.is_empty() {
            return;
        }
        self.note(gpu, &Rows::all(gpu, cells.len()), cells, sigma, block);
        let (n, cascades, cells) = (self.bits.resolution, self.bits.cascades, self.density.len());
        let parts = PARTS * cascades;
        let (sums, counts, limits) = (gpu.empty(parts), gpu.empty(parts), gpu.empty(cascades));
        launch!(
            gpu,
            fold,
            parts,
            [self.density => cells, self.fresh => cells, sums => parts, counts => parts],
            PARTS as u32,
            parts as u32,
            (cells / cascades) as u32,
            self.decay,
        );
        launch!(
            gpu,
            decide,
            ([1; 3], CubeDim::new_1d(1)),
            [sums => parts, counts => parts, self.thresholds => cascades, limits => cascades],
            PARTS as u32,
            cascades as u32,
        );
        let words = cells / 32;
        launch!(
            gpu,
            occupy,
            words,
            [self.density => cells, limits => cascades, self.bits.bits => words],
            words as u32,
            (words / cascades) as u32,
        );
        for c in 1..cascades {
            launch!(gpu, pool, n.pow(3) / 32, [self.bits.bits => words], c as u32, n as u32);
        }
        let blocks = self.bits.blocks.len();
        launch!(gpu, summarize, blocks, [self.bits.bits => words, self.bits.blocks => blocks], blocks as u32, n as u32);
    }
}

#[cube(launch_unchecked)]
fn highest(live: &[u32], cells: &[u32], sigma: &[f32], fresh: &[Atomic<u32>], at: u32, block: u32, resolution: u32) {
    let unit = ABSOLUTE_POS;
    let b = block as usize;
    let n = resolution as usize;
    let row = unit / (b * b * b);
    if row >= live[at as usize] as usize {
        terminate!();
    }
    let k = unit % (b * b * b);
    if sigma[row] >= 0.0 {
        let cell = cells[row] as usize + k % b + n * (k / b % b) + n * n * (k / b / b);
        // A density of 0 differs from an untouched cell.
        fresh[cell].fetch_max(u32::reinterpret(max(sigma[row], f32::MIN_POSITIVE)));
    }
}

#[cube(launch_unchecked)]
fn probe(
    live: &[u32],
    points: &mut [f32],
    cells: &mut [u32],
    count: u32,
    live_count: u32,
    resolution: u32,
    block: u32,
    key_high: u32,
    key_low: u32,
    high: u32,
    low: u32,
    width: f32,
    #[comptime] kind: u32,
) {
    let i = ABSOLUTE_POS;
    if i >= count as usize {
        terminate!();
    }
    let key = Wide { high: key_high, low: key_low };
    let base = sum(&Wide { high, low }, &product(&widened(u32::cast_from(i)), &widened(4u32)));
    let n = resolution;
    let at = live[below(&key, &base, live_count) as usize];
    let cascade = at / (n * n * n);
    let x = at % n / block * block;
    let y = at / n % n / block * block;
    let z = at / (n * n) % n / block * block;
    let mut size = 1.0f32;
    for _ in 0..cascade {
        size *= 2.0;
    }
    let edge = f32::cast_from(block);
    let scale = f32::cast_from(n);
    let first = 0.5 - 0.5 * size;
    let px = first + (f32::cast_from(x) + uniform(&key, &sum(&base, &widened(1u32))) * edge) * size / scale;
    let py = first + (f32::cast_from(y) + uniform(&key, &sum(&base, &widened(2u32))) * edge) * size / scale;
    let pz = first + (f32::cast_from(z) + uniform(&key, &sum(&base, &widened(3u32))) * edge) * size / scale;
    put(points, i * 3, px, py, pz, width, kind);
    cells[i] = ((cascade * n + z) * n + y) * n + x;
}

#[cube(launch_unchecked)]
fn fold(density: &mut [f32], fresh: &mut [u32], sums: &mut [f32], counts: &mut [u32], parts: u32, all_parts: u32, cells: u32, decay: f32) {
    let unit = ABSOLUTE_POS;
    if unit >= all_parts as usize {
        terminate!();
    }
    let mut total = 0.0f32;
    let mut known = 0u32;
    // Neighbouring units read neighbouring cells.
    let first = unit / parts as usize * cells as usize;
    let mut i = first + unit % parts as usize;
    while i < first + cells as usize {
        let mut d = density[i];
        let f = f32::reinterpret(fresh[i]);
        if f > 0.0 && d >= 0.0 {
            if d == UNKNOWN {
                d = f;
            } else {
                d = max(d * decay, f);
            }
            density[i] = d;
        }
        fresh[i] = 0u32;
        if d >= 0.0 && d != UNKNOWN {
            total += d;
            known += 1;
        }
        i += parts as usize;
    }
    sums[unit] = total;
    counts[unit] = known;
}

/// The threshold of each cascade: the mean of its known densities, but no more than `most`.
#[cube(launch_unchecked)]
fn decide(sums: &[f32], counts: &[u32], most: &[f32], limits: &mut [f32], parts: u32, cascades: u32) {
    for c in 0..cascades as usize {
        let mut total = 0.0f32;
        let mut known = 0u32;
        for i in 0..parts as usize {
            total += sums[c * parts as usize + i];
            known += counts[c * parts as usize + i];
        }
        limits[c] = min(most[c], total / f32::cast_from(max(known, 1u32)));
    }
}

#[cube(launch_unchecked)]
fn occupy(density: &[f32], limits: &[f32], bits: &mut [u32], words: u32, words_per_cascade: u32) {
    let w = ABSOLUTE_POS;
    if w >= words as usize {
        terminate!();
    }
    let limit = limits[w / words_per_cascade as usize];
    let mut word = 0u32;
    for i in 0..32usize {
        if density[w * 32 + i] > limit {
            word |= 1u32 << u32::cast_from(i);
        }
    }
    bits[w] = word;
}

/// Cells of a coarser cascade that a finer one covers are occupied where the finer cells are.
#[cube(launch_unchecked)]
fn pool(bits: &mut [u32], cascade: u32, resolution: u32) {
    let unit = ABSOLUTE_POS;
    let n = resolution as usize;
    if unit >= n * n * n / 32 {
        terminate!();
    }
    let own = cascade as usize * n * n * n / 32;
    let finer = (cascade - 1) as usize * n * n * n / 32;
    let mut word = bits[own + unit];
    for b in 0..32usize {
        let cell = unit * 32 + b;
        let x = cell % n;
        let y = cell / n % n;
        let z = cell / n / n;
        let low = n / 4;
        let high = n / 4 * 3;
        if x >= low && x < high && y >= low && y < high && z >= low && z < high {
            let mut any = 0u32;
            for k in 0..8usize {
                let fx = 2 * (x - low) + k % 2;
                let fy = 2 * (y - low) + k / 2 % 2;
                let fz = 2 * (z - low) + k / 4;
                let at = (fz * n + fy) * n + fx;
                any |= (bits[finer + at / 32] >> u32::cast_from(at % 32)) & 1;
            }
            let bit = u32::cast_from(b);
            word = (word & !(1u32 << bit)) | (any << bit);
        }
    }
    bits[own + unit] = word;
}

#[cube(launch_unchecked)]
fn summarize(bits: &[u32], blocks: &mut [u32], count: u32, resolution: u32) {
    let unit = ABSOLUTE_POS;
    if unit >= count as usize {
        terminate!();
    }
    let n = resolution as usize;
    let side = n / 8;
    let x = unit % side * 8;
    let y = unit / side % side * 8;
    // Cascades follow one another along z.
    let z = unit / side / side * 8;
    let mut any = 0u32;
    for k in 0..64usize {
        let cell = ((z + k / 8) * n + y + k % 8) * n + x;
        any |= (bits[cell / 32] >> u32::cast_from(cell % 32)) & 255;
    }
    blocks[unit] = min(any, 1u32);
}
