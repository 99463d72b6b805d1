//! Sums over channels and taps for every pixel of the output, vectors along pixels: forward passes and gradients of inputs.

use super::activate;
use super::bands::{Bands, Scratch, aligned, with_scratch};
use super::depthwise;
use super::planes::{Planes, Source};
use super::shapes::{Correlation, Phase, Tensors, offset};
use super::winograd;
use crate::gemm::{Gemm, Init, Precision, Rounded, View, has_bf16};
use crate::ops::activation::Activation;
use crate::simd;
use crate::tile::{Kernel, Pack, Segment, Shared, Start, Tile, kernel};
use rayon::prelude::*;
use std::ops::Range;

/// Floats of the input that a tile reads per pass where it reads the copy itself, so that they stay in the first-level cache.
const DIRECT: usize = 6 << 10;
/// Terms of a sum per pass where it reads a panel.
const TERMS: usize = 192;
/// Floats of sums that a band keeps between passes.
const SUMS: usize = 96 << 10;
/// Portions in which the input of a later pass is asked of memory.
const FETCHES: usize = 1 << 16;
/// Fewest pixels that a band is cut into to keep all threads busy.
const FEWEST: usize = 192;

/// Per term of a pass, where weight and input stand: in the input's planes, and in a panel.
#[derive(Clone, Debug, Default)]
struct Terms {
    planes: Vec<(u32, u32)>,
    panel: Vec<(u32, u32)>,
}

/// A correlation on its way, as all threads see it.
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
    /// Whether tiles read the planes themselves, with the pixels between rows among theirs.
    direct: bool,
    /// Whether the input itself serves as planes.
    in_place: bool,
    x: &'a [f32],
    weights: &'a [f32],
    bias: &'a [f32],
    activation: Activation,
    out: Shared,
    before: Option<Shared>,
}

/// What a task works on.
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
        let level = simd::level();
        let job = self.job(t, kernel(level));
        let parts = self.features.div_ceil(job.features);
        let tasks = self.groups * job.bands.len() * parts;
        let part = |i: usize| {
            let (band, part) = (i / parts % job.bands.len(), i % parts);
            let (images, rows) = job.bands.band(band);
            let features = part * job.features..((part + 1) * job.features).min(self.features);
            Part { group: i / parts / job.bands.len(), images, rows, features }
        };
        (0..tasks).into_par_iter().for_each(|i| {
            // The task that this thread most likely does next, unless it reads the same.
            let next = (i + 1 < tasks).then(|| part(i + 1)).filter(|_| (i + 1).is_multiple_of(parts));
            simd::with_level(level, || with_scratch(|scratch| job.compute(&part(i), next.as_ref(), scratch)));
        });
    }

    fn job<'a>(&'a self, t: Tensors<'a>, kernel: &'static Kernel) -> Job<'a> {
        let mut planes = Planes::default();
        planes.update(self.input, self.step, self.phases.iter().flat_map(|p| &p.taps).map(|t| t.at));
        let most = |i: usize| self.phases.iter().map(|p| p.size[i]).max().unwrap_or(0);
        let (rows, columns) = (most(0), most(1));
        let in_place = self.is_pointwise();
        let waste = planes.pitch_of(columns) - columns;
        // Pixels between rows cost time in proportion to the output channels, a panel costs the same for any number.
        let direct = !in_place && !self.is_rounded() && rows * columns > FEWEST && waste * self.features <= 4 * columns;
        let (features, pixels) = self.divide(rows, columns, kernel);
        let bands = Bands::plan(self.batch, rows, columns, pixels);
        let direct = direct && bands.images == 1;
        planes.fit(bands.images, bands.rows, columns);
        let taps = self.phases.iter().map(|p| p.taps.len()).max().unwrap_or(0).max(1);
        let block = if direct { DIRECT / (planes.rows_per_channel() * (kernel.width() + 16)) } else { TERMS / taps };
        let blocks = self.channels.div_ceil(block.max(1)).max(1);
        let block = self.channels.div_ceil(blocks);
        let channel = if in_place { self.input[0] * self.input[1] } else { planes.channel };
        let terms = self.phases.iter().map(|p| self.terms(p, &planes, block, channel, kernel.width())).collect();
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
            x: t.x,
            weights: t.weights,
            bias: t.bias,
            activation: t.activation,
            out: Shared(t.out.as_mut_ptr()),
            before: t.before.map(|b| Shared(b.as_mut_ptr())),
        }
    }

    /// Whether factors are rounded to bf16.
    pub(super) fn is_rounded(&self) -> bool {
        self.precision == Precision::Bf16 && has_bf16()
    }

    /// Whether every output pixel has one tap: the input pixel at its place.
    fn is_pointwise(&self) -> bool {
        let [p] = &self.phases[..] else { return false };
        let [tap] = &p.taps[..] else { return false };
        tap.at == [0; 2] && self.step == [1; 2] && self.spread == [1; 2] && self.input == self.output && p.size == self.output
    }

    /// Output channels and pixels per task. Cut by channels where weights outweigh pixels, as each task reads all of its own of both.
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
        let share = all.div_ceil((if heavy { 3 } else { 8 } * threads).div_ceil(tasks.max(1)));
        (features, budget(features).min(share.max(FEWEST)).max(1))
    }

    fn terms(&self, phase: &Phase, planes: &Planes, block: usize, channel: usize, width: usize) -> Terms {
        let mut terms = Terms::default();
        for c in 0..block {
            for tap in &phase.taps {
                let weight = offset(c * self.weight_channel + tap.weight);
                terms.panel.push((weight, offset(terms.panel.len() * width)));
                terms.planes.push((weight, offset(c * channel + planes.offset(tap.at))));
            }
        }
        terms
    }
}

