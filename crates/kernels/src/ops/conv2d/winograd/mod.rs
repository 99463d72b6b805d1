//! Winograd's minimal filtering of 3×3 kernels: fewer products per output, of sums of inputs and sums of weights.
//!
//! Outputs are computed in tiles of 2×2. Over channels, the products of all tiles are matrix products.

mod double;
mod unit;

use super::activate;
use super::bands::{Scratch, aligned, with_scratch};
use super::later::{Later, Run};
use super::planes::{Planes, copy_rows};
use super::shapes::{Correlation, Tensors, offset};
use crate::ops::activation::Activation;
use crate::simd::{self, Lane};
use crate::tile::{Ahead, Kernel, Shared, Start, Tile, kernel};
use rayon::prelude::*;
use std::cell::Cell;
use std::ops::Range;

/// Floats of a cache line.
const LINE: usize = 16;
/// Transformed weights of a kernel.
const WEIGHTS: usize = 16;
/// Most rows of the input that a tile reads.
const REACH: usize = 5;
/// Output channels whose weights alternate, so that a tile reads its weights in the order of memory.
const ROWS: usize = 8;
/// Kernels transformed together: those of two input channels and as many output channels as alternate.
const LANES: usize = 2 * ROWS;
/// Floats of products that a task keeps, so that they fit in the L2 cache.
const PRODUCTS: usize = 192 << 10;
/// Fewest output channels of a task, because each task transforms its inputs again.
const FEWEST_FEATURES: usize = 32;

thread_local! {
    static TRANSFORMED: Cell<Vec<f32>> = const { Cell::new(Vec::new()) };
}

/// The minimal filtering of one stride.
struct Form {
    /// Input pixels from one output to the next.
    step: usize,
    /// Rows of the input that a tile reads.
    reach: usize,
    /// Transformed inputs of a tile, as many as products.
    inputs: usize,
    /// Input channels per pass.
    channels: usize,
    /// Most tiles of a band, unless a single row has more.
    tiles: usize,
    /// Sums of products of a tile.
    sums: usize,
    /// Products (weight, input) of each sum.
    terms: fn() -> Vec<Vec<(usize, usize)>>,
    /// Transforms the inputs of one channel from its rows.
    ///
    /// # Safety
    /// The rows extend by `2 · step` vectors and floats from the last tile; the output holds whole vectors of all tiles.
    transform: unsafe fn(&[*const f32; REACH], &Strides, *mut f32),
    /// Transforms the nine weights of each lane.
    kernels: fn(&[[f32; LANES]; 9]) -> [[f32; LANES]; WEIGHTS],
    /// Adds sums and a bias up to two rows of outputs.
    ///
    /// # Safety
    /// The sums are whole vectors of all tiles, and both rows hold two vectors for each of them.
    collect: unsafe fn(*const f32, &Strides, f32, [*mut f32; 2]),
    costs: Costs,
}

/// Cycles per input and output channel, fitted to measured times with AVX-512, where a product of a vector takes half a cycle.
#[derive(Clone, Copy)]
struct Costs {
    /// Inputs of a vector of tiles, for each input channel.
    input: f64,
    /// Outputs of a vector of tiles, for each output channel.
    output: f64,
    /// Reading the weights for a band.
    band: f64,
    /// Transforming the weights.
    weight: f64,
    /// Sums over taps for a vector of outputs, and copies of their inputs for each input channel.
    direct: f64,
    copy: f64,
}

/// The form, the weight offsets of a dense 3×3 kernel row by row, and the distance of its first tap; none for other correlations.
fn square(c: &Correlation) -> Option<(&'static Form, [usize; 9], [isize; 2])> {
    let [phase] = &c.phases[..] else { return None };
    let form = [&unit::FORM, &double::FORM].into_iter().find(|f| c.step == [f.step; 2])?;
    if c.spread != [1; 2] || phase.taps.len() != 9 || phase.size != c.output {
        return None;
    }
    let low = phase.taps.iter().fold([isize::MAX; 2], |l, t| [l[0].min(t.at[0]), l[1].min(t.at[1])]);
    let mut weights = [usize::MAX; 9];
    for tap in &phase.taps {
        let [y, x] = [tap.at[0] - low[0], tap.at[1] - low[1]];
        if y > 2 || x > 2 {
            return None;
        }
        weights[(3 * y + x) as usize] = tap.weight;
    }
    weights.iter().all(|w| *w != usize::MAX).then_some((form, weights, low))
}

