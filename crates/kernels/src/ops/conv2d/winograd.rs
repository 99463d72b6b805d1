//! Winograd's minimal filtering F(2×2, 3×3): 16 products for 4 outputs in place of 36.
//!
//! `Y = Aᵀ [(G g Gᵀ) ⊙ (Bᵀ d B)] A` per 4×4 tile d of the input and kernel g (Lavin and Gray, "Fast Algorithms for Convolutional
//! Neural Networks", CVPR 2016, section 4.1); over channels, the products are 16 matrix products, one per element of a tile.

use super::activate;
use super::bands::{Scratch, aligned, with_scratch};
use super::planes::{Planes, Source};
use super::shapes::{Correlation, Tensors};
use crate::ops::activation::Activation;
use crate::simd;
use crate::tile::{Ahead, Kernel, Shared, Start, Tile, kernel};
use crate::vector::{by_lanes, vectorized};
use rayon::prelude::*;
use std::cell::Cell;
use std::ops::Range;

/// Elements of a transformed tile.
const POINTS: usize = 16;
/// Input channels per pass.
const CHANNELS: usize = 64;
/// Floats of products that a task keeps, so that they fit in the L2 cache.
const PRODUCTS: usize = 192 << 10;
/// Most tiles of a band, unless a single row has more.
const TILES: usize = 160;
/// Fewest output channels of a task, because each task transforms its inputs again.
const FEWEST_FEATURES: usize = 32;

thread_local! {
    static TRANSFORMED: Cell<Vec<f32>> = const { Cell::new(Vec::new()) };
}

/// Weight offsets of a dense 3×3 kernel with stride 1, row by row, and the distance of its first tap; none for other correlations.
fn square(c: &Correlation) -> Option<([usize; 9], [isize; 2])> {
    let [phase] = &c.phases[..] else { return None };
    if c.step != [1; 2] || c.spread != [1; 2] || phase.taps.len() != 9 || phase.size != c.output {
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
    weights.iter().all(|w| *w != usize::MAX).then_some((weights, low))
}

/// Computes all outputs if this is estimated to be faster than sums over taps; else returns the tensors.
pub fn run<'a>(c: &Correlation, t: Tensors<'a>) -> Result<(), Tensors<'a>> {
    let Some((taps, low)) = square(c).filter(|_| !c.is_rounded()) else { return Err(t) };
    let level = simd::level();
    let kernel = kernel(level);
    let grid = Grid::plan(c, kernel);
    if !grid.pays(c, kernel) {
        return Err(t);
    }
    let mut planes = Planes::default();
    planes.update(c.input, [2, 1], (0..4).flat_map(|y| [0, 2].map(|x| [low[0] + y, low[1] + x])));
    planes.fit(1, grid.rows, 2 * grid.columns);
    let mut weights = TRANSFORMED.take();
    let pitch = Pitch::of(c);
    weights.resize(c.groups * POINTS * pitch.point, 0.0);
    transform_weights(c, &taps, t.weights, pitch, &mut weights);
    let bands = grid.height.div_ceil(grid.rows);
    let features = grid.features(c, bands);
    let parts = c.features.div_ceil(features);
    let job = Job {
        c,
        kernel,
        grid,
        rows: std::array::from_fn(|i| planes.offset([low[0] + i as isize, low[1]])),
        planes,
        x: t.x,
        weights: &weights,
        pitch,
        bias: t.bias,
        activation: t.activation,
        out: Shared(t.out.as_mut_ptr()),
        before: t.before.map(|b| Shared(b.as_mut_ptr())),
    };
    (0..c.batch * c.groups * bands * parts).into_par_iter().for_each(|i| {
        let (part, i) = (i % parts, i / parts);
        let (band, i) = (i % bands, i / bands);
        let first = band * grid.rows;
        let part = Part {
            image: i / c.groups,
            group: i % c.groups,
            rows: first..(first + grid.rows).min(grid.height),
            features: part * features..((part + 1) * features).min(c.features),
        };
        simd::with_level(level, || with_scratch(|scratch| job.compute(&part, scratch)));
    });
    TRANSFORMED.set(weights);
    Ok(())
}

/// Division of an image into 2×2 tiles of outputs, and of these into bands of whole rows.
#[derive(Clone, Copy)]
struct Grid {
    /// Tiles of an image.
    height: usize,
    columns: usize,
    /// Rows of tiles per band.
    rows: usize,
}