/// Pixels of a tile's phase and band.
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
        // What lies beyond the last channel is read by whole vectors, and dropped.
        let planes = aligned(planes, if self.in_place { 0 } else { self.block * self.planes.channel + self.planes.image + 2 * width });
        let most = self.terms.iter().map(|t| t.panel.len()).max().unwrap_or(0);
        let panel = aligned(panel, if self.direct { 0 } else { (most + 1) * width });
        let kept = if passes > 1 { tiles } else { 1 };
        let sums = aligned(sums, kept * part.features.len() * width);
        for pass in 0..passes {
            let channels = pass * self.block..((pass + 1) * self.block).min(c.channels);
            if !self.in_place {
                let pixels = c.input[0] * c.input[1];
                let source = Source { data: self.x, image_stride: c.groups * c.channels * pixels, first_channel: part.group * c.channels };
                self.planes.fill(source, channels.clone(), part.images.clone(), part.rows.start, planes);
            }
            let ahead = if pass + 1 < passes { Some((part, pass + 1)) } else { next.map(|n| (n, 0)) };
            let ahead = ahead.filter(|_| !self.in_place);
            let mut tile = 0;
            for (phase, terms) in c.phases.iter().zip(&self.terms) {
                let cells = self.clip(phase, part);
                if self.c.is_rounded() {
                    self.pack_weights(part, &channels, &terms.panel[..channels.len() * phase.taps.len()], taps, rounded);
                }
                for first in (0..self.cells(&cells)).step_by(width) {
                    self.segments(&cells, first, segments);
                    let at = if passes > 1 { tile * part.features.len() * width } else { 0 };
                    let sums = &mut sums[at..at + part.features.len() * width];
                    let step =
                        Step { part, channels: channels.clone(), taps: phase.taps.len(), terms, first, segments, last: pass + 1 == passes };
                    if let Some((part, pass)) = ahead {
                        self.fetch(part, pass, tile * FETCHES / tiles..(tile + 1) * FETCHES / tiles);
                    }
                    self.tile(&step, planes, panel, sums, rounded);
                    tile += 1;
                }
            }
        }
    }

    /// Asks memory for a part, in `FETCHES`, of what a later pass copies.
    fn fetch(&self, part: &Part, pass: usize, share: Range<usize>) {
        let c = self.c;
        let channels = pass * self.block..((pass + 1) * self.block).min(c.channels);
        let planes = part.images.len() * channels.len();
        for i in share.start * planes / FETCHES..share.end * planes / FETCHES {
            let (image, channel) = (part.images.start + i / channels.len(), channels.start + i % channels.len());
            let plane = (image * c.groups + part.group) * c.channels + channel;
            let rows = self.planes.rows_of(part.rows.clone());
            simd::fetch(&self.x[(plane * c.input[0] + rows.start) * c.input[1]..(plane * c.input[0] + rows.end) * c.input[1]]);
        }
    }

    fn clip<'a>(&self, phase: &'a Phase, part: &Part) -> Cells<'a> {
        let end = part.rows.end.min(phase.size[0]);
        Cells { phase, images: part.images.clone(), rows: part.rows.start.min(end)..end }
    }

    /// How many cells there are, with those between rows where they are computed too.
    fn cells(&self, cells: &Cells) -> usize {
        let columns = cells.phase.size[1];
        match cells.rows.len() {
            0 => 0,
            rows if self.direct => (rows - 1) * self.planes.pitch + columns,
            rows => cells.images.len() * rows * columns,
        }
    }

    /// The runs of pixels that a tile has from cell `first` on.
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

    /// One tile of pixels for all output channels of the part.
    fn tile(&self, s: &Step, planes: &[f32], panel: &mut [f32], sums: &mut [f32], rounded: &mut Rounded) {
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
            // SAFETY: segments lie inside the input or the planes, which go on for more than a vector; the panel has a row more.
            unsafe { self.kernel.pack(&pack) };
            (panel.as_ptr(), &s.terms.panel[..count])
        };
        if self.c.is_rounded() {
            return self.rounded_tile(s, &panel[..count * width], last.at + last.len, sums, rounded);
        }
        for (i, feature) in s.part.features.clone().enumerate().step_by(self.kernel.rows) {
            let rows = self.kernel.rows.min(s.part.features.end - feature);
            let weights = s.part.group * c.weight_group + feature * c.weight_feature + s.channels.start * c.weight_channel;
            let global = s.part.group * c.features + feature;
            let start = match s.channels.start {
                0 if self.bias.is_empty() => Start::Zero,
                0 => Start::Bias(self.bias[global..global + rows].as_ptr()),
                _ => Start::Accumulate,
            };
            if s.last {
                self.fetch_outputs(s.segments, global, rows);
            }
            let sums = &mut sums[i * width..(i + rows) * width];
            let tile = Tile {
                a: self.weights[weights..].as_ptr(),
                row: c.weight_feature,
                b,
                offsets,
                c: sums.as_mut_ptr(),
                c_row: width,
                c_vector: lanes,
                start,
            };
            // SAFETY: weights of `rows` features exist from there; planes and panel hold all offsets; sums have rows · width floats.
            unsafe { self.kernel.run(rows, vectors, &tile) };
            if s.last {
                self.finish(s.segments, global, rows, sums);
            }
        }
    }

    /// Rounds the weights of a pass: `[features, terms]`, gathered where their channels do not follow one another.
    fn pack_weights(&self, part: &Part, channels: &Range<usize>, terms: &[(u32, u32)], gathered: &mut Vec<f32>, rounded: &mut Rounded) {
        let c = self.c;
        gathered.clear();
        for feature in part.features.clone() {
            let first = part.group * c.weight_group + feature * c.weight_feature + channels.start * c.weight_channel;
            gathered.extend(terms.iter().map(|t| self.weights[first + t.0 as usize]));
        }
        rounded.pack(&product_of(part.features.len(), terms.len(), 0, View::rows(gathered, terms.len()), &[], 0));
    }

    /// One tile on factors rounded to bf16, from its panel.
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

    /// Asks memory for the outputs that a tile will write.
    fn fetch_outputs(&self, segments: &[Segment], channel: usize, rows: usize) {
        let (pixels, spread) = (self.c.output[0] * self.c.output[1], self.c.spread[1]);
        for r in 0..rows {
            for s in segments {
                simd::fetch_to_write(self.out.0.wrapping_add((channel + r) * pixels + s.to), s.len * spread);
            }
        }
    }

    /// Writes the outputs of some channels from their sums.
    fn finish(&self, segments: &[Segment], channel: usize, rows: usize, sums: &mut [f32]) {
        if let Some(before) = self.before {
            self.store(segments, channel, rows, sums, before);
        }
        activate(self.activation, sums);
        self.store(segments, channel, rows, sums, self.out);
    }

    fn store(&self, segments: &[Segment], channel: usize, rows: usize, sums: &[f32], out: Shared) {
        let (width, pixels, spread) = (self.kernel.width(), self.c.output[0] * self.c.output[1], self.c.spread[1]);
        for (r, sums) in sums.chunks_exact(width).enumerate().take(rows) {
            for s in segments {
                let from = &sums[s.at..s.at + s.len];
                // SAFETY: the pixels of a segment are this task's own, and lie inside the output, whose length `run` checked.
                unsafe {
                    let to = out.at((channel + r) * pixels + s.to);
                    if spread == 1 {
                        std::ptr::copy_nonoverlapping(from.as_ptr(), to, s.len);
                    } else {
                        for (i, v) in from.iter().enumerate() {
                            *to.add(i * spread) = *v;
                        }
                    }
                }
            }
        }
    }
}

/// `c += a b` with rows of B and C as far apart as those of a panel.
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
    last: bool,
}
