//! Forward pass of the network, tile by tile.

use super::plan::{Plan, PlannedInput};
use super::{BLOCK, MAX_CUBES, PLANES};
use crate::gpu::CUBE;
use crate::ops::linear::gpu::{add_outer, apply};
use cubecl::prelude::*;

/// Loads a block of a factor whose rows or columns are `stride` apart.
#[cube]
pub(super) fn factor<E: Float>(
    from: &[E],
    stride: u32,
    #[comptime] ident: cmma::MatrixIdent,
    #[comptime] layout: cmma::MatrixLayout,
) -> cmma::Matrix<E> {
    cmma::Matrix::<E>::from_slice(ident, BLOCK, BLOCK, BLOCK, layout, from, stride)
}

/// A block of zeros to add products to.
#[cube]
pub(super) fn no_sum() -> cmma::Matrix<f32> {
    cmma::Matrix::<f32>::from_value(cmma::MatrixIdent::Accumulator, BLOCK, BLOCK, BLOCK, cmma::MatrixLayout::Undefined, 0.0)
}

/// Place of a number of an input's tile, in the tile and in memory.
#[derive(CubeType)]
pub(super) struct Spot {
    pub row: usize,
    pub column: usize,
    pub at: usize,
}

/// The `e`-th number of an input's tile; neighboring units get neighboring numbers of a row or of a level.
#[cube]
pub(super) fn place_in_tile(e: usize, first: usize, most: u32, #[comptime] input: PlannedInput, #[comptime] tile: usize) -> Spot {
    let f = comptime!(input.per_level);
    if comptime!(f > 0) {
        let row = e / f % tile;
        let level = e / comptime!(f * tile);
        Spot { row, column: level * f + e % f, at: (level * most as usize + first + row) * f + e % f }
    } else {
        let row = e / comptime!(input.padded);
        let column = e % comptime!(input.padded);
        Spot { row, column, at: (first + row) * comptime!(input.width) + column }
    }
}

/// Loads an input's tile into shared memory, with zeros past the rows.
#[cube]
pub(super) fn load<E: Float>(
    x: &[f32],
    to: &mut Shared<[E]>,
    first: usize,
    rows: usize,
    most: u32,
    largest: f32,
    #[comptime] input: PlannedInput,
    #[comptime] tile: usize,
    #[comptime] stride: usize,
    #[comptime] column: usize,
) {
    let width = comptime!(input.width);
    let numbers = comptime!(tile * input.padded);
    let mut e = UNIT_POS as usize;
    while e < numbers {
        let s = place_in_tile(e, first, most, comptime!(input.clone()), tile);
        let mut v = 0.0f32;
        if first + s.row < rows && s.column < width {
            v = clamp(x[s.at], -largest, largest);
        }
        to[s.row * stride + column + s.column] = E::cast_from(v);
        e += CUBE as usize;
    }
}

/// Adds bias and activation to a layer's sum `v` in row `r` of the tile and column `c`, and stores it for later layers, heads and the backward pass.
#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube]
fn finish<E: Float>(
    v: f32,
    r: usize,
    c: usize,
    first: usize,
    rows: usize,
    params: &[f32],
    acts: &mut Shared<[E]>,
    kept: &mut [E],
    h0: &mut [f32],
    h1: &mut [f32],
    #[comptime] plan: Plan,
    #[comptime] j: usize,
) {
    let layer = comptime!(plan.layers[j].clone());
    let largest = comptime!(f32::from_bits(plan.largest));
    let mut y = v;
    if comptime!(layer.bias.is_some()) {
        if c < comptime!(layer.width) {
            y += params[comptime!(layer.bias.unwrap().0) + c];
        }
    }
    if comptime!(layer.relu) {
        y = max(y, 0.0);
    }
    let e = E::cast_from(clamp(y, -largest, largest));
    if comptime!(layer.column.is_some()) {
        acts[r * comptime!(plan.stride) + comptime!(layer.column.unwrap()) + c] = e;
    }
    if first + r < rows {
        if comptime!(plan.keep && layer.kept.is_some()) {
            kept[(first + r) * comptime!(plan.kept) + comptime!(layer.kept.unwrap()) + c] = e;
        }
        #[unroll]
        for h in 0..comptime!(plan.heads.len()) {
            let head = comptime!(plan.heads[h].clone());
            if comptime!(head.layer == j) {
                if c >= comptime!(head.channel) && c < comptime!(head.channel + head.channels) {
                    let at = (first + r) * comptime!(head.channels) + c - comptime!(head.channel);
                    let out = apply(y + comptime!(f32::from_bits(head.shift)), comptime!(head.activation));
                    if comptime!(h == 0) {
                        h0[at] = out;
                    } else {
                        h1[at] = out;
                    }
                }
            }
        }
    }
}