impl Grid {
    /// Chooses the band height of least estimated cost, in vectors and reads of the weights.
    fn plan(c: &Correlation, kernel: &Kernel) -> Grid {
        let [height, columns] = c.output.map(|n| n.div_ceil(2).max(1));
        let of = |rows| Grid { height, columns, rows };
        let most = (TILES / (columns + 1)).clamp(1, height);
        // Each band reads all weights again.
        let cost = |rows: usize| 19 * of(rows).vectors_of_image(kernel) + 16 * height.div_ceil(rows);
        of((1..=most).min_by_key(|&rows| cost(rows)).unwrap_or(1))
    }

    /// Vectors of tiles in all bands of an image.
    fn vectors_of_image(&self, kernel: &Kernel) -> usize {
        let (bands, rest) = (self.height / self.rows, self.height % self.rows);
        bands * self.vectors(self.rows, kernel) + if rest > 0 { self.vectors(rest, kernel) } else { 0 }
    }

    /// Tiles of some rows, with one tile of padding between rows.
    fn tiles(&self, rows: usize) -> usize {
        rows * (self.columns + 1) - 1
    }

    fn vectors(&self, rows: usize, kernel: &Kernel) -> usize {
        self.tiles(rows).div_ceil(kernel.lanes)
    }

    /// Whether the saved products outweigh the transforms, in estimated cycles.
    fn pays(&self, c: &Correlation, kernel: &Kernel) -> bool {
        let transforms = 60.0 / self.most_features(c) as f64 + 40.0 / c.channels as f64;
        let image = self.vectors_of_image(kernel) as f64 * (8.0 + transforms) + 8.0 * self.height.div_ceil(self.rows) as f64;
        let ours = c.batch as f64 * image + 40.0;
        let direct = 4.5 * (c.batch * (c.output[0] * c.output[1]).div_ceil(kernel.lanes)) as f64;
        c.channels >= 8 && c.features >= 8 && ours < direct
    }

    /// Output channels whose products of a band stay in cache.
    fn most_features(&self, c: &Correlation) -> usize {
        (PRODUCTS / (POINTS * self.tiles(self.rows))).clamp(1, c.features)
    }

    /// Output channels per task.
    fn features(&self, c: &Correlation, bands: usize) -> usize {
        let most = self.most_features(c);
        let wanted = (3 * rayon::current_num_threads()).div_ceil(c.batch * c.groups * bands);
        let parts = c.features.div_ceil(most).max(wanted.min(c.features.div_ceil(FEWEST_FEATURES)));
        c.features.div_ceil(parts).next_multiple_of(8)
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
    kernel: &'static Kernel,
    grid: Grid,
    planes: Planes,
    /// Offsets of a tile's four rows in the copy.
    rows: [usize; 4],
    x: &'a [f32],
    /// `[groups, POINTS, features, channels]`
    weights: &'a [f32],
    pitch: Pitch,
    bias: &'a [f32],
    activation: Activation,
    out: Shared,
    before: Option<Shared>,
}

impl Job<'_> {
    fn compute(&self, part: &Part, scratch: &mut Scratch) {
        let (c, width, lanes) = (self.c, self.kernel.width(), self.kernel.lanes);
        let tiles = self.grid.tiles(part.rows.len());
        let (blocks, features) = (tiles.div_ceil(width), part.features.len());
        let Scratch { planes, panel, sums, offsets, .. } = scratch;
        // Whole vectors of tiles are read, even beyond the last tile.
        let copy = aligned(planes, self.planes.channel + 4 * lanes);
        let inputs = aligned(panel, POINTS * CHANNELS.min(c.channels) * blocks * width);
        let products = aligned(sums, POINTS * features * blocks * width + 4 * tiles.next_multiple_of(lanes));
        let (products, pixels) = products.split_at_mut(POINTS * features * blocks * width);
        for first in (0..c.channels).step_by(CHANNELS) {
            let channels = first..(first + CHANNELS).min(c.channels);
            self.transform_inputs(part, channels.clone(), tiles, copy, inputs);
            offsets.clear();
            offsets.extend((0..channels.len() as u32).map(|i| (i, i * width as u32)));
            let start = if first == 0 { Start::Zero } else { Start::Accumulate };
            for i in 0..blocks * POINTS {
                let (block, point) = (i / POINTS, i % POINTS);
                let vectors = (tiles - block * width).min(width).div_ceil(lanes);
                for f in (0..features).step_by(self.kernel.rows) {
                    let at = (part.group * POINTS + point) * self.pitch.point + (part.features.start + f) * self.pitch.feature + first;
                    let tile = Tile {
                        a: self.weights[at..].as_ptr(),
                        row: self.pitch.feature,
                        b: inputs[i * channels.len() * width..].as_ptr(),
                        offsets,
                        c: products[(i * features + f) * width..].as_mut_ptr(),
                        c_row: width,
                        c_vector: lanes,
                        start,
                        ahead: Ahead::none(inputs.as_ptr()),
                        pairs: None,
                    };
                    // SAFETY: weights of that many output channels exist from there, inputs of all channels, and their products.
                    unsafe { self.kernel.run(self.kernel.rows.min(features - f), vectors, &tile) };
                }
            }
        }
        for (f, feature) in part.features.clone().enumerate() {
            self.finish(part, feature, &products[f * width..], features, pixels);
        }
    }

