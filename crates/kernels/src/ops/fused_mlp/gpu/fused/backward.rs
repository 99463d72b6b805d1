//! Backward pass of the network, tile by tile.

use super::forward::{factor, load, no_sum, place_in_tile};
use super::plan::{Plan, PlannedHead, PlannedInput};
use super::{BLOCK, PLANES};
use crate::gpu::CUBE;
use crate::ops::fused_mlp::Source;
use crate::ops::linear::gpu::{add_outer, slope};
use cubecl::prelude::*;

/// Loads the kept values of layer `j` into shared memory, with zeros past the rows.
#[cube]
fn load_kept<E: Float>(
    kept: &[E],
    to: &mut Shared<[E]>,
    first: usize,
    rows: usize,
    #[comptime] wide: usize,
    #[comptime] from: usize,
    #[comptime] from_stride: usize,
    #[comptime] tile: usize,
    #[comptime] stride: usize,
    #[comptime] column: usize,
) {
    let mut e = UNIT_POS as usize;
    while e < comptime!(tile * wide) {
        let r = e / wide;
        let c = e % wide;
        let mut v = E::cast_from(0.0f32);
        if first + r < rows {
            v = kept[(first + r) * from_stride + from + c];
        }
        to[r * stride + column + c] = v;
        e += CUBE as usize;
    }
}

/// Stores an input's gradient from shared memory.
#[cube]
fn store_input_gradient(
    gradients: &Shared<[f32]>,
    to: &mut [f32],
    first: usize,
    rows: usize,
    most: u32,
    scale: f32,
    #[comptime] input: PlannedInput,
    #[comptime] tile: usize,
    #[comptime] stride: usize,
    #[comptime] column: usize,
    #[comptime] fresh: bool,
) {
    let width = comptime!(input.width);
    let numbers = comptime!(tile * input.padded);
    let mut e = UNIT_POS as usize;
    while e < numbers {
        let s = place_in_tile(e, first, most, comptime!(input.clone()), tile);
        if first + s.row < rows && s.column < width {
            let v = gradients[s.row * stride + column + s.column] / scale;
            if comptime!(fresh) {
                to[s.at] = v;
            } else {
                to[s.at] += v;
            }
        }
        e += CUBE as usize;
    }
}

/// A head's share of the gradient of its layer's sum, in row `row` and column `c`.
#[cube]
fn head_gradient(out: &[f32], d: &[f32], row: usize, c: usize, #[comptime] head: PlannedHead) -> f32 {
    let mut g = 0.0f32;
    if c >= comptime!(head.channel) && c < comptime!(head.channel + head.channels) {
        let at = row * comptime!(head.channels) + c - comptime!(head.channel);
        g = d[at] * slope(out[at], comptime!(head.activation));
    }
    g
}

/// Writes the gradient of layer `j`'s sums to `g`.
#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube]
fn layer_gradient<E: Float>(
    kept: &[E],
    h0: &[f32],
    h1: &[f32],
    d0: &[f32],
    d1: &[f32],
    gradients: &Shared<[f32]>,
    g: &mut Shared<[E]>,
    first: usize,
    rows: usize,
    scale: f32,
    #[comptime] plan: Plan,
    #[comptime] j: usize,
) {
    let layer = comptime!(plan.layers[j].clone());
    let largest = comptime!(f32::from_bits(plan.largest));
    let n = comptime!(layer.padded);
    let mut e = UNIT_POS as usize;
    while e < comptime!(plan.tile * n) {
        let r = e / n;
        let c = e % n;
        let mut v = 0.0f32;
        if first + r < rows {
            if comptime!(layer.gradient.is_some()) {
                v = gradients[r * comptime!(plan.gradients) + comptime!(layer.gradient.unwrap()) + c];
            }
            #[unroll]
            for h in 0..comptime!(plan.heads.len()) {
                let head = comptime!(plan.heads[h].clone());
                if comptime!(head.layer == j) {
                    if comptime!(h == 0) {
                        v += scale * head_gradient(h0, d0, first + r, c, head);
                    } else {
                        v += scale * head_gradient(h1, d1, first + r, c, head);
                    }
                }
            }
            if comptime!(layer.relu) {
                let y = f32::cast_from(kept[(first + r) * comptime!(plan.kept) + comptime!(layer.kept.unwrap()) + c]);
                if y <= 0.0 {
                    v = 0.0;
                }
            }
        }
        g[r * comptime!(plan.g) + c] = E::cast_from(clamp(v, -largest, largest));
        e += CUBE as usize;
    }
}

