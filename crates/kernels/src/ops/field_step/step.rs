//! The loop over blocks: rays are divided into groups by the number of samples, groups into blocks. Each group sums its own parameter
//! gradients, and groups are added in order, so that results do not depend on the number of threads.

use super::disjoint::Disjoint;
use super::shares::{self, Columns};
use super::{BlockEncoding, FieldNet, Output, Positions, RayCode, RayGradient, RayLoss, RayOutput};
use crate::ops::composite::{Packed, cpu as composite};
use crate::ops::fused_mlp::Head;
use crate::ops::fused_mlp::cpu::{Activations, Prepared, backward_block, forward_block};
use crate::ops::linear::Activation;
use crate::ops::linear::cpu::slope_from_output;
use rayon::prelude::*;

/// Samples per block: activations of a 64-wide network stay in L2 with room to spare.
const BLOCK: usize = 252;
/// Most groups with gradients of their own, and samples that make another group worth its memory traffic.
const GROUPS: usize = 16;
const GROUP_SAMPLES: usize = 2048;

/// Inputs of a step.
#[derive(Clone, Copy)]
pub struct StepInput<'a> {
    pub net: &'a FieldNet,
    /// `[params_len]`
    pub params: &'a [f32],
    pub samples: Packed<'a>,
    /// Composited behind the network's outputs.
    pub extras: Extras<'a>,
    pub beside: Option<Beside<'a>>,
    /// Background of every output and extra, `[R, C + K]`.
    pub background: &'a [f32],
    /// Distance `D` within which gradients of samples are scaled by `(t / D)²`, so that space close to a
    /// camera, which few rays share, learns no faster than the rest (Philip and Deschaintre 2023); 0: none.
    pub near_scaling: f32,
}

/// A second encoding of positions, which the network reads last.
#[derive(Clone, Copy, Debug)]
pub struct Beside<'a> {
    pub encoding: BlockEncoding,
    /// `[S, D]`
    pub points: &'a [f32],
    /// Whether a backward pass gives [`StepOutput::d_beside`].
    pub wanted: bool,
}

/// Values of samples that the caller gives.
#[derive(Clone, Copy, Debug, Default)]
pub struct Extras<'a> {
    /// `[S, K]`
    pub values: &'a [f32],
    /// `K`; 0: none.
    pub width: usize,
}

/// Results of a step per ray and per sample.
#[derive(Clone, Debug, Default)]
pub struct StepOutput {
    /// `[R, C + K]`, background included.
    pub values: Vec<f32>,
    /// `[R]`
    pub opacity: Vec<f32>,
    /// `Σ w t`, `[R]`
    pub depth: Vec<f32>,
    /// `[S]`
    pub weights: Vec<f32>,
    /// `[R, C + K]`, zero without a loss.
    pub d_background: Vec<f32>,
    /// Gradients of the extras, `[S, K]`; without a loss they are not written.
    pub d_extras: Vec<f32>,
    /// Gradients of [`Beside::points`] where they are wanted, `[S, D]`; without a loss they are not written.
    pub d_beside: Vec<f32>,
    pub loss: f64,
}

/// Buffers that are reused between steps.
#[derive(Default)]
pub struct StepBuffers {
    prepared: Prepared,
    groups: Vec<Group>,
}

#[derive(Default)]
struct Group {
    acts: Activations,
    inputs: Vec<Vec<f32>>,
    d_inputs: Vec<Vec<f32>>,
    sigma: Vec<f32>,
    /// Outputs and extras side by side, `[n, C + K]`.
    values: Vec<f32>,
    d_sigma: Vec<f32>,
    d_values: Vec<f32>,
    /// Gradients of one ray's weights and outputs.
    g: Vec<f32>,
    d_ray: Vec<f32>,
    d_params: Vec<f32>,
    loss: f64,
}

impl StepOutput {
    /// Room for `r` rays of `c` channels, extras included, and `s` samples of `k` extras.
    fn resize(&mut self, r: usize, s: usize, c: usize, k: usize) {
        let StepOutput { values, opacity, depth, weights, d_background, d_extras, .. } = self;
        for (v, n) in [(values, r * c), (opacity, r), (depth, r), (weights, s), (d_background, r * c), (d_extras, s * k)] {
            v.resize(n, 0.0);
        }
    }
}

