//! Block by block of samples. Both passes evaluate the layers anew, which costs less than keeping their outputs. Samples are divided into
//! groups by their number alone, each with parameter gradients of its own that are added in order, so that results do not depend on the
//! number of threads.

use super::rows::{add_dots, combine, copy_columns, outer, scale, weighted_sum};
use super::{DensityGradients, DensityNet, DensityPoints};
use crate::gemm::{self, Gemm, Init, View, gemm};
use crate::ops::fused_mlp::{Layer, Source};
use crate::ops::hash_grid::cpu as hash;
use crate::ops::linear::Activation;
use crate::ops::linear::cpu::{activate, second_slope_from_output, slope_from_output};
use crate::tasks::Parts;
use rayon::prelude::*;
use std::ops::Range;

pub use hash::TableGradient;

/// Samples per block.
const BLOCK: usize = 252;
/// Most groups with gradients of their own, and samples that make another group worth its memory traffic.
const GROUPS: usize = 16;
const GROUP_SAMPLES: usize = 2048;
/// Samples per task of elementwise work.
const TASK: usize = 8192;

/// Destinations of a backward pass, added to.
pub struct DensitySinks<'a> {
    /// Of all parameters of the field's network.
    pub params: &'a mut [f32],
    /// Of a hash grid's table, where it is trained.
    pub table: Option<TableGradient<'a>>,
}

/// Results, and memory kept between calls.
#[derive(Default)]
pub struct DensityBuffers {
    /// Densities `[N]`.
    pub sigma: Vec<f32>,
    /// Their gradients `[N, 3]`; empty where none were wanted.
    pub gradient: Vec<f32>,
    /// Gradient of the density before its activation: with respect to the points, `[N, 3]`, and to a hash grid's features, `[L, N, F]`.
    d_points: Vec<f32>,
    d_features: Vec<f32>,
    /// Seeds of the backward pass: gradients of the density before its activation `[N]`, directions `[N, 3]`, and derivatives of the
    /// features along these, `[L, N, F]`.
    d_raw: Vec<f32>,
    directions: Vec<f32>,
    derivatives: Vec<f32>,
    prepared: Prepared,
    groups: Vec<Group>,
}

/// Weights in the forms that products read.
#[derive(Default)]
struct Prepared {
    /// Transposes of all but the last layer's.
    transposed: Vec<Vec<f32>>,
    /// The density's column of the last layer's, and its bias.
    column: Vec<f32>,
    bias: f32,
}

/// Memory of one block.
#[derive(Default)]
struct Group {
    /// Encoded positions `[n, K]`, and the gradient of the density before its activation.
    features: Vec<f32>,
    d_features: Vec<f32>,
    /// Outputs of all layers but the last, and the density's gradients before their activations.
    values: Vec<Vec<f32>>,
    u: Vec<Vec<f32>>,
    /// The same of the density, `[n]`.
    value: Vec<f32>,
    u_last: Vec<f32>,
    /// What is pushed through the layers in a backward pass.
    pushed: Vec<Vec<f32>>,
    column_sum: Vec<f32>,
    d_params: Vec<f32>,
}