/// Computes all outputs if this is estimated to be faster than sums over taps; else returns the tensors.
pub fn run<'a>(c: &Correlation, t: Tensors<'a>) -> Result<(), Tensors<'a>> {
    let Some((form, taps, low)) = square(c).filter(|_| !c.is_rounded()) else { return Err(t) };
    let level = simd::level();
    let kernel = kernel(level);
    let grid = Grid::plan(c, form, kernel);
    if !grid.pays(c, kernel) {
        return Err(t);
    }
    let mut planes = Planes::default();
    let taps_of_tile = (0..form.reach as isize).flat_map(|y| (0..=2 * form.step as isize).map(move |x| [low[0] + y, low[1] + x]));
    planes.update(c.input, [2 * form.step, 1], taps_of_tile);
    planes.fit(1, grid.rows, grid.floats_per_row() - 2 * form.step);
    let mut weights = TRANSFORMED.take();
    let pitch = Pitch::of(c);
    weights.resize(c.groups * WEIGHTS * pitch.weight, 0.0);
    transform_weights(c, form, &taps, t.weights, pitch, &mut weights);
    let bands = grid.height.div_ceil(grid.rows);
    let features = grid.features(c, bands);
    let parts = c.features.div_ceil(features);
    let job = Job {
        c,
        form,
        terms: (form.terms)(),
        kernel,
        grid,
        lead: low[1].rem_euclid(LINE as isize) as usize,
        rows: std::array::from_fn(|y| planes.offset([low[0] + y.min(form.reach - 1) as isize, low[1]])),
        planes,
        x: t.x,
        weights: &weights,
        pitch,
        bias: t.bias,
        activation: t.activation,
        out: Shared(t.out.as_mut_ptr()),
        before: t.before.map(|b| Shared(b.as_mut_ptr())),
    };
    let part = |i: usize| {
        let (part, i) = (i % parts, i / parts);
        let (band, i) = (i % bands, i / bands);
        let first = band * grid.rows;
        Part {
            image: i / c.groups,
            group: i % c.groups,
            rows: first..(first + grid.rows).min(grid.height),
            features: part * features..((part + 1) * features).min(c.features),
        }
    };
    let tasks = c.batch * c.groups * bands * parts;
    (0..tasks).into_par_iter().for_each(|i| {
        // The likely next task of this thread, unless it reads the same input.
        let next = (i + 1 < tasks).then(|| part(i + 1)).filter(|_| (i + 1).is_multiple_of(parts));
        simd::with_level(level, || with_scratch(|scratch| job.compute(&part(i), next.as_ref(), scratch)));
    });
    TRANSFORMED.set(weights);
    Ok(())
}

/// Division of an image into 2×2 tiles of outputs, and of these into bands of whole rows.
#[derive(Clone, Copy)]
struct Grid {
    form: &'static Form,
    /// Tiles of an image.
    height: usize,
    columns: usize,
    /// Tiles from one row to the next: one more than columns, unless rows are whole vectors.
    pitch: usize,
    /// Rows of tiles per band.
    rows: usize,
}

impl Grid {
    /// Chooses the band height of least estimated cost, in vectors and reads of the weights.
    fn plan(c: &Correlation, form: &'static Form, kernel: &Kernel) -> Grid {
        let [height, columns] = c.output.map(|n| n.div_ceil(2).max(1));
        let pitch = if columns.is_multiple_of(kernel.lanes) { columns } else { columns + 1 };
        let of = |rows| Grid { form, height, columns, pitch, rows };
        let most = (form.tiles / pitch).clamp(1, height);
        // Transforms of a vector take about as long as three products; each band reads all weights again.
        let cost = |rows: usize| (form.inputs + 3) * of(rows).vectors_of_image(kernel) + WEIGHTS * height.div_ceil(rows);
        of((1..=most).min_by_key(|&rows| cost(rows)).unwrap_or(1))
    }

    /// Vectors of tiles in all bands of an image.
    fn vectors_of_image(&self, kernel: &Kernel) -> usize {
        let (bands, rest) = (self.height / self.rows, self.height % self.rows);
        bands * self.vectors(self.rows, kernel) + if rest > 0 { self.vectors(rest, kernel) } else { 0 }
    }

    /// Tiles of some rows, with the padding between them.
    fn tiles(&self, rows: usize) -> usize {
        (rows - 1) * self.pitch + self.columns
    }

    fn vectors(&self, rows: usize, kernel: &Kernel) -> usize {
        self.tiles(rows).div_ceil(kernel.lanes)
    }

