//! Transposed convolutions of which every output has one tap, such as those of size and stride 2: even and odd pixels of a row are
//! computed from the same input and written in turns.

use super::activate;
use super::bands::{Scratch, aligned, with_scratch};
use super::shapes::{Correlation, Tensors, offset};
use crate::ops::activation::Activation;
use crate::simd;
use crate::tile::{Ahead, Kernel, MOST_VECTORS, Pack, Segment, Shared, Start, Tile, kernel};
use rayon::prelude::*;
use std::cell::Cell;
use std::ops::Range;

/// Fewest pixels of the input per task.
const FEWEST: usize = 192;
/// Fewest rows of weights per task of a copy.
const ROWS: usize = 64;

thread_local! {
    /// Weights `[groups, pairs of phases, features, 2, channels]`, then each bias twice.
    static COPY: Cell<Vec<f32>> = const { Cell::new(Vec::new()) };
}

/// A correlation in progress, shared by all threads.
struct Job<'a> {
    c: &'a Correlation,
    kernel: &'static Kernel,
    x: &'a [f32],
    /// Offsets of the input's channels, to copy panels.
    planes: Vec<(u32, u32)>,
    weights: &'a [f32],
    /// Each value twice; empty for none.
    bias: &'a [f32],
    activation: Activation,
    out: Shared,
}

impl Correlation {
    /// Whether phases [alternate](Self::alternates) in whole vectors, and each has one tap at its own pixel of the input.
    fn is_paired(&self, kernel: &Kernel) -> bool {
        let whole = self.input[1].is_multiple_of(kernel.lanes) && kernel.rows.is_multiple_of(2) && self.output[1] == 2 * self.input[1];
        whole && (1..=kernel.terms()).contains(&self.channels) && self.alternates() && self.is_pointwise()
    }
}

/// Computes all outputs, or returns the tensors of a correlation of another kind.
pub fn run<'a>(c: &Correlation, t: Tensors<'a>) -> Result<(), Tensors<'a>> {
    let level = simd::level();
    let kernel = kernel(level);
    if t.before.is_some() || !c.is_paired(kernel) {
        return Err(t);
    }
    let mut copy = COPY.take();
    let weights = c.groups * c.phases.len() * c.features * c.channels;
    copy.resize(weights, 0.0);
    c.copy_weights(t.weights, &mut copy);
    copy.extend(t.bias.iter().flat_map(|b| [*b; 2]));
    let (weights, bias) = copy.split_at(weights);
    let cells = c.input[0] * c.input[1];
    let planes = (0..c.channels).map(|p| (0, offset(p * cells))).collect();
    let job = Job { c, kernel, x: t.x, planes, weights, bias, activation: t.activation, out: Shared(t.out.as_mut_ptr()) };
    let share = (c.batch * c.groups * cells).div_ceil(8 * rayon::current_num_threads());
    let band = share.max(FEWEST).min(cells).next_multiple_of(kernel.width());
    let bands = cells.div_ceil(band);
    (0..c.batch * c.groups * bands).into_par_iter().for_each(|i| {
        let first = i % bands * band;
        let band = first..(first + band).min(cells);
        simd::with_level(level, || with_scratch(|scratch| job.compute(i / bands / c.groups, i / bands % c.groups, band, scratch)));
    });
    COPY.set(copy);
    Ok(())
}

impl Correlation {
    /// Copies the weights of every output channel and phase to rows of `out`.
    fn copy_weights(&self, weights: &[f32], out: &mut [f32]) {
        out.par_chunks_exact_mut(self.channels).enumerate().with_min_len(ROWS).for_each(|(i, row)| {
            let (feature, pair, parity) = (i / 2 % self.features, i / 2 / self.features, i % 2);
            let (group, pair) = (pair / (self.phases.len() / 2), pair % (self.phases.len() / 2));
            let tap = self.phases[2 * pair + parity].taps[0].weight;
            let from = &weights[group * self.weight_group + feature * self.weight_feature + tap..];
            row.iter_mut().zip(from.iter().step_by(self.weight_channel)).for_each(|(to, w)| *to = *w);
        });
    }
}

