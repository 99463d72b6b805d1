//! Computes correlations (forward passes and input gradients) as sums over channels and taps, vectorized along output pixels.

mod factors;
mod outputs;

use super::bands::{Bands, Scratch, aligned, with_scratch};
use super::later::{Later, Run};
use super::planes::{Planes, Source};
use super::shapes::{Correlation, Phase, Tensors, offset};
use super::winograd;
use super::{depthwise, paired};
use crate::gemm::{Gemm, Init, Rounded, View};
use crate::ops::activation::Activation;
use crate::simd;
use crate::tile::{Ahead, Kernel, Pack, Segment, Shared, Start, Tile, kernel};
use factors::Factors;
use rayon::prelude::*;
use std::ops::Range;

/// Floats of the input that a tile reads per pass without a panel, so that they stay in the L1 cache.
const DIRECT: usize = 6 << 10;
/// Terms of a sum per pass with a panel.
const TERMS: usize = 192;
/// Terms of a sum per pass of a pointwise (1 × 1) convolution.
const POINTWISE_TERMS: usize = 288;
/// Floats of sums that a band keeps between passes.
const SUMS: usize = 96 << 10;
/// Fewest pixels of a band that is cut to keep all threads busy.
const FEWEST: usize = 192;

/// Per term of a pass, the offsets of (weight, input): in the planes, and in a panel.
#[derive(Clone, Debug, Default)]
struct Terms {
    planes: Vec<(u32, u32)>,
    panel: Vec<(u32, u32)>,
    /// Floats from the weights of a block of channels to those of the next.
    to_block: usize,
}

/// A correlation in progress, shared by all threads.
struct Job<'a> {
    c: &'a Correlation,
    kernel: &'static Kernel,
    planes: Planes,
    bands: Bands,
    terms: Vec<Terms>,
    /// Input channels per pass.
    block: usize,
    /// Output channels per task.
    features: usize,
    /// Whether tiles read the planes without a panel, and also compute the padding pixels between rows.
    direct: bool,
    /// Whether tiles read the input in place of planes.
    in_place: bool,
    /// Phases computed together per tile: all if their pixels alternate within rows and are written together, else 1.
    joined: usize,
    /// Per phase, whether it reads the same panels as the previous phase.
    repeats: Vec<bool>,
    x: &'a [f32],
    weights: Factors<'a>,
    bias: &'a [f32],
    activation: Activation,
    out: Shared,
    before: Option<Shared>,
}

/// Part of the output that one task computes.
struct Part {
    group: usize,
    images: Range<usize>,
    rows: Range<usize>,
    features: Range<usize>,
}

impl Correlation {
    /// Computes all outputs.
    pub fn run(&self, t: Tensors) {
        assert_eq!(t.x.len(), self.batch * self.groups * self.channels * self.input[0] * self.input[1], "convolution: input");
        assert_eq!(t.out.len(), self.batch * self.groups * self.features * self.output[0] * self.output[1], "convolution: output");
        assert!(t.bias.is_empty() || t.bias.len() == self.groups * self.features, "convolution: bias");
        assert!(t.before.as_ref().is_none_or(|b| b.len() == t.out.len()), "convolution: values before the activation");
        if t.out.is_empty() {
            return;
        }
        if self.channels == 1 && self.features <= 2 {
            return depthwise::run(self, t);
        }
        let Err(t) = winograd::run(self, t) else { return };
        let Err(t) = paired::run(self, t) else { return };
        self.with_factors(t.weights, |weights| self.run_tiles(weights, t));
    }

    /// Computes all outputs in tiles of output channels and pixels.
    fn run_tiles(&self, weights: Factors, t: Tensors) {
        let level = simd::level();
        let job = self.job(weights, t, kernel(level));
        let parts = self.features.div_ceil(job.features);
        let tasks = self.groups * job.bands.len() * parts;
        let part = |i: usize| {
            let (band, part) = (i / parts % job.bands.len(), i % parts);
            let (images, rows) = job.bands.band(band);
            let features = part * job.features..((part + 1) * job.features).min(self.features);
            Part { group: i / parts / job.bands.len(), images, rows, features }
        };
        (0..tasks).into_par_iter().for_each(|i| {
            // The likely next task of this thread, unless it reads the same input.
            let next = (i + 1 < tasks).then(|| part(i + 1)).filter(|_| (i + 1).is_multiple_of(parts));
            simd::with_level(level, || with_scratch(|scratch| job.compute(&part(i), next.as_ref(), scratch)));
        });
    }

