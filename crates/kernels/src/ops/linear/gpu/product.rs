//! Products by cubes of 16 × 16 units, each with up to 4 × 4 results of its own, through shared memory.

use super::{MAX_SLICES, Part, SLICE};
use crate::gpu::{Buffer, Gpu, Rows, launch};
use cubecl::prelude::*;

/// Edge of a cube.
const TILE: usize = 16;
/// Most rows of tiles in one launch.
const MAX_TILES: usize = 65_535;

/// Results of a unit along an axis of length `n`.
fn per_unit(n: usize) -> usize {
    if n > 2 * TILE {
        4
    } else if n > TILE {
        2
    } else {
        1
    }
}

/// `A B`, `[M, K] [K, N]`, or with the second factor turned `A Bᵀ`, `[M, K] [N, K]`.
pub(super) fn product(gpu: &Gpu, second_turned: bool, rows: &Rows, (k, n): (usize, usize), a: &Buffer, b: Part, out: Part) {
    let m = rows.most;
    let (mr, nr) = (per_unit(m), per_unit(n));
    let (tiles_m, tiles_n) = (m.div_ceil(TILE * mr), n.div_ceil(TILE * nr));
    launch!(
        gpu,
        multiply,
        ([tiles_n, tiles_m.min(MAX_TILES), tiles_m.div_ceil(MAX_TILES)], CubeDim::new_2d(TILE as u32, TILE as u32)),
        [rows.live => rows.at + 1, a => m * k, b.buffer => b.at + k * n, out.buffer => out.at + m * n],
        rows.place(),
        b.at as u32,
        out.at as u32,
        k as u32,
        n as u32,
        mr,
        nr,
        second_turned,
        gpu.shared,
    );
}

/// `Xᵀ G`, `[K, N]` for X `[M, K]` and G `[M, N]`.
pub(super) fn outer(gpu: &Gpu, rows: &Rows, (k, n): (usize, usize), x: &Buffer, g: &Buffer, out: Part) {
    let slices = (rows.most / SLICE).clamp(1, MAX_SLICES);
    let parts = gpu.empty(slices * k * n);
    let (kr, nr) = (per_unit(k), per_unit(n));
    launch!(
        gpu,
        gather,
        ([n.div_ceil(TILE * nr), k.div_ceil(TILE * kr), slices], CubeDim::new_2d(TILE as u32, TILE as u32)),
        [rows.live => rows.at + 1, x => rows.most * k, g => rows.most * n, parts => slices * k * n],
        rows.place(),
        k as u32,
        n as u32,
        slices as u32,
        kr,
        nr,
        gpu.shared,
    );
    super::add_up(gpu, &parts, slices, k * n, out);
}

#[cube(launch_unchecked)]
fn multiply(
    live: &[u32],
    a: &[f32],
    b: &[f32],
    out: &mut [f32],
    at: u32,
    b_at: u32,
    out_at: u32,
    k: u32,
    n: u32,
    #[comptime] mr: usize,
    #[comptime] nr: usize,
    #[comptime] second_turned: bool,
    #[comptime] shared: bool,
) {
    let m = live[at as usize] as usize;
    let k = k as usize;
    let n = n as usize;
    let b_at = b_at as usize;
    let first = (CUBE_POS_Y as usize + CUBE_POS_Z as usize * 65_535usize) * comptime!(16 * mr);
    if first >= m {
        terminate!();
    }
    let row = first + UNIT_POS_Y as usize;
    let col = CUBE_POS_X as usize * comptime!(16 * nr) + UNIT_POS_X as usize;
    let mut sums = Array::<f32>::new(comptime!(mr * nr));
    #[unroll]
    for e in 0..comptime!(mr * nr) {
        sums[e] = 0.0;
    }
    if comptime!(shared) {
        multiply_shared(a, b, &mut sums, b_at, row, col, m, k, n, mr, nr, second_turned);
    } else {
        multiply_directly(a, b, &mut sums, b_at, row, col, m, k, n, mr, nr, second_turned);
    }
    #[unroll]
    for i in 0..mr {
        #[unroll]
        for j in 0..nr {
            if row + i * 16 < m && col + j * 16 < n {
                out[out_at as usize + (row + i * 16) * n + col + j * 16] = sums[i * nr + j];
            }
        }
    }
}

/// Sums of a unit, with the factors brought to shared memory tile by tile.
#[cube]
fn multiply_shared(
    a: &[f32],
    b: &[f32],
    sums: &mut Array<f32>,
    b_at: usize,
    row: usize,
    col: usize,
    m: usize,
    k: usize,
    n: usize,
    #[comptime] mr: usize,
    #[comptime] nr: usize,
    #[comptime] second_turned: bool,
) {
    let tx = UNIT_POS_X as usize;
    let ty = UNIT_POS_Y as usize;
    let mut left = Array::<f32>::new(mr);
    let mut right = Array::<f32>::new(nr);
    let mut lefts = Shared::<[f32]>::new_slice(comptime!(256 * mr));
    let mut rights = Shared::<[f32]>::new_slice(comptime!(256 * nr));
    for step in 0..k.div_ceil(16usize) {
        let ka = step * 16usize + tx;
        let kb = step * 16usize + ty;
        #[unroll]
        for i in 0..mr {
            let r = row + i * 16;
            let mut v = 0.0f32;
            if r < m && ka < k {
                v = a[r * k + ka];
            }
            lefts[(ty + i * 16) * 16usize + tx] = v;
        }
        #[unroll]
        for j in 0..nr {
            let c = col + j * 16;
            let mut v = 0.0f32;
            if kb < k && c < n {
                v = right_factor(b, b_at, kb, c, k, n, second_turned);
            }
            rights[ty * comptime!(16 * nr) + tx + j * 16] = v;
        }
        sync_cube();
        for p in 0..16usize {
            #[unroll]
            for i in 0..mr {
                left[i] = lefts[(ty + i * 16) * 16usize + p];
            }
            #[unroll]
            for j in 0..nr {
                right[j] = rights[p * comptime!(16 * nr) + tx + j * 16];
            }
            add_outer(sums, &left, &right, mr, nr);
        }
        sync_cube();
    }
}