/// Per-ray and per-sample arrays that blocks write to.
struct Shared<'a> {
    /// Features, levels, width, and whether gradients are wanted.
    features: Option<(Disjoint<'a>, usize, usize, bool)>,
    encoded: Option<(BlockEncoding, &'a [f32], Option<Disjoint<'a>>)>,
    codes: Vec<(&'a [f32], usize, Option<Disjoint<'a>>)>,
    values: Disjoint<'a>,
    opacity: Disjoint<'a>,
    depth: Disjoint<'a>,
    weights: Disjoint<'a>,
    d_background: Disjoint<'a>,
    d_extras: Disjoint<'a>,
    d_beside: Disjoint<'a>,
}

impl StepInput<'_> {
    /// Channels that are composited.
    fn channels(&self) -> usize {
        self.net.channels() + self.extras.width
    }

    /// # Panics
    /// When shapes do not fit, or a head is none that can be trained.
    fn check(&self, codes: usize) {
        let (r, s, mlp) = (self.samples.rays(), self.samples.samples(), &self.net.mlp);
        assert!(self.background.len() == r * self.channels() && self.params.len() == mlp.params_len(), "field: shapes");
        assert!(self.beside.is_none_or(|b| b.points.len() == s * b.encoding.dims()), "field: points of the second encoding");
        let inputs = codes + 1 + self.beside.iter().len();
        assert!(inputs == mlp.input_widths.len() && self.extras.values.len() == s * self.extras.width, "field: codes and extras");
        assert!(self.channels() > 0 && self.net.heads().all(|(h, _)| h.activation.is_monotonic()), "field: heads");
        let is_plain = |o: &Output| !o.are_shares || o.head.activation == Activation::None;
        assert!(self.net.outputs.iter().all(is_plain), "field: shares have no other activation");
    }
}

/// Evaluates and composites all samples; with a loss, also runs the backward pass and adds to `d_params`.
///
/// # Panics
/// When shapes do not fit.
pub fn run(
    input: &StepInput,
    positions: Positions,
    codes: &mut [RayCode],
    loss: Option<&dyn RayLoss>,
    buffers: &mut StepBuffers,
    out: &mut StepOutput,
    d_params: &mut [f32],
) {
    let (r, s, c, k) = (input.samples.rays(), input.samples.samples(), input.channels(), input.extras.width);
    let mlp = &input.net.mlp;
    input.check(codes.len());
    out.resize(r, s, c, k);
    out.d_beside.resize(input.beside.filter(|b| b.wanted).map_or(0, |b| b.points.len()), 0.0);
    let shared = Shared {
        features: None,
        encoded: None,
        codes: codes
            .iter_mut()
            .map(|c| {
                assert_eq!(c.values.len(), r * c.width, "field: code");
                (c.values, c.width, c.gradient.as_mut().map(|g| Disjoint::new(g)))
            })
            .collect(),
        values: Disjoint::new(&mut out.values),
        opacity: Disjoint::new(&mut out.opacity),
        depth: Disjoint::new(&mut out.depth),
        weights: Disjoint::new(&mut out.weights),
        d_background: Disjoint::new(&mut out.d_background),
        d_extras: Disjoint::new(&mut out.d_extras),
        d_beside: Disjoint::new(&mut out.d_beside),
    };
    let shared = match positions {
        Positions::Features { data, levels, width, wanted } => {
            assert_eq!(data.len(), levels * s * width, "field: features");
            Shared { features: Some((Disjoint::new(data), levels, width, wanted)), ..shared }
        }
        Positions::Encoded { encoding, points, d_points } => {
            assert_eq!(points.len(), s * encoding.dims(), "field: points");
            Shared { encoded: Some((encoding, points, d_points.map(Disjoint::new))), ..shared }
        }
    };
    if loss.is_some() {
        buffers.prepared.update(mlp, input.params);
    }
    // By the number of samples alone, so that sums do not depend on threads.
    let count = (s / GROUP_SAMPLES).clamp(1, GROUPS);
    if buffers.groups.len() < count {
        buffers.groups.resize_with(count, Group::default);
    }
    let bounds = group_bounds(&input.samples, count);
    let prepared = &buffers.prepared;
    let groups = &mut buffers.groups[..count];
    groups.par_iter_mut().with_max_len(1).enumerate().for_each(|(g, group)| {
        group.loss = 0.0;
        if loss.is_some() {
            group.d_params.clear();
            group.d_params.resize(mlp.params_len(), 0.0);
        }
        let mut first = bounds[g];
        while first < bounds[g + 1] {
            let mut last = first + 1;
            let start = input.samples.offsets[first];
            while last < bounds[g + 1] && (input.samples.offsets[last + 1] - start) as usize <= BLOCK {
                last += 1;
            }
            run_block(input, &shared, prepared, first..last, loss, group);
            first = last;
        }
    });
    out.loss = groups.iter().map(|g| g.loss).sum();
    if loss.is_some() {
        // Parallel over parameters, groups always in order.
        d_params.par_chunks_mut(4096).enumerate().for_each(|(c, d)| {
            for g in groups.iter() {
                d.iter_mut().zip(&g.d_params[c * 4096..]).for_each(|(d, g)| *d += g);
            }
        });
    }
}