    /// Whether the saved products outweigh the transforms.
    fn pays(&self, c: &Correlation, kernel: &Kernel) -> bool {
        let Costs { input, output, band, weight, direct, copy } = self.form.costs;
        let (features, channels) = (self.most_features(c) as f64, c.channels as f64);
        let vector = self.form.inputs as f64 / 2.0 + input / features + output / channels;
        let image = vector * self.vectors_of_image(kernel) as f64 + band * self.height.div_ceil(self.rows) as f64;
        let ours = c.batch as f64 * image + weight;
        let direct = (direct + copy / c.features as f64) * (c.batch * (c.output[0] * c.output[1]).div_ceil(kernel.lanes)) as f64;
        c.channels >= 8 && c.features >= 8 && ours < direct
    }

    /// Output channels whose products of a band stay in cache.
    fn most_features(&self, c: &Correlation) -> usize {
        (PRODUCTS / (self.form.sums * self.tiles(self.rows))).clamp(1, c.features)
    }

    /// Output channels per task.
    fn features(&self, c: &Correlation, bands: usize) -> usize {
        let most = self.most_features(c);
        let wanted = (3 * rayon::current_num_threads()).div_ceil(c.batch * c.groups * bands);
        let parts = c.features.div_ceil(most).max(wanted.min(c.features.div_ceil(FEWEST_FEATURES)));
        c.features.div_ceil(parts).next_multiple_of(8)
    }

    /// Layout of `count` transformed inputs or sums per tile, `point` floats apart.
    fn strides(&self, rows: usize, count: usize, point: usize, kernel: &Kernel) -> Strides {
        let tiles = self.tiles(rows);
        // Rows that padding separates are read as one.
        let row = if self.pitch > self.columns { tiles } else { self.columns };
        let (pixels, from_row) = (2 * self.form.step, self.floats_per_row());
        Strides { block: kernel.width(), to_block: count * point, point, tiles, row, pixels, from_row }
    }

    /// Floats of the copied input from one row of tiles to the next: whole cache lines, unless rows are read as one.
    fn floats_per_row(&self) -> usize {
        let floats = 2 * self.form.step * (self.columns + 1);
        if self.pitch > self.columns { floats } else { floats.next_multiple_of(LINE) }
    }
}

/// Outputs that one task computes.
struct Part {
    image: usize,
    group: usize,
    rows: Range<usize>,
    features: Range<usize>,
}

/// A correlation in progress, shared by all threads.
struct Job<'a> {
    c: &'a Correlation,
    form: &'static Form,
    terms: Vec<Vec<(usize, usize)>>,
    kernel: &'static Kernel,
    grid: Grid,
    planes: Planes,
    /// Floats before the copy.
    lead: usize,
    /// Offsets of a tile's rows in the copy.
    rows: [usize; REACH],
    x: &'a [f32],
    /// Transformed weights, laid out by `pitch`.
    weights: &'a [f32],
    pitch: Pitch,
    bias: &'a [f32],
    activation: Activation,
    out: Shared,
    before: Option<Shared>,
}