impl Job<'_> {
    /// Computes the outputs of some pixels of an image's group, in tiles.
    fn compute(&self, image: usize, group: usize, band: Range<usize>, scratch: &mut Scratch) {
        let (c, width, channels) = (self.c, self.kernel.width(), self.c.channels);
        let cells = c.input[0] * c.input[1];
        let x = &self.x[(image * c.groups + group) * channels * cells..][..channels * cells];
        let Scratch { panel, offsets, .. } = scratch;
        let panel = aligned(panel, (channels + 1) * width);
        offsets.clear();
        offsets.extend((0..channels).map(|p| (offset(p), offset(p * width))));
        for first in band.clone().step_by(width) {
            let len = width.min(band.end - first);
            let segments = [Segment { from: first, at: 0, len, to: 0 }];
            // SAFETY: the segment lies inside each channel of the input.
            unsafe {
                self.kernel.pack(&Pack {
                    from: x.as_ptr(),
                    offsets: &self.planes,
                    segments: &segments,
                    panel: panel.as_mut_ptr(),
                    width,
                    exact: true,
                })
            };
            let mut tile = 0;
            for pair in 0..c.phases.len() / 2 {
                for feature in (0..c.features).step_by(self.kernel.rows / 2) {
                    let count = (self.kernel.rows / 2).min(c.features - feature);
                    let row = tile * Ahead::pieces(channels);
                    let ahead = (row < channels).then(|| Ahead::rows(x.as_ptr().wrapping_add(row * cells + first + len), cells));
                    self.tile([image, group, pair], feature..feature + count, first..first + len, &offsets[..channels], panel, ahead);
                    tile += 1;
                }
            }
        }
    }

    /// Computes the even and odd pixels of some channels of a row of tiles.
    fn tile(
        &self,
        [image, group, pair]: [usize; 3],
        features: Range<usize>,
        cells: Range<usize>,
        offsets: &[(u32, u32)],
        panel: &[f32],
        ahead: Option<Ahead>,
    ) {
        let (c, lanes) = (self.c, self.kernel.lanes);
        let pixels = c.output[0] * c.output[1];
        let start = c.phases[2 * pair].start[0];
        let at = |cell: usize| (start + cell / c.input[1] * c.spread[0]) * c.output[1] + cell % c.input[1] * 2;
        let vectors = cells.len() / lanes;
        let pairs: [usize; MOST_VECTORS] = std::array::from_fn(|q| if q < vectors { at(cells.start + q * lanes) } else { 0 });
        let first = (image * c.groups + group) * c.features + features.start;
        for r in 0..features.len() {
            for to in &pairs[..vectors] {
                simd::fetch_to_write(self.out.0.wrapping_add((first + r) * pixels + to), 2 * lanes);
            }
        }
        let bias = 2 * (group * c.features + features.start);
        let tile = Tile {
            a: self.weights[(((group * c.phases.len() / 2 + pair) * c.features + features.start) * 2) * c.channels..].as_ptr(),
            row: c.channels,
            b: panel.as_ptr(),
            offsets,
            c: self.out.0.wrapping_add(first * pixels),
            c_row: pixels,
            c_vector: lanes,
            start: if self.bias.is_empty() { Start::Zero } else { Start::Bias(self.bias[bias..].as_ptr()) },
            ahead: ahead.unwrap_or(Ahead::none(panel.as_ptr())),
            pairs: Some(&pairs),
        };
        // SAFETY: weights and panel hold all terms; the pixels of both phases are this task's own, and lie inside the output.
        unsafe { self.kernel.run(2 * features.len(), vectors, &tile) };
        if self.activation != Activation::None {
            for r in 0..features.len() {
                for to in &pairs[..vectors] {
                    // SAFETY: as above.
                    activate(self.activation, unsafe { std::slice::from_raw_parts_mut(self.out.at((first + r) * pixels + to), 2 * lanes) });
                }
            }
        }
    }
}