    /// Writes `Bᵀ d B` of some channels: `[block, point, channel, width]`.
    fn transform_inputs(&self, part: &Part, channels: Range<usize>, tiles: usize, copy: &mut [f32], out: &mut [f32]) {
        let (c, count) = (self.c, channels.len());
        let [height, width] = c.input;
        let source = Source { data: self.x, image_stride: c.groups * c.channels * height * width, first_channel: part.group * c.channels };
        let read = self.planes.rows_of(part.rows.clone());
        for (i, channel) in channels.enumerate() {
            if i + 1 < count {
                let plane = ((part.image * c.groups + part.group) * c.channels + channel + 1) * height;
                simd::fetch_later(self.x[(plane + read.start) * width..].as_ptr(), read.len() * width);
            }
            self.planes.fill(source, channel..channel + 1, part.image..part.image + 1, part.rows.start, copy);
            let to = Strides { block: self.kernel.width(), point: count * self.kernel.width(), tiles };
            // SAFETY: the copy extends by four vectors; `out` holds blocks of whole vectors of every channel.
            unsafe { transform(self.rows.map(|r| copy[r..].as_ptr()), &to, out[i * self.kernel.width()..].as_mut_ptr()) };
        }
    }

    /// Computes and stores the outputs of one channel from its products, which start at `products[0]`.
    fn finish(&self, part: &Part, feature: usize, products: &[f32], features: usize, pixels: &mut [f32]) {
        let (c, width) = (self.c, self.kernel.width());
        let channel = part.group * c.features + feature;
        let from = Strides { block: width, point: features * width, tiles: self.grid.tiles(part.rows.len()) };
        let bias = self.bias.get(channel).copied().unwrap_or(0.0);
        let half = pixels.len() / 2;
        let (top, bottom) = pixels.split_at_mut(half);
        // SAFETY: products are blocks of whole vectors, and each row has room for two vectors per vector of tiles.
        unsafe { collect(products.as_ptr(), &from, bias, [top.as_mut_ptr(), bottom.as_mut_ptr()]) };
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
                let from = &pixels[2 * i * (self.grid.columns + 1)..][..width];
                // SAFETY: the row is this task's own, and lies inside the output, whose length `Correlation::run` checked.
                unsafe { std::ptr::copy_nonoverlapping(from.as_ptr(), out.at((plane + y) * width), width) };
            }
        }
    }
}

/// Floats between rows of transformed weights: odd numbers of cache lines, so that rows and points do not map to the same cache set.
#[derive(Clone, Copy)]
struct Pitch {
    feature: usize,
    point: usize,
}

impl Pitch {
    fn of(c: &Correlation) -> Pitch {
        let feature = c.channels.div_ceil(32) * 32 + 16;
        Pitch { feature, point: c.features.div_ceil(2) * 2 * feature + 16 }
    }
}

/// `out[group, point, feature, channel] = (G g Gᵀ)[point]`
fn transform_weights(c: &Correlation, taps: &[usize; 9], weights: &[f32], pitch: Pitch, out: &mut [f32]) {
    let shared = Shared(out.as_mut_ptr());
    let level = simd::level();
    (0..c.groups * c.features).into_par_iter().for_each(|i| {
        let (group, feature) = (i / c.features, i % c.features);
        let from = &weights[group * c.weight_group + feature * c.weight_feature..];
        let at = group * POINTS * pitch.point + feature * pitch.feature;
        // SAFETY: each output channel has its own row of every point.
        let mut rows = std::array::from_fn(|p| unsafe { std::slice::from_raw_parts_mut(shared.at(at + p * pitch.point), c.channels) });
        simd::with_level(level, || kernels(from, taps, c.weight_channel, &mut rows));
    });
}

/// Layout of transformed tiles: element `p` is at `⌊tile / block⌋ · POINTS · point + p · point + tile mod block`.
struct Strides {
    /// Tiles of a block.
    block: usize,
    /// Floats between elements of a tile.
    point: usize,
    tiles: usize,
}