impl Job<'_> {
    fn compute(&self, part: &Part, next: Option<&Part>, scratch: &mut Scratch) {
        let (c, form, width, lanes) = (self.c, self.form, self.kernel.width(), self.kernel.lanes);
        let tiles = self.grid.tiles(part.rows.len());
        let (blocks, features) = (tiles.div_ceil(width), part.features.len());
        let Scratch { planes, panel, sums, offsets, .. } = scratch;
        // Whole vectors of tiles are read, even beyond the last tile. Where rows are whole cache lines, their first pixels begin one.
        let copy = &mut aligned(planes, self.planes.channel + (2 * form.step + 1) * lanes + LINE)[self.lead..];
        let inputs = aligned(panel, form.inputs * form.channels.min(c.channels) * blocks * width);
        let products = aligned(sums, form.sums * features * blocks * width + 4 * tiles.next_multiple_of(lanes));
        let (products, pixels) = products.split_at_mut(form.sums * features * blocks * width);
        // Every channel is copied to the same rows.
        copy.fill(0.0);
        for first in (0..c.channels).step_by(form.channels) {
            let channels = first..(first + form.channels).min(c.channels);
            self.transform_inputs(part, channels.clone(), offsets, copy, inputs);
            self.list_terms(channels.len(), offsets);
            let ahead = if channels.end < c.channels { Some((part, channels.end)) } else { next.map(|n| (n, 0)) };
            let of_block: usize = self.terms.iter().map(|t| Ahead::pieces(t.len() * channels.len())).sum();
            let pieces = blocks * features.div_ceil(self.kernel.rows) * of_block;
            let mut later = ahead.map(|(part, first)| Later::new(self.input_of(part, first), pieces));
            for block in 0..blocks {
                let vectors = (tiles - block * width).min(width).div_ceil(lanes);
                let inputs = &inputs[block * form.inputs * channels.len() * width..];
                let products = &mut products[block * form.sums * features * width..];
                let mut listed = 0;
                for (sum, terms) in self.terms.iter().enumerate() {
                    let terms = listed..listed + terms.len() * channels.len();
                    listed = terms.end;
                    for f in (0..features).step_by(self.kernel.rows) {
                        let ahead = later.as_mut().and_then(|l| l.next(Ahead::pieces(terms.len())));
                        let feature = part.features.start + f;
                        let at =
                            part.group * WEIGHTS * self.pitch.weight + feature / ROWS * self.pitch.block + first * ROWS + feature % ROWS;
                        let tile = Tile {
                            a: self.weights[at..].as_ptr(),
                            row: 1,
                            b: inputs.as_ptr(),
                            offsets: &offsets[terms.clone()],
                            c: products[(sum * features + f) * width..].as_mut_ptr(),
                            c_row: width,
                            c_vector: lanes,
                            start: if first == 0 { Start::Zero } else { Start::Accumulate },
                            ahead: ahead.unwrap_or(Ahead::none(inputs.as_ptr())),
                            pairs: None,
                        };
                        // SAFETY: weights of that many output channels exist from there, inputs of all channels, and their products.
                        unsafe { self.kernel.run(self.kernel.rows.min(features - f), vectors, &tile) };
                    }
                }
            }
        }
        for (f, feature) in part.features.clone().enumerate() {
            self.finish(part, feature, &products[f * width..], features, pixels);
        }
    }

    /// Offsets of the products of all sums, each over `channels`.
    fn list_terms(&self, channels: usize, out: &mut Vec<(u32, u32)>) {
        out.clear();
        for &(weight, input) in self.terms.iter().flatten() {
            out.extend(
                (0..channels)
                    .map(|c| (offset(weight * self.pitch.weight + c * ROWS), offset((input * channels + c) * self.kernel.width()))),
            );
        }
    }

    /// Input that a pass from channel `first` on reads.
    fn input_of(&self, part: &Part, first: usize) -> Run {
        let c = self.c;
        let read = self.planes.rows_of(part.rows.clone());
        let plane = (part.image * c.groups + part.group) * c.channels + first;
        Run {
            from: self.x.as_ptr().wrapping_add((plane * c.input[0] + read.start) * c.input[1]),
            len: read.len() * c.input[1],
            images: 1,
            channels: self.form.channels.min(c.channels - first),
            to_channel: c.input[0] * c.input[1],
            to_image: 0,
        }
    }

    /// Writes the transformed inputs of some channels: `[block, input, channel, width]`.
    fn transform_inputs(&self, part: &Part, channels: Range<usize>, rows: &mut Vec<(u32, u32)>, copy: &mut [f32], out: &mut [f32]) {
        let (c, count) = (self.c, channels.len());
        let pixels = c.input[0] * c.input[1];
        let len = self.planes.list_rows(part.rows.clone(), rows);
        let to = self.grid.strides(part.rows.len(), self.form.inputs, count * self.kernel.width(), self.kernel);
        for (i, channel) in channels.enumerate() {
            let from = &self.x[((part.image * c.groups + part.group) * c.channels + channel) * pixels..][..pixels];
            // SAFETY: the rows lie inside the channel and its copy.
            unsafe { copy_rows(from.as_ptr(), rows, len, copy.as_mut_ptr()) };
            let rows = self.rows.map(|r| copy[r..].as_ptr());
            // SAFETY: the copy extends by `2 · step` vectors; `out` holds blocks of whole vectors of every channel.
            unsafe { (self.form.transform)(&rows, &to, out[i * self.kernel.width()..].as_mut_ptr()) };
        }
    }

    /// Computes and stores the outputs of one channel from its products, which start at `products[0]`.
    fn finish(&self, part: &Part, feature: usize, products: &[f32], features: usize, pixels: &mut [f32]) {
        let (c, width) = (self.c, self.kernel.width());
        let channel = part.group * c.features + feature;
        let from = self.grid.strides(part.rows.len(), self.form.sums, features * width, self.kernel);
        let bias = self.bias.get(channel).copied().unwrap_or(0.0);
        let half = pixels.len() / 2;
        let (top, bottom) = pixels.split_at_mut(half);
        // SAFETY: products are blocks of whole vectors, and each row has room for two vectors per vector of tiles.
        unsafe { (self.form.collect)(products.as_ptr(), &from, bias, [top.as_mut_ptr(), bottom.as_mut_ptr()]) };
        if let Some(before) = self.before {
            self.store(part, channel, [top, bottom], before);
        }
        for row in [&mut *top, &mut *bottom] {
            activate(self.activation, row);
        }
        self.store(part, channel, [top, bottom], self.out);
    }

    /// Copies rows of outputs to `out`.
    fn store(&self, part: &Part, channel: usize, pixels: [&[f32]; 2], out: Shared) {
        let c = self.c;
        let [height, width] = c.output;
        let plane = (part.image * c.groups * c.features + channel) * height;
        for (i, row) in part.rows.clone().enumerate() {
            for (y, pixels) in (2 * row..height).zip(pixels) {
                let from = &pixels[2 * i * self.grid.pitch..][..width];
                // SAFETY: the row is this task's own, and lies inside the output, whose length `Correlation::run` checked.
                unsafe { std::ptr::copy_nonoverlapping(from.as_ptr(), out.at((plane + y) * width), width) };
            }
        }
    }
}