/// Densities of points and, where wanted, their gradients with respect to the points.
///
/// # Shapes
/// params `[params_len]` of the whole network.
///
/// # Panics
/// When shapes do not fit.
pub fn forward(net: &DensityNet, params: &[f32], points: &DensityPoints, wants_gradient: bool, buf: &mut DensityBuffers) {
    let n = points.len();
    let pass = Pass::new(net, params, points);
    buf.prepared.update(net, params);
    let is_hash = matches!(points, DensityPoints::Hash { .. });
    buf.sigma.resize(n, 0.0);
    buf.d_points.resize(if wants_gradient { n * 3 } else { 0 }, 0.0);
    buf.d_features.resize(if is_hash { n * net.input } else { 0 }, 0.0);
    let (sigma, d_points, d_features) = (Parts::new(&mut buf.sigma), Parts::new(&mut buf.d_points), Parts::new(&mut buf.d_features));
    let prepared = &buf.prepared;
    each_block(n, &mut buf.groups, |block, g| {
        pass.read(&block, &mut g.features);
        pass.evaluate(prepared, block.len(), g);
        // SAFETY: this block's samples.
        let own = unsafe { sigma.range(block.clone()) };
        own.iter_mut().zip(&g.value).for_each(|(o, v)| *o = v + net.head.shift);
        activate(net.head.activation, own);
        if !is_hash && !wants_gradient {
            return;
        }
        pass.reverse(prepared, block.len(), g, true);
        if is_hash {
            // SAFETY: as above.
            return pass.by_level(&block, |first, width, range| unsafe {
                copy_columns(width, (&g.d_features, net.input, first), (d_features.range(range), width, 0));
            });
        }
        // SAFETY: as above.
        let own = unsafe { d_points.range(block.start * 3..block.end * 3) };
        pass.encoding_backward(&block, &g.d_features, own);
    });
    buf.gradient.resize(buf.d_points.len(), 0.0);
    if let (DensityPoints::Hash { grid, table, points, .. }, true) = (points, wants_gradient) {
        hash::gradient(grid, points, table, &buf.d_features, &mut buf.d_points);
    }
    let a = net.head.activation;
    let parts = buf.gradient.par_chunks_mut(TASK * 3).zip(buf.d_points.par_chunks(TASK * 3)).zip(buf.sigma.par_chunks(TASK));
    parts.for_each(|((out, d), sigma)| {
        for ((o, d), sigma) in out.chunks_exact_mut(3).zip(d.chunks_exact(3)).zip(sigma) {
            let slope = slope_from_output(a, *sigma);
            (0..3).for_each(|k| o[k] = slope * d[k]);
        }
    });
}

/// Adds the gradients of parameters, given those of what [`forward`] gave for the same points and parameters.
///
/// # Panics
/// When shapes do not fit, or there are gradients of what was not wanted.
pub fn backward(net: &DensityNet, params: &[f32], points: &DensityPoints, d: DensityGradients, buf: &mut DensityBuffers, to: DensitySinks) {
    let n = points.len();
    let pass = Pass::new(net, params, points);
    assert!(buf.sigma.len() == n && [0, n].contains(&d.sigma.len()), "density gradient: sigma");
    assert!([0, buf.gradient.len()].contains(&d.gradient.len()) && to.params.len() == net.params_len, "density gradient: gradients");
    if n == 0 {
        return;
    }
    seeds(net, d, buf);
    let follows = !buf.directions.is_empty();
    if let DensityPoints::Hash { grid, table, points, .. } = points {
        let width = grid.config.features;
        if follows {
            buf.derivatives.resize(n * net.input, 0.0);
            hash::derivatives(grid, points, table, &buf.directions, &mut buf.derivatives);
            if let Some(to) = to.table {
                let along = hash::Along { value: &buf.d_raw, direction: &buf.directions };
                hash::gradient_backward(grid, points, &buf.d_features, along, to);
            }
        } else if let Some(to) = to.table {
            let d_raw = &buf.d_raw;
            buf.d_features.par_chunks_mut(n * width).for_each(|level| combine(level, width, d_raw, &[]));
            let touched = if to.touched.is_empty() { None } else { Some(to.touched) };
            hash::backward(grid, points, &buf.d_features, to.grads, touched);
        }
    }
    let (d_raw, directions, derivatives, prepared) = (&buf.d_raw, &buf.directions, &buf.derivatives, &buf.prepared);
    let end = net.end();
    let count = each_block(n, &mut buf.groups, |block, g| {
        if block.start.is_multiple_of(group_size(n)) {
            g.d_params.clear();
            g.d_params.resize(end, 0.0);
        }
        pass.read(&block, &mut g.features);
        pass.evaluate(prepared, block.len(), g);
        pass.reverse(prepared, block.len(), g, false);
        g.d_features.resize(block.len() * net.input, 0.0);
        if follows {
            pass.tangents(&block, directions, derivatives, &mut g.d_features);
        }
        let t = if follows { &g.d_features[..] } else { &[] };
        combine(&mut g.features, net.input, &d_raw[block.clone()], t);
        pass.push(&d_raw[block], g);
    });
    let groups = &buf.groups[..count];
    to.params[..end].par_chunks_mut(4096).enumerate().for_each(|(c, d)| {
        for g in groups {
            d.iter_mut().zip(&g.d_params[c * 4096..]).for_each(|(d, g)| *d += g);
        }
    });
}