/// Loads the inputs that layer `j` is the first to read into shared memory.
#[cube]
fn load_inputs<E: Float>(
    x0: &[f32],
    x1: &[f32],
    x2: &[f32],
    acts: &mut Shared<[E]>,
    first: usize,
    rows: usize,
    most: u32,
    #[comptime] plan: Plan,
    #[comptime] j: usize,
) {
    let (tile, stride) = comptime!((plan.tile, plan.stride));
    let largest = comptime!(f32::from_bits(plan.largest));
    #[unroll]
    for l in 0..comptime!(plan.layers[j].inputs.len()) {
        let i = comptime!(plan.layers[j].inputs[l]);
        let input = comptime!(plan.inputs[i].clone());
        let column = comptime!(input.column);
        if comptime!(i == 0) {
            load::<E>(x0, acts, first, rows, most, largest, input, tile, stride, column);
        } else if comptime!(i == 1) {
            load::<E>(x1, acts, first, rows, most, largest, input, tile, stride, column);
        } else {
            load::<E>(x2, acts, first, rows, most, largest, input, tile, stride, column);
        }
    }
}

/// Computes the sums of layer `j` on tensor cores, block by block, into `stage`.
#[cube]
fn multiply_blocks<E: Float>(packed: &[E], acts: &Shared<[E]>, stage: &mut Shared<[f32]>, #[comptime] plan: Plan, #[comptime] j: usize) {
    let layer = comptime!(plan.layers[j].clone());
    let (tile, stride, n) = comptime!((plan.tile, plan.stride, layer.padded));
    let across = comptime!(n / BLOCK);
    let mut block = UNIT_POS as usize / 32;
    while block < comptime!(tile / BLOCK * (n / BLOCK)) {
        let r = block / across * BLOCK;
        let c = block % across * BLOCK;
        let sum = no_sum();
        #[unroll]
        for s in 0..comptime!(layer.feeds.len()) {
            let feed = comptime!(layer.feeds[s].clone());
            #[unroll]
            for k in 0..comptime!(feed.padded / BLOCK) {
                let from = r * stride + comptime!(feed.column + k * BLOCK);
                let a =
                    factor::<E>(&acts[from..comptime!(tile * stride)], stride as u32, cmma::MatrixIdent::A, cmma::MatrixLayout::RowMajor);
                let weight = comptime!(layer.weight + (feed.at + k * BLOCK) * n) + c;
                let b = factor::<E>(&packed[weight..comptime!(plan.packed)], n as u32, cmma::MatrixIdent::B, cmma::MatrixLayout::RowMajor);
                cmma::execute(&a, &b, &sum, &sum);
            }
        }
        let to = r * comptime!(plan.stage) + c;
        cmma::store(&mut stage[to..comptime!(tile * plan.stage)], &sum, comptime!(plan.stage as u32), cmma::MatrixLayout::RowMajor);
        block += PLANES;
    }
}