    fn job<'a>(&'a self, weights: Factors<'a>, t: Tensors<'a>, kernel: &'static Kernel) -> Job<'a> {
        let mut planes = Planes::default();
        planes.update(self.input, self.step, self.phases.iter().flat_map(|p| &p.taps).map(|t| t.at));
        let most = |i: usize| self.phases.iter().map(|p| p.size[i]).max().unwrap_or(0);
        let (rows, columns) = (most(0), most(1));
        let in_place = self.is_pointwise();
        let waste = planes.pitch_of(columns) - columns;
        // Computing padding pixels costs time per output channel; packing a panel costs the same for any number of channels.
        let direct = !in_place && !self.is_rounded() && rows * columns > FEWEST && waste * self.features <= 4 * columns;
        let (features, pixels) = self.divide(rows, columns, kernel);
        // The passes fix the order of sums, so they must not depend on the thread count: direct reads handle one image at a time.
        let pixels = if direct { pixels.min(2 * rows * columns - 1) } else { pixels };
        let pitch = if direct { planes.pitch_of(columns) } else { columns };
        let bands = Bands::plan(self.batch, rows, columns, pixels).fitted(columns, pitch, kernel.width());
        planes.fit(bands.images, bands.rows, columns);
        let taps = self.phases.iter().map(|p| p.taps.len()).max().unwrap_or(0).max(1);
        let block = if in_place {
            POINTWISE_TERMS
        } else if direct {
            DIRECT / (planes.rows_per_channel() * (kernel.width() + 16))
        } else {
            TERMS / taps
        };
        let blocks = self.channels.div_ceil(block.max(1)).max(1);
        let block = self.channels.div_ceil(blocks);
        let channel = if in_place { self.input[0] * self.input[1] } else { planes.channel };
        let first = |i: usize| self.phases[..i].iter().map(|p| p.taps.len()).sum();
        let phases = self.phases.iter().enumerate();
        let terms = phases
            .map(|(i, p)| self.terms(p, |c, t| weights.offset(self, first(i), p, c, t), &planes, [block, channel, kernel.width()]))
            .collect();
        Job {
            c: self,
            kernel,
            planes,
            bands,
            terms,
            block,
            features,
            direct,
            in_place,
            joined: if self.alternates() { self.phases.len() } else { 1 },
            repeats: (0..self.phases.len()).map(|i| i > 0 && self.reads_the_same(i - 1, i)).collect(),
            x: t.x,
            weights,
            bias: t.bias,
            activation: t.activation,
            out: Shared(t.out.as_mut_ptr()),
            before: t.before.map(|b| Shared(b.as_mut_ptr())),
        }
    }

    /// Output channels and pixels per task; splits channels only if there are more weights per input channel than pixels.
    fn divide(&self, rows: usize, columns: usize, kernel: &Kernel) -> (usize, usize) {
        let taps: usize = self.phases.iter().map(|p| p.taps.len()).sum();
        let all = self.batch * rows * columns;
        let threads = rayon::current_num_threads();
        let budget = |features: usize| SUMS / (features * self.phases.len()).max(1);
        let mut features = self.features;
        let heavy = self.features * taps > all;
        if heavy {
            let parts = (3 * threads).div_ceil(self.groups).min(self.features.div_ceil(8 * kernel.rows)).max(1);
            features = self.features.div_ceil(parts).next_multiple_of(kernel.rows);
        }
        let tasks = self.groups * self.features.div_ceil(features.max(1));
        let per_thread = match (heavy, self.is_pointwise()) {
            (true, _) => 3,
            // Tasks of a pointwise convolution cost little more if they are small.
            (_, true) => 12,
            _ => 8,
        };
        let share = all.div_ceil((per_thread * threads).div_ceil(tasks.max(1)));
        (features, budget(features).min(share.max(FEWEST)).max(1))
    }

    /// Terms of `block` channels that are `channel` floats apart, with weights at `weight(channel, tap)`; `width` is that of a panel.
    fn terms(&self, phase: &Phase, weight: impl Fn(usize, usize) -> usize, planes: &Planes, [block, channel, width]: [usize; 3]) -> Terms {
        let mut terms = Terms { to_block: weight(block, 0) - weight(0, 0), ..Terms::default() };
        for c in 0..block {
            for (t, tap) in phase.taps.iter().enumerate() {
                let weight = offset(weight(c, t));
                terms.panel.push((weight, offset(terms.panel.len() * width)));
                terms.planes.push((weight, offset(c * channel + planes.offset(tap.at))));
            }
        }
        terms
    }
}