/// Loads the inputs of layer `j` into `x`.
#[cube]
fn load_sources<E: Float>(
    x0: &[f32],
    x1: &[f32],
    x2: &[f32],
    kept: &[E],
    x: &mut Shared<[E]>,
    first: usize,
    rows: usize,
    most: u32,
    #[comptime] plan: Plan,
    #[comptime] j: usize,
) {
    let (tile, xs) = comptime!((plan.tile, plan.x));
    let largest = comptime!(f32::from_bits(plan.largest));
    #[unroll]
    for s in 0..comptime!(plan.layers[j].feeds.len()) {
        let feed = comptime!(plan.layers[j].feeds[s].clone());
        let column = comptime!(feed.at);
        if comptime!(feed.source == Source::Input(0)) {
            load::<E>(x0, x, first, rows, most, largest, comptime!(plan.inputs[0].clone()), tile, xs, column);
        } else if comptime!(feed.source == Source::Input(1)) {
            load::<E>(x1, x, first, rows, most, largest, comptime!(plan.inputs[1].clone()), tile, xs, column);
        } else if comptime!(feed.source == Source::Input(2)) {
            load::<E>(x2, x, first, rows, most, largest, comptime!(plan.inputs[2].clone()), tile, xs, column);
        } else {
            let from = comptime!(match feed.source {
                Source::Layer(i) => plan.layers[i].kept.unwrap(),
                Source::Input(_) => 0,
            });
            load_kept::<E>(kept, x, first, rows, comptime!(feed.padded), from, comptime!(plan.kept), tile, xs, column);
        }
    }
}

/// Adds the columns of G of layer `j` to the units' sums for its bias.
#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube]
fn add_bias_sums<E: Float>(g: &Shared<[E]>, bias: &mut Array<f32>, #[comptime] plan: Plan, #[comptime] j: usize) {
    if comptime!(plan.layers[j].bias.is_some()) {
        let slot = comptime!(plan.biases_before(j));
        if (UNIT_POS as usize) < comptime!(plan.layers[j].padded) {
            for r in 0..comptime!(plan.tile) {
                bias[slot] += f32::cast_from(g[r * comptime!(plan.g) + UNIT_POS as usize]);
            }
        }
    }
}

/// Adds `Xᵀ G` of layer `j` to the planes' blocks, on tensor cores.
#[cube]
fn add_weight_blocks<E: Float>(
    x: &Shared<[E]>,
    g: &Shared<[E]>,
    blocks: &Sequence<cmma::Matrix<f32>>,
    #[comptime] plan: Plan,
    #[comptime] j: usize,
) {
    let layer = comptime!(plan.layers[j].clone());
    let (tile, xs, gs) = comptime!((plan.tile, plan.x, plan.g));
    let across = comptime!(layer.padded / BLOCK);
    let total = comptime!(layer.rows / BLOCK * (layer.padded / BLOCK));
    let before = comptime!(plan.blocks_before(j));
    #[unroll]
    for slot in 0..comptime!(total.div_ceil(PLANES)) {
        let block = UNIT_POS as usize / 32 + slot * PLANES;
        if block < total {
            let from = block / across * BLOCK;
            let c = block % across * BLOCK;
            #[unroll]
            for r in 0..comptime!(tile / BLOCK) {
                let xa = r * comptime!(BLOCK * xs) + from;
                let a = factor::<E>(&x[xa..comptime!(tile * xs)], xs as u32, cmma::MatrixIdent::A, cmma::MatrixLayout::ColMajor);
                let ga = r * comptime!(BLOCK * gs) + c;
                let b = factor::<E>(&g[ga..comptime!(tile * gs)], gs as u32, cmma::MatrixIdent::B, cmma::MatrixLayout::RowMajor);
                let sum = blocks.index(comptime!(before + slot));
                cmma::execute(&a, &b, sum, sum);
            }
        }
    }
}