impl Strides {
    /// Offset of a tile's first element.
    #[inline(always)]
    fn at(&self, tile: usize) -> usize {
        tile / self.block * POINTS * self.point + tile % self.block
    }
}

by_lanes! {
    /// The 16 elements of `Bᵀ d B` of tiles that lie two floats apart in their rows.
    ///
    /// # Safety
    /// The rows extend by two vectors and two floats from the last tile; `out` holds whole vectors of all tiles.
    unsafe fn transform<L>(rows: [*const f32; 4], to: &Strides, out: *mut f32) {
        for tile in (0..to.tiles).step_by(L::N) {
            let mut b = [[L::splat(0.0); 4]; 4];
            for half in 0..2 {
                let d = |row: usize| L::load_pairs(rows[row].add(2 * (tile + half)));
                let (d0, d1, d2, d3) = (d(0), d(1), d(2), d(3));
                for (x, [d0, d1, d2, d3]) in [[d0.0, d1.0, d2.0, d3.0], [d0.1, d1.1, d2.1, d3.1]].into_iter().enumerate() {
                    let x = 2 * half + x;
                    b[0][x] = L::sub(d0, d2);
                    b[1][x] = L::add(d1, d2);
                    b[2][x] = L::sub(d2, d1);
                    b[3][x] = L::sub(d1, d3);
                }
            }
            let mut out = out.add(to.at(tile));
            for [a, b, c, d] in b {
                for v in [L::sub(a, c), L::add(b, c), L::sub(c, b), L::sub(b, d)] {
                    L::store(out, v);
                    out = out.add(to.point);
                }
            }
        }
    }
}

by_lanes! {
    /// Two rows of outputs, `Aᵀ m A + bias`.
    ///
    /// # Safety
    /// `products` holds whole vectors of all tiles, and both rows two vectors for each of them.
    unsafe fn collect<L>(products: *const f32, from: &Strides, bias: f32, rows: [*mut f32; 2]) {
        let bias = L::splat(bias);
        for tile in (0..from.tiles).step_by(L::N) {
            let mut at = products.add(from.at(tile));
            let mut m = [[bias; 4]; 4];
            for row in &mut m {
                for v in row {
                    *v = L::load(at);
                    at = at.add(from.point);
                }
            }
            let [a, b, c, d] = m;
            let mut sums = [[bias; 4]; 2];
            for x in 0..4 {
                sums[0][x] = L::add(L::add(a[x], b[x]), c[x]);
                sums[1][x] = L::sub(L::sub(b[x], c[x]), d[x]);
            }
            for ([a, b, c, d], row) in sums.into_iter().zip(rows) {
                let even = L::add(L::add(L::add(a, b), c), bias);
                let odd = L::add(L::sub(L::sub(b, c), d), bias);
                L::store_pairs(row.add(2 * tile), even, odd);
            }
        }
    }
}

vectorized! {
    /// `G g Gᵀ` of a row of channels, `stride` floats apart.
    fn kernels<const F>(weights: &[f32], taps: &[usize; 9], stride: usize, out: &mut [&mut [f32]; POINTS]) {
        const N: usize = 16;
        let channels = out[0].len();
        for first in (0..channels).step_by(N) {
            let count = N.min(channels - first);
            let mut g = [[[0.0f32; N]; 3]; 3];
            for y in 0..3 {
                for x in 0..3 {
                    for i in 0..count {
                        g[y][x][i] = weights[(first + i) * stride + taps[3 * y + x]];
                    }
                }
            }
            let mut columns = [[[0.0f32; N]; 3]; 4];
            for x in 0..3 {
                for i in 0..N {
                    let (sum, middle) = (0.5 * (g[0][x][i] + g[2][x][i]), 0.5 * g[1][x][i]);
                    columns[0][x][i] = g[0][x][i];
                    columns[1][x][i] = sum + middle;
                    columns[2][x][i] = sum - middle;
                    columns[3][x][i] = g[2][x][i];
                }
            }
            for y in 0..4 {
                let [a, b, c] = &columns[y];
                let mut row = [[0.0f32; N]; 4];
                for i in 0..N {
                    let (sum, middle) = (0.5 * (a[i] + c[i]), 0.5 * b[i]);
                    row[0][i] = a[i];
                    row[1][i] = sum + middle;
                    row[2][i] = sum - middle;
                    row[3][i] = c[i];
                }
                for x in 0..4 {
                    out[4 * y + x][first..first + count].copy_from_slice(&row[x][..count]);
                }
            }
        }
    }
}