/// Ray boundaries of the groups, with about equal samples in each.
fn group_bounds(p: &Packed, count: usize) -> Vec<usize> {
    let (r, s) = (p.rays(), p.samples());
    let mut bounds = vec![0; count + 1];
    for g in 1..count {
        let target = (s * g / count) as u32;
        bounds[g] = p.offsets.partition_point(|o| *o < target).min(r).max(bounds[g - 1]);
    }
    bounds[count] = r;
    bounds
}

fn run_block(
    input: &StepInput,
    shared: &Shared,
    prepared: &Prepared,
    rays: std::ops::Range<usize>,
    loss: Option<&dyn RayLoss>,
    group: &mut Group,
) {
    let p = &input.samples;
    let net = input.net;
    let (s0, s1) = (p.offsets[rays.start] as usize, p.offsets[rays.end] as usize);
    let (n, c) = (s1 - s0, input.channels());
    gather_inputs(input, shared, rays.clone(), s0, n, group);
    let inputs: Vec<&[f32]> = group.inputs.iter().map(|v| &v[..]).collect();
    forward_block(&net.mlp, input.params, &inputs, n, &mut group.acts);
    group.sigma.resize(n, 0.0);
    group.values.resize(n * c, 0.0);
    read_head(net, net.density, n, &group.acts, (&mut group.sigma, 1, 0, 1));
    let mut first = 0;
    for o in &net.outputs {
        read_head(net, o.head, n, &group.acts, (&mut group.values, c, first, o.channels));
        if o.are_shares {
            group.values.chunks_exact_mut(c).take(n).for_each(|row| shares::softmax(&mut row[first..first + o.channels]));
        }
        first += o.channels;
    }
    input.extras.copy(s0, c, &mut group.values);
    group.d_sigma.resize(n, 0.0);
    group.d_values.resize(n * c, 0.0);
    // With the number of channels known, the loops over them are unrolled.
    match c {
        3 => composite_block(input, shared, rays.clone(), loss, group, 3),
        _ => composite_block(input, shared, rays.clone(), loss, group, c),
    }
    if loss.is_some() {
        backward(input, shared, prepared, rays, s0, n, group);
        let k = input.extras.width;
        // SAFETY: this block's samples.
        let d_extras = unsafe { shared.d_extras.part(s0 * k..s1 * k) };
        for (d, row) in d_extras.chunks_exact_mut(k.max(1)).zip(group.d_values.chunks_exact(c)) {
            d.copy_from_slice(&row[c - k..]);
        }
    }
}

impl Extras<'_> {
    /// Copies those of the samples from `s0` on to the last columns of rows `[n, c]`.
    fn copy(&self, s0: usize, c: usize, rows: &mut [f32]) {
        let k = self.width;
        for (row, v) in rows.chunks_exact_mut(c).zip(self.values[s0 * k..].chunks_exact(k.max(1))) {
            row[c - k..].copy_from_slice(v);
        }
    }
}