/// Adds `Xᵀ G` of layer `j` to the units' sums.
#[cube]
fn add_weight_sums<E: Float>(x: &Shared<[E]>, g: &Shared<[E]>, sums: &mut Array<f32>, #[comptime] plan: Plan, #[comptime] j: usize) {
    let (xs, gs) = comptime!((plan.x, plan.g));
    let kr = comptime!(plan.layers[j].rows / BLOCK);
    let nr = comptime!(plan.layers[j].padded / BLOCK);
    let before = comptime!(plan.sums_before(j));
    let tx = UNIT_POS as usize % BLOCK;
    let ty = UNIT_POS as usize / BLOCK;
    let mut right = Array::<f32>::new(nr);
    for r in 0..comptime!(plan.tile) {
        #[unroll]
        for i in 0..nr {
            right[i] = f32::cast_from(g[r * gs + tx + i * BLOCK]);
        }
        #[unroll]
        for a in 0..kr {
            let left = f32::cast_from(x[r * xs + ty + a * BLOCK]);
            #[unroll]
            for i in 0..nr {
                sums[before + a * nr + i] += left * right[i];
            }
        }
    }
}

/// Gradient of source `s` of layer `j`, on tensor cores.
#[cube]
fn source_gradient_blocks<E: Float>(
    packed: &[E],
    g: &Shared<[E]>,
    gradients: &mut Shared<[f32]>,
    #[comptime] plan: Plan,
    #[comptime] j: usize,
    #[comptime] s: usize,
) {
    let layer = comptime!(plan.layers[j].clone());
    let feed = comptime!(layer.feeds[s].clone());
    let (tile, gs, ds, n) = comptime!((plan.tile, plan.g, plan.gradients, layer.padded));
    let across = comptime!(feed.padded / BLOCK);
    let mut block = UNIT_POS as usize / 32;
    while block < comptime!(tile / BLOCK * (feed.padded / BLOCK)) {
        let r = block / across * BLOCK;
        let c = block % across * BLOCK;
        let mut sum = no_sum();
        let place = r * ds + comptime!(feed.gradient.unwrap()) + c;
        if comptime!(feed.adds()) {
            cmma::load_with_layout(&mut sum, &gradients[place..comptime!(tile * ds)], ds as u32, cmma::MatrixLayout::RowMajor);
        }
        #[unroll]
        for b in 0..comptime!(n / BLOCK) {
            let ga = r * gs + comptime!(b * BLOCK);
            let left = factor::<E>(&g[ga..comptime!(tile * gs)], gs as u32, cmma::MatrixIdent::A, cmma::MatrixLayout::RowMajor);
            let weight = (comptime!(feed.at) + c) * n + comptime!(layer.weight + b * BLOCK);
            let right = factor::<E>(&packed[weight..comptime!(plan.packed)], n as u32, cmma::MatrixIdent::B, cmma::MatrixLayout::ColMajor);
            cmma::execute(&left, &right, &sum, &sum);
        }
        cmma::store(&mut gradients[place..comptime!(tile * ds)], &sum, ds as u32, cmma::MatrixLayout::RowMajor);
        block += PLANES;
    }
}