/// The gradient of the density before its activation, and the directions along which features change.
fn seeds(net: &DensityNet, d: DensityGradients, buf: &mut DensityBuffers) {
    let (a, n) = (net.head.activation, buf.sigma.len());
    buf.d_raw.clear();
    buf.d_raw.resize(n, 0.0);
    buf.directions.resize(d.gradient.len(), 0.0);
    buf.d_raw.par_chunks_mut(TASK).zip(buf.sigma.par_chunks(TASK)).enumerate().for_each(|(c, (out, sigma))| {
        let d = d.sigma.get(c * TASK..).unwrap_or_default();
        for ((o, sigma), d) in out.iter_mut().zip(sigma).zip(d) {
            *o = d * slope_from_output(a, *sigma);
        }
    });
    let parts = buf.d_raw.par_chunks_mut(TASK).zip(buf.sigma.par_chunks(TASK));
    let of_points = buf.directions.par_chunks_mut(TASK * 3).zip(d.gradient.par_chunks(TASK * 3)).zip(buf.d_points.par_chunks(TASK * 3));
    parts.zip(of_points).for_each(|((out, sigma), ((directions, d), n))| {
        let vectors = directions.chunks_exact_mut(3).zip(d.chunks_exact(3)).zip(n.chunks_exact(3));
        for ((o, sigma), ((v, d), n)) in out.iter_mut().zip(sigma).zip(vectors) {
            let slope = slope_from_output(a, *sigma);
            *o += second_slope_from_output(a, *sigma) * (d[0] * n[0] + d[1] * n[1] + d[2] * n[2]);
            (0..3).for_each(|k| v[k] = slope * d[k]);
        }
    });
}

/// Samples of a group, a multiple of a block.
fn group_size(n: usize) -> usize {
    n.div_ceil((n / GROUP_SAMPLES).clamp(1, GROUPS)).next_multiple_of(BLOCK)
}

/// Calls `f` for every block, those of a group one after another; gives the number of groups.
fn each_block(n: usize, groups: &mut Vec<Group>, f: impl Fn(Range<usize>, &mut Group) + Sync) -> usize {
    let (size, count) = (group_size(n), n.div_ceil(group_size(n).max(1)));
    if groups.len() < count {
        groups.resize_with(count, Group::default);
    }
    groups[..count].par_iter_mut().with_max_len(1).enumerate().for_each(|(k, group)| {
        let last = ((k + 1) * size).min(n);
        for first in (k * size..last).step_by(BLOCK) {
            f(first..(first + BLOCK).min(last), group);
        }
    });
    count
}

impl Prepared {
    fn update(&mut self, net: &DensityNet, params: &[f32]) {
        let last = net.head.layer;
        self.transposed.resize_with(last, Vec::new);
        for (j, t) in self.transposed.iter_mut().enumerate() {
            gemm::transpose(net.fan_in[j], net.layers[j].width, &params[net.offsets[j]..], t);
        }
        self.column.clear();
        self.column.extend((0..net.fan_in[last]).map(|p| params[net.column(p)]));
        self.bias = if net.layers[last].bias { params[net.column(net.fan_in[last])] } else { 0.0 };
    }
}

impl DensityNet {
    /// Parameter of the density's column of the last layer in row `p`; the row behind the last is the bias.
    fn column(&self, p: usize) -> usize {
        self.offsets[self.head.layer] + p * self.layers[self.head.layer].width + self.head.channel
    }

    /// End of the parameters.
    fn end(&self) -> usize {
        let last = self.head.layer;
        self.offsets[last] + (self.fan_in[last] + self.layers[last].bias as usize) * self.layers[last].width
    }

    /// The inputs of layer `j`: source, its width, and its first row of the weight.
    fn inputs(&self, j: usize) -> impl Iterator<Item = (Source, usize, usize)> + '_ {
        self.layers[j].inputs.iter().scan(0, |row, s| {
            let first = *row;
            *row += self.source_width(*s);
            Some((*s, self.source_width(*s), first))
        })
    }
}

/// Inputs of a pass.
#[derive(Clone, Copy)]
struct Pass<'a> {
    net: &'a DensityNet,
    params: &'a [f32],
    points: &'a DensityPoints<'a>,
}