/// Layout of transformed weights `[groups, WEIGHTS, features / ROWS, channels, ROWS]`.
#[derive(Clone, Copy)]
struct Pitch {
    /// Floats between blocks of output channels.
    block: usize,
    /// Floats between weights: an odd number of cache lines, so that they do not map to the same cache set.
    weight: usize,
}

impl Pitch {
    fn of(c: &Correlation) -> Pitch {
        let block = c.channels.next_multiple_of(2) * ROWS;
        Pitch { block, weight: ((c.features.div_ceil(ROWS) * block / LINE) | 1) * LINE }
    }
}

/// Writes all transformed weights.
fn transform_weights(c: &Correlation, form: &Form, taps: &[usize; 9], weights: &[f32], pitch: Pitch, out: &mut [f32]) {
    let shared = Shared(out.as_mut_ptr());
    let level = simd::level();
    let blocks = c.features.div_ceil(ROWS);
    (0..c.groups * blocks).into_par_iter().for_each(|i| {
        let (group, block) = (i / blocks, i % blocks);
        let features = ROWS.min(c.features - block * ROWS);
        let from = &weights[group * c.weight_group + block * ROWS * c.weight_feature..];
        let at = group * WEIGHTS * pitch.weight + block * pitch.block;
        simd::with_level(level, || {
            for first in (0..c.channels).step_by(2) {
                let mut kernels = [[0.0; LANES]; 9];
                for (lane, channel) in (first..c.channels.min(first + 2)).enumerate() {
                    for feature in 0..features {
                        let from = &from[feature * c.weight_feature + channel * c.weight_channel..];
                        for (kernel, tap) in kernels.iter_mut().zip(taps) {
                            kernel[lane * ROWS + feature] = from[*tap];
                        }
                    }
                }
                for (w, values) in (form.kernels)(&kernels).into_iter().enumerate() {
                    // SAFETY: each block of output channels has its own part of every weight.
                    unsafe { shared.at(at + w * pitch.weight + first * ROWS).cast::<[f32; LANES]>().write(values) };
                }
            }
        });
    });
}

/// Layout of the transformed inputs, or the sums, of a channel's tiles: the `p`th of a tile is at
/// `⌊tile / block⌋ · to_block + p · point + tile mod block`.
struct Strides {
    /// Tiles of a block.
    block: usize,
    /// Floats between blocks.
    to_block: usize,
    /// Floats between elements of a tile.
    point: usize,
    tiles: usize,
    /// Tiles per row of the copied input.
    row: usize,
    /// Floats of the copied input from one tile to the next, and from one row of tiles to the next.
    pixels: usize,
    from_row: usize,
}

impl Strides {
    /// Offset of a tile's first element.
    #[inline(always)]
    fn at(&self, tile: usize) -> usize {
        tile / self.block * self.to_block + tile % self.block
    }

    fn rows(&self) -> usize {
        self.tiles / self.row
    }

    /// All `N · N` elements of a vector of tiles.
    ///
    /// # Safety
    /// Whole vectors of all tiles exist from `first`.
    #[inline(always)]
    unsafe fn load<L: Lane, const N: usize>(&self, first: *const f32, tile: usize) -> [[L::V; N]; N] {
        // SAFETY: guaranteed by the caller.
        unsafe {
            let mut at = first.add(self.at(tile));
            let mut elements = [[L::splat(0.0); N]; N];
            for row in &mut elements {
                for v in row {
                    *v = L::load(at);
                    at = at.add(self.point);
                }
            }
            elements
        }
    }
}