/// Gradient of source `s` of layer `j`, some numbers per unit.
#[cube]
fn source_gradient_units<E: Float>(
    packed: &[E],
    g: &Shared<[E]>,
    gradients: &mut Shared<[f32]>,
    #[comptime] plan: Plan,
    #[comptime] j: usize,
    #[comptime] s: usize,
) {
    let layer = comptime!(plan.layers[j].clone());
    let feed = comptime!(layer.feeds[s].clone());
    let (gs, ds, n) = comptime!((plan.g, plan.gradients, layer.padded));
    let tx = UNIT_POS as usize % BLOCK;
    let ty = UNIT_POS as usize / BLOCK;
    let across = comptime!(feed.padded / BLOCK);
    let mr = comptime!(plan.tile / BLOCK);
    let mut dx = Array::<f32>::new(comptime!(mr * across));
    let mut left = Array::<f32>::new(mr);
    let mut right = Array::<f32>::new(across);
    #[unroll]
    for e in 0..comptime!(mr * across) {
        dx[e] = 0.0;
    }
    for c in 0..n {
        #[unroll]
        for i in 0..mr {
            left[i] = f32::cast_from(g[(ty + i * BLOCK) * gs + c]);
        }
        #[unroll]
        for i in 0..across {
            right[i] = f32::cast_from(packed[comptime!(layer.weight) + (comptime!(feed.at) + tx + i * BLOCK) * n + c]);
        }
        add_outer(&mut dx, &left, &right, mr, across);
    }
    #[unroll]
    for a in 0..mr {
        #[unroll]
        for i in 0..across {
            let place = (ty + a * BLOCK) * ds + comptime!(feed.gradient.unwrap()) + tx + i * BLOCK;
            if comptime!(feed.adds()) {
                gradients[place] += dx[a * across + i];
            } else {
                gradients[place] = dx[a * across + i];
            }
        }
    }
}

/// Stores the gradients of the inputs that layer `j` reads.
#[cube]
fn store_input_gradients(
    gradients: &Shared<[f32]>,
    dx0: &mut [f32],
    dx1: &mut [f32],
    dx2: &mut [f32],
    first: usize,
    rows: usize,
    most: u32,
    scale: f32,
    #[comptime] plan: Plan,
    #[comptime] j: usize,
) {
    let (tile, ds) = comptime!((plan.tile, plan.gradients));
    #[unroll]
    for s in 0..comptime!(plan.layers[j].feeds.len()) {
        let feed = comptime!(plan.layers[j].feeds[s].clone());
        if comptime!(feed.gradient.is_some() && matches!(feed.source, Source::Input(_))) {
            let i = comptime!(match feed.source {
                Source::Input(i) => i,
                Source::Layer(_) => 0,
            });
            let input = comptime!(plan.inputs[i].clone());
            let (column, fresh) = comptime!((feed.gradient.unwrap(), feed.fresh));
            if comptime!(i == 0) {
                store_input_gradient(gradients, dx0, first, rows, most, scale, input, tile, ds, column, fresh);
            } else if comptime!(i == 1) {
                store_input_gradient(gradients, dx1, first, rows, most, scale, input, tile, ds, column, fresh);
            } else {
                store_input_gradient(gradients, dx2, first, rows, most, scale, input, tile, ds, column, fresh);
            }
        }
    }
}

/// Writes the cube's gradients of the weights and the bias of layer `j`.
#[cube]
fn store_sums(
    sums: &Array<f32>,
    blocks: &Sequence<cmma::Matrix<f32>>,
    bias: &Array<f32>,
    parts: &mut [f32],
    #[comptime] plan: Plan,
    #[comptime] j: usize,
) {
    let layer = comptime!(plan.layers[j].clone());
    let n = comptime!(layer.padded);
    let unit = UNIT_POS as usize;
    let part = CUBE_POS_X as usize * comptime!(plan.packed);
    let weight = part + comptime!(layer.weight);
    if comptime!(plan.tensor) {
        let across = comptime!(n / BLOCK);
        let total = comptime!(layer.rows / BLOCK * (n / BLOCK));
        let before = comptime!(plan.blocks_before(j));
        #[unroll]
        for slot in 0..comptime!(total.div_ceil(PLANES)) {
            let block = unit / 32 + slot * PLANES;
            if block < total {
                let to = weight + block / across * comptime!(BLOCK * n) + block % across * BLOCK;
                let sum = blocks.index(comptime!(before + slot));
                cmma::store(&mut parts[to..part + comptime!(plan.packed)], sum, n as u32, cmma::MatrixLayout::RowMajor);
            }
        }
    } else {
        let (kr, nr) = comptime!((layer.rows / BLOCK, n / BLOCK));
        let before = comptime!(plan.sums_before(j));
        #[unroll]
        for a in 0..kr {
            #[unroll]
            for i in 0..nr {
                parts[weight + (unit / BLOCK + a * BLOCK) * n + unit % BLOCK + i * BLOCK] = sums[before + a * nr + i];
            }
        }
    }
    if comptime!(layer.bias.is_some()) {
        let slot = comptime!(plan.biases_before(j));
        if unit < n {
            parts[part + comptime!(layer.bias.unwrap().1) + unit] = bias[slot];
        }
    }
}

