//! The way back.

use super::ahead::{factor, load, no_sum, spot};
use super::plan::{Plan, PlannedHead, PlannedInput};
use super::{BLOCK, PLANES};
use crate::gpu::CUBE;
use crate::ops::fused_mlp::Source;
use crate::ops::linear::gpu::{add_outer, slope};
use cubecl::prelude::*;

/// Brings what layer `j` kept to shared memory, zeros past the rows.
#[cube]
fn recall<E: Float>(
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

/// Takes an input's gradient from shared memory to where it belongs.
#[cube]
fn hand_on(
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
        let s = spot(e, first, most, comptime!(input.clone()), tile);
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
fn seed(out: &[f32], d: &[f32], row: usize, c: usize, #[comptime] head: PlannedHead) -> f32 {
    let mut g = 0.0f32;
    if c >= comptime!(head.channel) && c < comptime!(head.channel + head.channels) {
        let at = row * comptime!(head.channels) + c - comptime!(head.channel);
        g = d[at] * slope(out[at], comptime!(head.activation));
    }
    g
}

/// Tiles of rows back through all layers.
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
    let (xs, gs, ds) = comptime!((plan.x, plan.g, plan.gradients));
    let largest = comptime!(f32::from_bits(plan.largest));
    let unit = UNIT_POS as usize;
    let tx = unit % BLOCK;
    let ty = unit / BLOCK;
    let plane = unit / 32;
    let mut x = Shared::<[E]>::new_aligned_slice(comptime!(tile * xs), 32usize);
    let mut g = Shared::<[E]>::new_aligned_slice(comptime!(tile * gs), 32usize);
    let mut gradients = Shared::<[f32]>::new_aligned_slice(comptime!(tile * ds), 32usize);
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
        for _e in 0..comptime!(plan.layers.iter().map(|l| (l.rows / BLOCK * (l.padded / BLOCK)).div_ceil(PLANES)).sum::<usize>()) {
            blocks.push(no_sum());
        }
    }
    let mut first = CUBE_POS_X as usize * tile;
    while first < rows {
        #[unroll]
        for back_to_front in 0..comptime!(plan.layers.len()) {
            let j = comptime!(plan.layers.len() - 1 - back_to_front);
            let layer = comptime!(plan.layers[j].clone());
            let n = comptime!(layer.padded);
            let k = comptime!(layer.rows);
            // The gradient of the layer's sum.
            let mut e = unit;
            while e < comptime!(tile * n) {
                let r = e / n;
                let c = e % n;
                let mut v = 0.0f32;
                if first + r < rows {
                    if comptime!(layer.gradient.is_some()) {
                        v = gradients[r * ds + comptime!(layer.gradient.unwrap()) + c];
                    }
                    #[unroll]
                    for h in 0..comptime!(plan.heads.len()) {
                        let head = comptime!(plan.heads[h].clone());
                        if comptime!(head.layer == j) {
                            if comptime!(h == 0) {
                                v += scale * seed(h0, d0, first + r, c, head);
                            } else {
                                v += scale * seed(h1, d1, first + r, c, head);
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
                g[r * gs + c] = E::cast_from(clamp(v, -largest, largest));
                e += CUBE as usize;
            }
            // What the layer read.
            #[unroll]
            for s in 0..comptime!(layer.feeds.len()) {
                let feed = comptime!(layer.feeds[s].clone());
                let column = comptime!(feed.at);
                if comptime!(feed.source == Source::Input(0)) {
                    load::<E>(x0, &mut x, first, rows, most, largest, comptime!(plan.inputs[0].clone()), tile, xs, column);
                } else if comptime!(feed.source == Source::Input(1)) {
                    load::<E>(x1, &mut x, first, rows, most, largest, comptime!(plan.inputs[1].clone()), tile, xs, column);
                } else if comptime!(feed.source == Source::Input(2)) {
                    load::<E>(x2, &mut x, first, rows, most, largest, comptime!(plan.inputs[2].clone()), tile, xs, column);
                } else {
                    let from = comptime!(match feed.source {
                        Source::Layer(i) => plan.layers[i].kept.unwrap(),
                        Source::Input(_) => 0,
                    });
                    recall::<E>(kept, &mut x, first, rows, comptime!(feed.padded), from, comptime!(plan.kept), tile, xs, column);
                }
            }
            sync_cube();
            if comptime!(layer.bias.is_some()) {
                let slot = comptime!(plan.layers[..j].iter().filter(|l| l.bias.is_some()).count());
                if unit < n {
                    for r in 0..tile {
                        bias[slot] += f32::cast_from(g[r * gs + unit]);
                    }
                }
            }
            if comptime!(plan.tensor) {
                let across = comptime!(n / BLOCK);
                let total = comptime!(k / BLOCK * (n / BLOCK));
                let before =
                    comptime!(plan.layers[..j].iter().map(|l| (l.rows / BLOCK * (l.padded / BLOCK)).div_ceil(PLANES)).sum::<usize>());
                #[unroll]
                for slot in 0..comptime!(total.div_ceil(PLANES)) {
                    let block = plane + slot * PLANES;
                    if block < total {
                        let from = block / across * BLOCK;
                        let c = block % across * BLOCK;
                        #[unroll]
                        for r in 0..comptime!(tile / BLOCK) {
                            let xa = r * comptime!(BLOCK * xs) + from;
                            let a =
                                factor::<E>(&x[xa..comptime!(tile * xs)], xs as u32, cmma::MatrixIdent::A, cmma::MatrixLayout::ColMajor);
                            let ga = r * comptime!(BLOCK * gs) + c;
                            let b =
                                factor::<E>(&g[ga..comptime!(tile * gs)], gs as u32, cmma::MatrixIdent::B, cmma::MatrixLayout::RowMajor);
                            let sum = blocks.index(comptime!(before + slot));
                            cmma::execute(&a, &b, sum, sum);
                        }
                    }
                }
            } else {
                let kr = comptime!(k / BLOCK);
                let nr = comptime!(n / BLOCK);
                let before = comptime!(plan.layers[..j].iter().map(|l| (l.rows / BLOCK) * (l.padded / BLOCK)).sum::<usize>());
                let mut right = Array::<f32>::new(nr);
                for r in 0..tile {
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
            // What it read gets its gradient.
            #[unroll]
            for s in 0..comptime!(layer.feeds.len()) {
                let feed = comptime!(layer.feeds[s].clone());
                if comptime!(feed.gradient.is_some()) {
                    let to = comptime!(feed.gradient.unwrap());
                    let adds = comptime!(!feed.fresh && matches!(feed.source, Source::Layer(_)));
                    let across = comptime!(feed.padded / BLOCK);
                    if comptime!(plan.tensor) {
                        let mut block = plane;
                        while block < comptime!(tile / BLOCK * (feed.padded / BLOCK)) {
                            let r = block / across * BLOCK;
                            let c = block % across * BLOCK;
                            let mut sum = no_sum();
                            let place = r * ds + to + c;
                            if comptime!(adds) {
                                cmma::load_with_layout(
                                    &mut sum,
                                    &gradients[place..comptime!(tile * ds)],
                                    ds as u32,
                                    cmma::MatrixLayout::RowMajor,
                                );
                            }
                            #[unroll]
                            for b in 0..comptime!(n / BLOCK) {
                                let ga = r * gs + comptime!(b * BLOCK);
                                let left = factor::<E>(
                                    &g[ga..comptime!(tile * gs)],
                                    gs as u32,
                                    cmma::MatrixIdent::A,
                                    cmma::MatrixLayout::RowMajor,
                                );
                                let weight = (comptime!(feed.at) + c) * n + comptime!(layer.weight + b * BLOCK);
                                let right = factor::<E>(
                                    &packed[weight..comptime!(plan.packed)],
                                    n as u32,
                                    cmma::MatrixIdent::B,
                                    cmma::MatrixLayout::ColMajor,
                                );
                                cmma::execute(&left, &right, &sum, &sum);
                            }
                            cmma::store(&mut gradients[place..comptime!(tile * ds)], &sum, ds as u32, cmma::MatrixLayout::RowMajor);
                            block += PLANES;
                        }
                    } else {
                        let mr = comptime!(tile / BLOCK);
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
                                let place = (ty + a * BLOCK) * ds + to + tx + i * BLOCK;
                                if comptime!(adds) {
                                    gradients[place] += dx[a * across + i];
                                } else {
                                    gradients[place] = dx[a * across + i];
                                }
                            }
                        }
                    }
                }
            }
            sync_cube();
            #[unroll]
            for s in 0..comptime!(layer.feeds.len()) {
                let feed = comptime!(layer.feeds[s].clone());
                if comptime!(feed.gradient.is_some() && matches!(feed.source, Source::Input(_))) {
                    let i = comptime!(match feed.source {
                        Source::Input(i) => i,
                        Source::Layer(_) => 0,
                    });
                    let input = comptime!(plan.inputs[i].clone());
                    let (column, fresh) = comptime!((feed.gradient.unwrap(), feed.fresh));
                    if comptime!(i == 0) {
                        hand_on(&gradients, dx0, first, rows, most, scale, input, tile, ds, column, fresh);
                    } else if comptime!(i == 1) {
                        hand_on(&gradients, dx1, first, rows, most, scale, input, tile, ds, column, fresh);
                    } else {
                        hand_on(&gradients, dx2, first, rows, most, scale, input, tile, ds, column, fresh);
                    }
                }
            }
        }
        sync_cube();
        first += CUBE_COUNT_X as usize * tile;
    }
    let part = CUBE_POS_X as usize * comptime!(plan.packed);
    #[unroll]
    for j in 0..comptime!(plan.layers.len()) {
        let layer = comptime!(plan.layers[j].clone());
        let n = comptime!(layer.padded);
        let weight = part + comptime!(layer.weight);
        if comptime!(plan.tensor) {
            let across = comptime!(n / BLOCK);
            let total = comptime!(layer.rows / BLOCK * (n / BLOCK));
            let before = comptime!(plan.layers[..j].iter().map(|l| (l.rows / BLOCK * (l.padded / BLOCK)).div_ceil(PLANES)).sum::<usize>());
            #[unroll]
            for slot in 0..comptime!(total.div_ceil(PLANES)) {
                let block = plane + slot * PLANES;
                if block < total {
                    let to = weight + block / across * comptime!(BLOCK * n) + block % across * BLOCK;
                    let sum = blocks.index(comptime!(before + slot));
                    cmma::store(&mut parts[to..part + comptime!(plan.packed)], sum, n as u32, cmma::MatrixLayout::RowMajor);
                }
            }
        } else {
            let (kr, nr) = comptime!((layer.rows / BLOCK, n / BLOCK));
            let before = comptime!(plan.layers[..j].iter().map(|l| (l.rows / BLOCK) * (l.padded / BLOCK)).sum::<usize>());
            #[unroll]
            for a in 0..kr {
                #[unroll]
                for i in 0..nr {
                    parts[weight + (ty + a * BLOCK) * n + tx + i * BLOCK] = sums[before + a * nr + i];
                }
            }
        }
        if comptime!(layer.bias.is_some()) {
            let slot = comptime!(plan.layers[..j].iter().filter(|l| l.bias.is_some()).count());
            if unit < n {
                parts[part + comptime!(layer.bias.unwrap().1) + unit] = bias[slot];
            }
        }
    }
}