/// Computes the sums of layer `j` in f32, some per unit.
#[cube]
fn multiply_units<E: Float>(packed: &[E], acts: &Shared<[E]>, sums: &mut Array<f32>, #[comptime] plan: Plan, #[comptime] j: usize) {
    let layer = comptime!(plan.layers[j].clone());
    let (stride, n) = comptime!((plan.stride, layer.padded));
    let mr = comptime!(plan.tile / BLOCK);
    let nr = comptime!(n / BLOCK);
    let tx = UNIT_POS as usize % BLOCK;
    let ty = UNIT_POS as usize / BLOCK;
    let mut left = Array::<f32>::new(mr);
    let mut right = Array::<f32>::new(nr);
    #[unroll]
    for e in 0..comptime!(mr * nr) {
        sums[e] = 0.0;
    }
    #[unroll]
    for s in 0..comptime!(layer.feeds.len()) {
        let feed = comptime!(layer.feeds[s].clone());
        for k in 0..comptime!(feed.padded) {
            #[unroll]
            for i in 0..mr {
                left[i] = f32::cast_from(acts[(ty + i * BLOCK) * stride + comptime!(feed.column) + k]);
            }
            #[unroll]
            for i in 0..nr {
                right[i] = f32::cast_from(packed[comptime!(layer.weight) + (comptime!(feed.at) + k) * n + tx + i * BLOCK]);
            }
            add_outer(sums, &left, &right, mr, nr);
        }
    }
}

/// Takes tiles of rows through all layers.
#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube(launch_unchecked)]
pub(super) fn forward_tiles<E: Float>(
    live: &[u32],
    x0: &[f32],
    x1: &[f32],
    x2: &[f32],
    packed: &[E],
    params: &[f32],
    kept: &mut [E],
    h0: &mut [f32],
    h1: &mut [f32],
    at: u32,
    most: u32,
    #[comptime] plan: Plan,
) {
    let rows = live[at as usize] as usize;
    let tile = comptime!(plan.tile);
    let first = (CUBE_POS_X as usize + CUBE_POS_Y as usize * MAX_CUBES) * tile;
    if first >= rows {
        terminate!();
    }
    let unit = UNIT_POS as usize;
    let mut acts = Shared::<[E]>::new_aligned_slice(comptime!(tile * plan.stride), 32usize);
    let mut stage = Shared::<[f32]>::new_aligned_slice(comptime!(if plan.tensor { tile * plan.stage } else { 1 }), 32usize);
    #[unroll]
    for j in 0..comptime!(plan.layers.len()) {
        load_inputs::<E>(x0, x1, x2, &mut acts, first, rows, most, comptime!(plan.clone()), j);
        sync_cube();
        let n = comptime!(plan.layers[j].padded);
        if comptime!(plan.tensor) {
            multiply_blocks::<E>(packed, &acts, &mut stage, comptime!(plan.clone()), j);
            sync_cube();
            let mut e = unit;
            while e < comptime!(tile * n) {
                let r = e / n;
                let c = e % n;
                let v = stage[r * comptime!(plan.stage) + c];
                finish::<E>(v, r, c, first, rows, params, &mut acts, kept, h0, h1, comptime!(plan.clone()), j);
                e += CUBE as usize;
            }
        } else {
            let mr = comptime!(tile / BLOCK);
            let nr = comptime!(n / BLOCK);
            let mut sums = Array::<f32>::new(comptime!(mr * nr));
            multiply_units::<E>(packed, &acts, &mut sums, comptime!(plan.clone()), j);
            sync_cube();
            #[unroll]
            for a in 0..mr {
                #[unroll]
                for b in 0..nr {
                    let (r, c) = (unit / BLOCK + a * BLOCK, unit % BLOCK + b * BLOCK);
                    finish::<E>(sums[a * nr + b], r, c, first, rows, params, &mut acts, kept, h0, h1, comptime!(plan.clone()), j);
                }
            }
        }
    }
}