/// Composites a block's rays; with a loss, also gives the gradients of its samples' densities and outputs.
#[inline(always)]
fn composite_block(
    input: &StepInput,
    shared: &Shared,
    rays: std::ops::Range<usize>,
    loss: Option<&dyn RayLoss>,
    group: &mut Group,
    c: usize,
) {
    let p = &input.samples;
    let (s0, s1) = (p.offsets[rays.start] as usize, p.offsets[rays.end] as usize);
    // SAFETY (all parts below): blocks own disjoint ranges of rays and therefore of samples.
    let weights = unsafe { shared.weights.part(s0..s1) };
    for r in rays {
        let span = p.range(r);
        let own = span.start - s0..span.end - s0;
        let w = &mut weights[own.clone()];
        let dt = &p.dt[span.clone()];
        let t_out = composite::ray_weights(&group.sigma[own.clone()], dt, w);
        let bg = &input.background[r * c..r * c + c];
        // SAFETY: ray r belongs to this block alone.
        let out = unsafe { shared.values.part(r * c..r * c + c) };
        for k in 0..c {
            out[k] = t_out * bg[k];
        }
        let mut depth = 0.0;
        for (j, i) in span.clone().enumerate() {
            depth += w[j] * (p.t[i] + 0.5 * dt[j]);
            for k in 0..c {
                out[k] += w[j] * group.values[(own.start + j) * c + k];
            }
        }
        // SAFETY: ray r belongs to this block alone.
        unsafe {
            shared.opacity.part(r..r + 1)[0] = 1.0 - t_out;
            shared.depth.part(r..r + 1)[0] = depth;
        }
        let Some(loss) = loss else { continue };
        group.g.clear();
        group.g.resize(span.len(), 0.0);
        group.d_ray.clear();
        group.d_ray.resize(c, 0.0);
        let output = RayOutput { values: out, opacity: 1.0 - t_out, depth, weights: w, first: span.start };
        let mut grad = RayGradient { values: &mut group.d_ray, opacity: 0.0, depth: 0.0, weights: &mut group.g };
        group.loss += loss.ray(r, &output, &mut grad);
        let (d_opacity, d_depth) = (grad.opacity, grad.depth);
        let d = &group.d_ray[..c];
        for (j, i) in span.clone().enumerate() {
            let at = (own.start + j) * c;
            let values = &group.values[at..at + c];
            let sum = (1..c).fold(d[0] * values[0], |sum, k| sum + d[k] * values[k]);
            group.g[j] += sum + d_depth * (p.t[i] + 0.5 * dt[j]);
            for k in 0..c {
                group.d_values[at + k] = w[j] * d[k];
            }
        }
        let g_out = (1..c).fold(d[0] * bg[0], |sum, k| sum + d[k] * bg[k]) - d_opacity;
        composite::ray_sigma_gradient(&group.sigma[own.clone()], dt, w, t_out, &group.g, g_out, &mut group.d_sigma[own.clone()]);
        for (j, i) in span.clone().enumerate() {
            let reach = (p.t[i] + 0.5 * dt[j]) / input.near_scaling;
            if reach < 1.0 {
                group.d_sigma[own.start + j] *= reach * reach;
                group.d_values[(own.start + j) * c..][..c].iter_mut().for_each(|d| *d *= reach * reach);
            }
        }
        // SAFETY: ray r belongs to this block alone.
        let d_background = unsafe { shared.d_background.part(r * c..r * c + c) };
        d_background.iter_mut().zip(d).for_each(|(b, d)| *b = d * t_out);
    }
}

/// Fills the network's inputs for the block's samples.
fn gather_inputs(input: &StepInput, shared: &Shared, rays: std::ops::Range<usize>, s0: usize, n: usize, group: &mut Group) {
    let widths = &input.net.mlp.input_widths;
    group.inputs.resize_with(widths.len(), Vec::new);
    for (v, w) in group.inputs.iter_mut().zip(widths) {
        v.resize(n * w, 0.0);
    }
    let total = input.samples.samples();
    if let Some((features, levels, width, _)) = &shared.features {
        for l in 0..*levels {
            let at = (l * total + s0) * width;
            // SAFETY: this block's samples.
            let part = unsafe { features.part(at..at + n * width) };
            for (row, f) in group.inputs[0].chunks_exact_mut(widths[0]).zip(part.chunks_exact(*width)) {
                row[l * width..(l + 1) * width].copy_from_slice(f);
            }
        }
    }
    if let Some((encoding, points, _)) = &shared.encoded {
        let d = encoding.dims();
        encoding.forward(&points[s0 * d..(s0 + n) * d], &mut group.inputs[0]);
    }
    if let Some(b) = input.beside {
        let d = b.encoding.dims();
        b.encoding.forward(&b.points[s0 * d..(s0 + n) * d], &mut group.inputs[widths.len() - 1]);
    }
    for (c, (values, width, _)) in shared.codes.iter().enumerate() {
        let mut rows = group.inputs[1 + c].chunks_exact_mut(*width);
        for r in rays.clone() {
            for _ in input.samples.range(r) {
                rows.next().expect("a row per sample").copy_from_slice(&values[r * width..(r + 1) * width]);
            }
        }
    }
}