impl<'a> Pass<'a> {
    fn new(net: &'a DensityNet, params: &'a [f32], points: &'a DensityPoints) -> Self {
        assert_eq!(params.len(), net.params_len, "density gradient: parameters");
        let fits = match points {
            DensityPoints::Hash { grid, features, points, .. } => {
                grid.output_dims() == net.input && features.len() == points.len() / 3 * net.input
            }
            DensityPoints::Encoded { encoding, .. } => encoding.output_dims() == net.input,
        };
        assert!(fits, "density gradient: points");
        Pass { net, params, points }
    }

    /// Calls `f(first column, columns, range)` for the block's part of each level of numbers `[L, N, F]`.
    fn by_level(&self, block: &Range<usize>, mut f: impl FnMut(usize, usize, Range<usize>)) {
        let DensityPoints::Hash { grid, .. } = self.points else { return };
        let (n, width) = (self.points.len(), grid.config.features);
        (0..grid.levels.len()).for_each(|l| f(l * width, width, (l * n + block.start) * width..(l * n + block.end) * width));
    }

    /// Rows `[n, K]` of numbers `[L, N, F]`.
    fn rows(&self, block: &Range<usize>, levels: &[f32], out: &mut [f32]) {
        self.by_level(block, |first, width, range| copy_columns(width, (&levels[range], width, 0), (out, self.net.input, first)));
    }

    /// Encoded positions.
    fn read(&self, block: &Range<usize>, out: &mut Vec<f32>) {
        out.resize(block.len() * self.net.input, 0.0);
        match self.points {
            DensityPoints::Hash { features, .. } => self.rows(block, features, out),
            DensityPoints::Encoded { encoding, points } => encoding.forward(&points[block.start * 3..block.end * 3], out),
        }
    }

    fn encoding_backward(&self, block: &Range<usize>, d: &[f32], d_points: &mut [f32]) {
        if let DensityPoints::Encoded { encoding, points } = self.points {
            encoding.backward(&points[block.start * 3..block.end * 3], d, d_points);
        }
    }

    /// Derivatives of the features along the directions.
    fn tangents(&self, block: &Range<usize>, directions: &[f32], derivatives: &[f32], out: &mut [f32]) {
        match self.points {
            DensityPoints::Hash { .. } => self.rows(block, derivatives, out),
            DensityPoints::Encoded { encoding, points } => {
                let own = block.start * 3..block.end * 3;
                encoding.tangent(&points[own.clone()], &directions[own], out);
            }
        }
    }

    /// `out = init + Σ x W` over the inputs of layer `j` in `features` and `values`.
    fn product(&self, j: usize, n: usize, features: &[f32], values: &[Vec<f32>], (init, relu): (Init, bool), out: &mut [f32]) {
        let (layer, count) = (&self.net.layers[j], self.net.layers[j].inputs.len());
        for (q, (s, k, first)) in self.net.inputs(j).enumerate() {
            let x = View::rows(if let Source::Layer(i) = s { &values[i] } else { features }, k);
            let b = &self.params[self.net.offsets[j] + first * layer.width..];
            let init = if q == 0 { init } else { Init::Accumulate };
            let relu = relu && q + 1 == count;
            gemm(self.net.precision, Gemm { m: n, n: layer.width, k, a: x, b, ldb: layer.width, ldc: layer.width, init, relu }, out);
        }
    }

    /// Outputs of all layers and of the density.
    fn evaluate(&self, prepared: &Prepared, n: usize, g: &mut Group) {
        let last = self.net.head.layer;
        g.values.resize_with(last, Vec::new);
        for (j, layer) in self.net.layers[..last].iter().enumerate() {
            let (before, rest) = g.values.split_at_mut(j);
            let out = &mut rest[0];
            out.resize(n * layer.width, 0.0);
            let init = if layer.bias { Init::Bias(self.bias(j)) } else { Init::Zero };
            self.product(j, n, &g.features, before, (init, layer.activation == Activation::Relu), out);
            if layer.activation != Activation::Relu {
                activate(layer.activation, out);
            }
        }
        g.value.clear();
        g.value.resize(n, prepared.bias);
        for (s, k, first) in self.net.inputs(last) {
            let x = if let Source::Layer(i) = s { &g.values[i] } else { &g.features };
            add_dots(x, &prepared.column[first..first + k], &mut g.value);
        }
        activate(self.net.layers[last].activation, &mut g.value);
    }