/// The same from the device's memory.
#[cube]
fn multiply_directly(
    a: &[f32],
    b: &[f32],
    sums: &mut Array<f32>,
    b_at: usize,
    row: usize,
    col: usize,
    m: usize,
    k: usize,
    n: usize,
    #[comptime] mr: usize,
    #[comptime] nr: usize,
    #[comptime] second_turned: bool,
) {
    let mut left = Array::<f32>::new(mr);
    let mut right = Array::<f32>::new(nr);
    for p in 0..k {
        #[unroll]
        for i in 0..mr {
            left[i] = a[min(row + i * 16, m - 1) * k + p];
        }
        #[unroll]
        for j in 0..nr {
            right[j] = right_factor(b, b_at, p, min(col + j * 16, n - 1), k, n, second_turned);
        }
        add_outer(sums, &left, &right, mr, nr);
    }
}

#[cube]
fn right_factor(b: &[f32], at: usize, i: usize, col: usize, k: usize, n: usize, #[comptime] turned: bool) -> f32 {
    if comptime!(turned) { b[at + col * k + i] } else { b[at + i * n + col] }
}

/// `sums += left rightᵀ`
#[cube]
pub(crate) fn add_outer(sums: &mut Array<f32>, left: &Array<f32>, right: &Array<f32>, #[comptime] mr: usize, #[comptime] nr: usize) {
    #[unroll]
    for i in 0..mr {
        #[unroll]
        for j in 0..nr {
            sums[i * nr + j] += left[i] * right[j];
        }
    }
}

/// A slice's part of `Xᵀ G`.
#[cube(launch_unchecked)]
fn gather(
    live: &[u32],
    x: &[f32],
    g: &[f32],
    parts: &mut [f32],
    at: u32,
    k: u32,
    n: u32,
    slices: u32,
    #[comptime] kr: usize,
    #[comptime] nr: usize,
    #[comptime] shared: bool,
) {
    let m = live[at as usize] as usize;
    let k = k as usize;
    let n = n as usize;
    let first_row = CUBE_POS_Y as usize * comptime!(16 * kr);
    let row = first_row + UNIT_POS_Y as usize;
    let col = CUBE_POS_X as usize * comptime!(16 * nr) + UNIT_POS_X as usize;
    let per = m.div_ceil(slices as usize);
    let first = min(CUBE_POS_Z as usize * per, m);
    let end = min(first + per, m);
    let mut sums = Array::<f32>::new(comptime!(kr * nr));
    #[unroll]
    for e in 0..comptime!(kr * nr) {
        sums[e] = 0.0;
    }
    if comptime!(shared) {
        gather_shared(x, g, &mut sums, first, end, first_row, col, k, n, kr, nr);
    } else {
        let mut left = Array::<f32>::new(kr);
        let mut right = Array::<f32>::new(nr);
        for i in first..end {
            #[unroll]
            for e in 0..kr {
                left[e] = x[i * k + min(row + e * 16, k - 1)];
            }
            #[unroll]
            for e in 0..nr {
                right[e] = g[i * n + min(col + e * 16, n - 1)];
            }
            add_outer(&mut sums, &left, &right, kr, nr);
        }
    }
    #[unroll]
    for i in 0..kr {
        #[unroll]
        for j in 0..nr {
            if row + i * 16 < k && col + j * 16 < n {
                parts[(CUBE_POS_Z as usize * k + row + i * 16) * n + col + j * 16] = sums[i * nr + j];
            }
        }
    }
}

/// Sums of a unit over rows `first..end`, brought to shared memory tile by tile.
#[cube]
fn gather_shared(
    x: &[f32],
    g: &[f32],
    sums: &mut Array<f32>,
    first: usize,
    end: usize,
    first_row: usize,
    col: usize,
    k: usize,
    n: usize,
    #[comptime] kr: usize,
    #[comptime] nr: usize,
) {
    let tx = UNIT_POS_X as usize;
    let ty = UNIT_POS_Y as usize;
    let mut left = Array::<f32>::new(kr);
    let mut right = Array::<f32>::new(nr);
    let mut lefts = Shared::<[f32]>::new_slice(comptime!(256 * kr));
    let mut rights = Shared::<[f32]>::new_slice(comptime!(256 * nr));
    for step in 0..(end - first).div_ceil(16usize) {
        let i = first + step * 16usize + ty;
        #[unroll]
        for e in 0..kr {
            let c = first_row + tx + e * 16;
            let mut v = 0.0f32;
            if i < end && c < k {
                v = x[i * k + c];
            }
            lefts[ty * comptime!(16 * kr) + tx + e * 16] = v;
        }
        #[unroll]
        for e in 0..nr {
            let c = col + e * 16;
            let mut v = 0.0f32;
            if i < end && c < n {
                v = g[i * n + c];
            }
            rights[ty * comptime!(16 * nr) + tx + e * 16] = v;
        }
        sync_cube();
        for p in 0..16usize {
            #[unroll]
            for e in 0..kr {
                left[e] = lefts[p * comptime!(16 * kr) + ty + e * 16];
            }
            #[unroll]
            for e in 0..nr {
                right[e] = rights[p * comptime!(16 * nr) + tx + e * 16];
            }
            add_outer(sums, &left, &right, kr, nr);
        }
        sync_cube();
    }
}