/// Activated channels of a head.
fn read_head(net: &FieldNet, head: Head, n: usize, acts: &Activations, (out, stride, first, channels): Columns<&mut [f32]>) {
    let width = net.mlp.layers[head.layer].width;
    for (o, v) in out.chunks_exact_mut(stride).zip(acts.values[head.layer].chunks_exact(width)).take(n) {
        for k in 0..channels {
            o[first + k] = v[head.channel + k] + head.shift;
        }
    }
    if channels == stride {
        return crate::ops::linear::cpu::activate(head.activation, out);
    }
    for o in out.chunks_exact_mut(stride) {
        crate::ops::linear::cpu::activate(head.activation, &mut o[first..first + channels]);
    }
}

/// Adds the gradient of a head's channels to its layer's gradient.
fn write_head(net: &FieldNet, head: Head, acts: &mut Activations, out: &[f32], (d, stride, first, channels): Columns<&[f32]>) {
    let width = net.mlp.layers[head.layer].width;
    let g = acts.seed(head.layer);
    for ((g, y), d) in g.chunks_exact_mut(width).zip(out.chunks_exact(stride)).zip(d.chunks_exact(stride)) {
        for k in 0..channels {
            g[head.channel + k] += slope_from_output(head.activation, y[first + k]) * d[first + k];
        }
    }
}

fn backward(input: &StepInput, shared: &Shared, prepared: &Prepared, rays: std::ops::Range<usize>, s0: usize, n: usize, group: &mut Group) {
    let net = input.net;
    let widths = &net.mlp.input_widths;
    let c = input.channels();
    for (head, _) in net.heads() {
        let len = n * net.mlp.layers[head.layer].width;
        group.acts.seed(head.layer)[..len].fill(0.0);
    }
    write_head(net, net.density, &mut group.acts, &group.sigma, (&group.d_sigma, 1, 0, 1));
    let mut first = 0;
    for o in &net.outputs {
        let write = if o.are_shares { shares::write } else { write_head };
        write(net, o.head, &mut group.acts, &group.values, (&group.d_values, c, first, o.channels));
        first += o.channels;
    }
    group.d_inputs.resize_with(widths.len(), Vec::new);
    for (v, w) in group.d_inputs.iter_mut().zip(widths) {
        v.resize(n * w, 0.0);
    }
    let wanted = |i: usize| match i {
        0 => shared.features.as_ref().is_some_and(|f| f.3) || shared.encoded.as_ref().is_some_and(|e| e.2.is_some()),
        i if i > shared.codes.len() => input.beside.is_some_and(|b| b.wanted),
        i => shared.codes[i - 1].2.is_some(),
    };
    let inputs: Vec<&[f32]> = group.inputs.iter().map(|v| &v[..]).collect();
    let mut d_inputs: Vec<Option<&mut [f32]>> =
        group.d_inputs.iter_mut().enumerate().map(|(i, v)| wanted(i).then_some(&mut v[..])).collect();
    backward_block(&net.mlp, prepared, &inputs, n, &mut group.acts, &mut group.d_params, &mut d_inputs);
    let total = input.samples.samples();
    if let Some((features, levels, width, true)) = &shared.features {
        for l in 0..*levels {
            let at = (l * total + s0) * width;
            // SAFETY: this block's samples.
            let part = unsafe { features.part(at..at + n * width) };
            for (row, f) in group.d_inputs[0].chunks_exact(widths[0]).zip(part.chunks_exact_mut(*width)) {
                f.copy_from_slice(&row[l * width..(l + 1) * width]);
            }
        }
    }
    if let Some((encoding, points, Some(d_points))) = &shared.encoded {
        // SAFETY: this block's samples.
        let dims = encoding.dims();
        let d = unsafe { d_points.part(s0 * dims..(s0 + n) * dims) };
        encoding.backward(&points[s0 * dims..(s0 + n) * dims], &group.d_inputs[0], d);
    }
    if let Some(b) = input.beside.filter(|b| b.wanted) {
        let own = s0 * b.encoding.dims()..(s0 + n) * b.encoding.dims();
        // SAFETY: this block's samples.
        let d = unsafe { shared.d_beside.part(own.clone()) };
        b.encoding.backward(&b.points[own], &group.d_inputs[widths.len() - 1], d);
    }
    for (c, (_, width, gradient)) in shared.codes.iter().enumerate() {
        let Some(gradient) = gradient else { continue };
        let mut rows = group.d_inputs[1 + c].chunks_exact(*width);
        for r in rays.clone() {
            // SAFETY: ray r belongs to this block alone.
            let g = unsafe { gradient.part(r * width..(r + 1) * width) };
            g.fill(0.0);
            for _ in input.samples.range(r) {
                let row = rows.next().expect("a row per sample");
                g.iter_mut().zip(row).for_each(|(g, v)| *g += v);
            }
        }
    }
}