/// Grid cells of a phase within a band.
struct Cells<'a> {
    phase: &'a Phase,
    images: Range<usize>,
    rows: Range<usize>,
}

impl Job<'_> {
    /// Passes over blocks of input channels; the last one finishes the outputs.
    fn compute(&self, part: &Part, next: Option<&Part>, scratch: &mut Scratch) {
        let (c, width) = (self.c, self.kernel.width());
        let passes = c.channels.div_ceil(self.block.max(1)).max(1);
        let tiles: usize = c.phases.iter().map(|p| self.cells(&self.clip(p, part)).div_ceil(width)).sum();
        let Scratch { planes, panel, sums, segments, taps, rounded, .. } = scratch;
        // Whole vectors also read beyond the last channel; those values are dropped.
        let planes = aligned(planes, if self.in_place { 0 } else { self.block * self.planes.channel + self.planes.image + 2 * width });
        let most = self.terms.iter().map(|t| t.panel.len()).max().unwrap_or(0);
        let panel = aligned(panel, if self.direct { 0 } else { (most + 1) * width });
        let kept = if passes > 1 { tiles } else { self.joined };
        let sums = aligned(sums, kept * part.features.len() * width);
        for pass in 0..passes {
            let channels = pass * self.block..((pass + 1) * self.block).min(c.channels);
            if !self.in_place {
                let pixels = c.input[0] * c.input[1];
                let source = Source { data: self.x, image_stride: c.groups * c.channels * pixels, first_channel: part.group * c.channels };
                self.planes.fill(source, channels.clone(), part.images.clone(), part.rows.start, planes);
            }
            let ahead = if pass + 1 < passes { Some((part, pass + 1)) } else { next.map(|n| (n, 0)) };
            let mut later = ahead.filter(|_| !self.in_place).map(|next| Later::new(self.input_of(next), self.pieces(part, channels.len())));
            let mut tile = 0;
            for ((phases, terms), repeats) in
                c.phases.chunks(self.joined).zip(self.terms.chunks(self.joined)).zip(self.repeats.chunks(self.joined))
            {
                let cells = self.clip(&phases[0], part);
                if c.is_rounded() {
                    self.pack_weights(part, pass, &terms[0], channels.len() * phases[0].taps.len(), taps, rounded);
                }
                for first in (0..self.cells(&cells)).step_by(width) {
                    self.segments(&cells, first, segments);
                    let at = if passes > 1 { tile * part.features.len() * width } else { 0 };
                    let sums = &mut sums[at..at + phases.len() * part.features.len() * width];
                    for ((i, phase), terms) in phases.iter().enumerate().zip(terms) {
                        let step = Step {
                            part,
                            channels: channels.clone(),
                            taps: phase.taps.len(),
                            terms,
                            first,
                            segments,
                            pass,
                            last: pass + 1 == passes,
                            share: if phases.len() > 1 { (i % 2, 2) } else { (0, 1) },
                            to: (phase.start[0] - phases[0].start[0]) * c.output[1],
                            repeats: i > 0 && repeats[i],
                        };
                        self.tile(&step, (planes, panel), &mut sums[i * part.features.len() * width..], rounded, &mut later);
                        tile += 1;
                    }
                    if pass + 1 == passes && self.joined > 1 {
                        for (phases, sums) in phases.chunks(2).zip(sums.chunks_mut(2 * part.features.len() * width)) {
                            self.finish_both(segments, phases[0].start[0] * c.output[1], part, sums);
                        }
                    }
                }
            }
        }
    }

    /// Pieces of memory that all tiles of a pass over that many channels prefetch.
    fn pieces(&self, part: &Part, channels: usize) -> usize {
        let blocks = part.features.len().div_ceil(self.kernel.rows);
        let tiles = |p| self.cells(&self.clip(p, part)).div_ceil(self.kernel.width());
        self.c.phases.iter().map(|p| tiles(p) * blocks * Ahead::pieces(channels * p.taps.len())).sum()
    }

    /// Input that a pass copies.
    fn input_of(&self, (part, pass): (&Part, usize)) -> Run {
        let c = self.c;
        let channels = pass * self.block..((pass + 1) * self.block).min(c.channels);
        let (read, size) = (self.planes.rows_of(part.rows.clone()), c.input[0] * c.input[1]);
        let first = part.images.start * c.groups * c.channels + part.group * c.channels + channels.start;
        Run {
            from: self.x.as_ptr().wrapping_add(first * size + read.start * c.input[1]),
            len: read.len() * c.input[1],
            images: part.images.len(),
            channels: channels.len(),
            to_channel: size,
            to_image: (c.groups * c.channels - channels.len() + 1) * size,
        }
    }

    /// Prefetch of the pixels after a tile's, if the input is read in place: the share of the tile's `i`th block of output channels.
    fn pixels_ahead(&self, s: &Step, channels: usize, i: usize) -> Option<Ahead> {
        let (last, first) = (s.segments.last()?, i * Ahead::pieces(channels));
        if !self.in_place || first >= channels {
            return None;
        }
        let size = self.c.input[0] * self.c.input[1];
        let channel = s.part.group * self.c.channels + s.channels.start + first;
        Some(Ahead::rows(self.x.as_ptr().wrapping_add(channel * size + last.from + last.len), size))
    }

    fn clip<'a>(&self, phase: &'a Phase, part: &Part) -> Cells<'a> {
        let end = part.rows.end.min(phase.size[0]);
        Cells { phase, images: part.images.clone(), rows: part.rows.start.min(end)..end }
    }

    /// Number of cells, including the padding between rows with direct reads.
    fn cells(&self, cells: &Cells) -> usize {
        let columns = cells.phase.size[1];
        match cells.rows.len() {
            0 => 0,
            rows if self.direct => (rows - 1) * self.planes.pitch + columns,
            rows => cells.images.len() * rows * columns,
        }
    }

    /// Lists the contiguous runs of pixels of the tile that starts at cell `first`.
    fn segments(&self, cells: &Cells, first: usize, out: &mut Vec<Segment>) {
        let c = self.c;
        let columns = cells.phase.size[1];
        let (width, end) = (self.kernel.width(), self.cells(cells));
        let pitch = if self.direct { self.planes.pitch } else { columns };
        out.clear();
        let mut i = first;
        while i < end.min(first + width) {
            let (row, column) = (i / pitch, i % pitch);
            let run = (pitch - column).min(end.min(first + width) - i);
            let len = run.min(columns.saturating_sub(column));
            let (image, row) = (row / cells.rows.len(), row % cells.rows.len());
            let y = cells.rows.start + row;
            let from = if self.in_place {
                ((cells.images.start + image) * c.groups * c.channels * c.input[0] + y) * c.input[1] + column
            } else {
                image * self.planes.image + row * self.planes.pitch + column
            };
            let channel = (cells.images.start + image) * c.groups * c.features;
            let pixel = [cells.phase.start[0] + y * c.spread[0], cells.phase.start[1] + column * c.spread[1]];
            let to = (channel * c.output[0] + pixel[0]) * c.output[1] + pixel[1];
            match out.last_mut() {
                Some(s) if c.spread[1] == 1 && s.from + s.len == from && s.to + s.len == to => s.len += len,
                _ if len > 0 => out.push(Segment { from, at: i - first, len, to }),
                _ => {}
            }
            i += run;
        }
    }

    /// Computes one tile of pixels for all output channels of the part.
    fn tile(&self, s: &Step, memory: (&[f32], &mut [f32]), sums: &mut [f32], rounded: &mut Rounded, later: &mut Option<Later>) {
        let (planes, panel) = memory;
        let Some(last) = s.segments.last() else { return };
        let (c, width, lanes) = (self.c, self.kernel.width(), self.kernel.lanes);
        let vectors = (last.at + last.len).div_ceil(lanes);
        let count = s.channels.len() * s.taps;
        let (b, offsets) = if self.direct {
            (planes[s.first..].as_ptr(), &s.terms.planes[..count])
        } else {
            let from = if self.in_place {
                self.x[(s.part.group * c.channels + s.channels.start) * c.input[0] * c.input[1]..].as_ptr()
            } else {
                planes.as_ptr()
            };
            let pack = Pack {
                from,
                offsets: &s.terms.planes[..count],
                segments: s.segments,
                panel: panel.as_mut_ptr(),
                width,
                exact: self.in_place,
            };
            if !s.repeats {
                // SAFETY: segments lie inside the input or the planes, which extend by more than a vector; the panel has an extra row.
                unsafe { self.kernel.pack(&pack) };
            }
            (panel.as_ptr(), &s.terms.panel[..count])
        };
        if self.c.is_rounded() {
            if let Some(later) = later {
                later.fetch(s.part.features.len().div_ceil(self.kernel.rows) * Ahead::pieces(count));
            }
            return self.rounded_tile(s, &panel[..count * width], last.at + last.len, sums, rounded);
        }
        let (straight, pixels) = (self.straight(s), c.output[0] * c.output[1]);
        for (i, feature) in s.part.features.clone().enumerate().step_by(self.kernel.rows) {
            let rows = self.kernel.rows.min(s.part.features.end - feature);
            let ahead = match later {
                Some(later) => later.next(Ahead::pieces(count)),
                None => self.pixels_ahead(s, count, i / self.kernel.rows),
            };
            let ahead = ahead.unwrap_or(Ahead::none(b));
            let weights = s.part.group * self.weights.group + feature * self.weights.feature + s.pass * s.terms.to_block;
            let global = s.part.group * c.features + feature;
            let start = match s.channels.start {
                0 if self.bias.is_empty() => Start::Zero,
                0 => Start::Bias(self.bias[global..global + rows].as_ptr()),
                _ => Start::Accumulate,
            };
            if s.last {
                self.fetch_outputs(s, global, rows);
            }
            let sums = &mut sums[i * width..(i + rows) * width];
            let (to, to_row) = match straight {
                // SAFETY: the segment lies inside the output.
                Some(s) => (unsafe { self.out.at(global * pixels + s.to) }, pixels),
                None => (sums.as_mut_ptr(), width),
            };
            let tile = Tile {
                a: self.weights.data[weights..].as_ptr(),
                row: self.weights.feature,
                b,
                offsets,
                c: to,
                c_row: to_row,
                c_vector: lanes,
                start,
                ahead,
                pairs: None,
            };
            // SAFETY: weights of `rows` features exist from there; planes and panel hold all offsets; sums have rows · width floats, and
            // the rows of the output have the segment's whole vectors.
            unsafe { self.kernel.run(rows, vectors, &tile) };
            match straight {
                Some(segment) => self.activate_outputs(segment, global, rows),
                None if s.last && self.joined == 1 => self.finish(s.segments, global, rows, sums),
                None => {}
            }
        }
    }

    /// Gathers the weights of a pass, `[features, terms]`, and rounds them to bf16.
    fn pack_weights(&self, part: &Part, pass: usize, terms: &Terms, count: usize, gathered: &mut Vec<f32>, rounded: &mut Rounded) {
        gathered.clear();
        for feature in part.features.clone() {
            let first = part.group * self.weights.group + feature * self.weights.feature + pass * terms.to_block;
            gathered.extend(terms.panel[..count].iter().map(|t| self.weights.data[first + t.0 as usize]));
        }
        rounded.pack(&product_of(part.features.len(), count, 0, View::rows(gathered, count), &[], 0));
    }

    /// Computes one tile from its panel with factors rounded to bf16.
    fn rounded_tile(&self, s: &Step, panel: &[f32], cells: usize, sums: &mut [f32], rounded: &mut Rounded) {
        let (width, rows) = (self.kernel.width(), self.kernel.rows);
        let first = s.part.group * self.c.features + s.part.features.start;
        if s.channels.start == 0 {
            for (i, sums) in sums.chunks_exact_mut(width).enumerate() {
                sums.fill(self.bias.get(first + i).copied().unwrap_or(0.0));
            }
        }
        let g = product_of(s.part.features.len(), s.channels.len() * s.taps, cells, View::rows(&[], 0), panel, width);
        // SAFETY: the weights of this pass are packed; sums have a row for each output channel.
        unsafe { rounded.multiply(&g, sums.as_mut_ptr()) };
        if s.last {
            for (i, sums) in sums.chunks_mut(rows * width).enumerate() {
                self.finish(s.segments, first + i * rows, sums.len() / width, sums);
            }
        }
    }
}

/// `c += a b`, where the rows of B and C are `width` floats apart.
fn product_of<'a>(m: usize, k: usize, n: usize, a: View<'a>, b: &'a [f32], width: usize) -> Gemm<'a> {
    Gemm { m, n, k, a, b, ldb: width, ldc: width, init: Init::Accumulate, relu: false }
}

/// One pass over one tile.
struct Step<'a> {
    part: &'a Part,
    channels: Range<usize>,
    taps: usize,
    terms: &'a Terms,
    first: usize,
    segments: &'a [Segment],
    pass: usize,
    last: bool,
    /// (First row, stride) of the output rows that it prefetches: paired phases write to the same rows.
    share: (usize, usize),
    /// Floats from the outputs of the segments to those of this phase.
    to: usize,
    /// Whether the panel is already packed.
    repeats: bool,
}