    fn bias(&self, j: usize) -> &[f32] {
        let (at, layer): (usize, &Layer) = (self.net.offsets[j], &self.net.layers[j]);
        &self.params[at + self.net.fan_in[j] * layer.width..][..layer.width]
    }

    /// Gradients of the density before each layer's activation and, where `wanted`, with respect to the features.
    fn reverse(&self, prepared: &Prepared, n: usize, g: &mut Group, wanted: bool) {
        let (net, last) = (self.net, self.net.head.layer);
        g.u.resize_with(last, Vec::new);
        g.u.iter_mut().zip(&net.layers).for_each(|(u, l)| u.resize(n * l.width, 0.0));
        g.d_features.resize(n * net.input, 0.0);
        g.u_last.clear();
        g.u_last.extend(g.value.iter().map(|v| slope_from_output(net.layers[last].activation, *v)));
        let mut seeded = vec![false; last + 1];
        // The last place is the features'.
        let place = |s: Source| if let Source::Layer(i) = s { i } else { last };
        for (s, k, first) in net.inputs(last) {
            let target = if let Source::Layer(i) = s { &mut g.u[i] } else { &mut g.d_features };
            outer(&g.u_last, &prepared.column[first..first + k], std::mem::replace(&mut seeded[place(s)], true), target);
        }
        for (j, layer) in net.layers[..last].iter().enumerate().rev() {
            let (before, rest) = g.u.split_at_mut(j);
            let u = &mut rest[0];
            scale(layer.activation, &g.values[j], u);
            for (s, k, first) in net.inputs(j) {
                if matches!(s, Source::Input(_)) && !wanted {
                    continue;
                }
                let target = if let Source::Layer(i) = s { &mut before[i] } else { &mut g.d_features };
                let init = if std::mem::replace(&mut seeded[place(s)], true) { Init::Accumulate } else { Init::Zero };
                let (a, b) = (View::rows(u, layer.width), &prepared.transposed[j][first..]);
                gemm(net.precision, Gemm { m: n, n: k, k: layer.width, a, b, ldb: net.fan_in[j], ldc: k, init, relu: false }, target);
            }
        }
    }

    /// Pushes the features of a group through the layers as they act on its samples, and adds the gradients of their parameters.
    fn push(&self, d_raw: &[f32], g: &mut Group) {
        let (net, last, n) = (self.net, self.net.head.layer, d_raw.len());
        g.pushed.resize_with(last, Vec::new);
        for (j, layer) in net.layers[..last].iter().enumerate() {
            let (before, rest) = g.pushed.split_at_mut(j);
            let out = &mut rest[0];
            out.resize(n * layer.width, 0.0);
            if layer.bias {
                outer(d_raw, self.bias(j), false, out);
            }
            self.product(j, n, &g.features, before, (if layer.bias { Init::Accumulate } else { Init::Zero }, false), out);
            scale(layer.activation, &g.values[j], out);
            if layer.frozen {
                continue;
            }
            let width = layer.width;
            for (s, k, first) in net.inputs(j) {
                let a = View::transposed(if let Source::Layer(i) = s { &before[i] } else { &g.features }, k);
                let at = net.offsets[j] + first * width;
                let gemm_of = Gemm { m: k, n: width, k: n, a, b: &g.u[j], ldb: width, ldc: width, init: Init::Accumulate, relu: false };
                gemm(net.precision, gemm_of, &mut g.d_params[at..at + k * width]);
            }
            if layer.bias {
                let at = net.offsets[j] + net.fan_in[j] * width;
                weighted_sum(&g.u[j], d_raw, &mut g.d_params[at..at + width]);
            }
        }
        if net.layers[last].frozen {
            return;
        }
        g.column_sum.clear();
        g.column_sum.resize(net.fan_in[last] + 1, 0.0);
        for (s, k, first) in net.inputs(last) {
            let x = if let Source::Layer(i) = s { &g.pushed[i] } else { &g.features };
            weighted_sum(x, &g.u_last, &mut g.column_sum[first..first + k]);
        }
        g.column_sum[net.fan_in[last]] = d_raw.iter().zip(&g.u_last).map(|(d, u)| d * u).sum();
        let rows = net.fan_in[last] + net.layers[last].bias as usize;
        (0..rows).for_each(|p| g.d_params[net.column(p)] += g.column_sum[p]);
    }
}