/// Takes tiles of rows backward through all layers.
#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube(launch_unchecked)]
pub(super) fn backward_tiles<E: Float>(
    live: &[u32],
    x0: &[f32],
    x1: &[f32],
    x2: &[f32],
    packed: &[E],
    kept: &[E],
    h0: &[f32],
    h1: &[f32],
    d0: &[f32],
    d1: &[f32],
    dx0: &mut [f32],
    dx1: &mut [f32],
    dx2: &mut [f32],
    parts: &mut [f32],
    at: u32,
    most: u32,
    scale: f32,
    #[comptime] plan: Plan,
) {
    let rows = live[at as usize] as usize;
    let tile = comptime!(plan.tile);
    let mut x = Shared::<[E]>::new_aligned_slice(comptime!(tile * plan.x), 32usize);
    let mut g = Shared::<[E]>::new_aligned_slice(comptime!(tile * plan.g), 32usize);
    let mut gradients = Shared::<[f32]>::new_aligned_slice(comptime!(tile * plan.gradients), 32usize);
    // Weights' gradients: units' sums, or planes' blocks.
    let count = comptime!(if plan.tensor { 1 } else { plan.sums() });
    let mut sums = Array::<f32>::new(count);
    let mut blocks = Sequence::<cmma::Matrix<f32>>::new();
    let mut bias = Array::<f32>::new(comptime!(plan.biases().max(1)));
    #[unroll]
    for e in 0..count {
        sums[e] = 0.0;
    }
    #[unroll]
    for e in 0..comptime!(plan.biases().max(1)) {
        bias[e] = 0.0;
    }
    if comptime!(plan.tensor) {
        #[unroll]
        for _e in 0..comptime!(plan.blocks_before(plan.layers.len())) {
            blocks.push(no_sum());
        }
    }
    let mut first = CUBE_POS_X as usize * tile;
    while first < rows {
        #[unroll]
        for back_to_front in 0..comptime!(plan.layers.len()) {
            let j = comptime!(plan.layers.len() - 1 - back_to_front);
            layer_gradient::<E>(kept, h0, h1, d0, d1, &gradients, &mut g, first, rows, scale, comptime!(plan.clone()), j);
            load_sources::<E>(x0, x1, x2, kept, &mut x, first, rows, most, comptime!(plan.clone()), j);
            sync_cube();
            add_bias_sums::<E>(&g, &mut bias, comptime!(plan.clone()), j);
            if comptime!(plan.tensor) {
                add_weight_blocks::<E>(&x, &g, &blocks, comptime!(plan.clone()), j);
            } else {
                add_weight_sums::<E>(&x, &g, &mut sums, comptime!(plan.clone()), j);
            }
            #[unroll]
            for s in 0..comptime!(plan.layers[j].feeds.len()) {
                if comptime!(plan.layers[j].feeds[s].gradient.is_some()) {
                    if comptime!(plan.tensor) {
                        source_gradient_blocks::<E>(packed, &g, &mut gradients, comptime!(plan.clone()), j, s);
                    } else {
                        source_gradient_units::<E>(packed, &g, &mut gradients, comptime!(plan.clone()), j, s);
                    }
                }
            }
            sync_cube();
            store_input_gradients(&gradients, dx0, dx1, dx2, first, rows, most, scale, comptime!(plan.clone()), j);
        }
        sync_cube();
        first += CUBE_COUNT_X as usize * tile;
    }
    #[unroll]
    for j in 0..comptime!(plan.layers.len()) {
        store_sums(&sums, &blocks, &bias, parts, comptime!(plan.clone()), j);
    }
}
