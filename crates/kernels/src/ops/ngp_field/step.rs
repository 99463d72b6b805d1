//! The driver: rays are cut into a fixed number of groups, groups into blocks; each group sums its
//! parameter gradients apart and groups are added in order, so results do not depend on threads.

use super::disjoint::Disjoint;
use super::{FieldNet, Head, Positions, RayCode, RayGradient, RayLoss, RayOutput};
use crate::ops::composite::{Packed, cpu as composite};
use crate::ops::frequency;
use crate::ops::fused_mlp::cpu::{Activations, Prepared, backward_block, forward_block};
use crate::ops::linear::Activation;
use rayon::prelude::*;

/// Samples per block: activations of a 64-wide network stay in L2 with room to spare.
const BLOCK: usize = 252;
/// Most groups with gradients of their own, and samples that make another group worth its memory traffic.
const GROUPS: usize = 16;
const GROUP_SAMPLES: usize = 2048;

/// What a step reads.
#[derive(Clone, Copy)]
pub struct StepInput<'a> {
    pub net: &'a FieldNet,
    /// `[params_len]`
    pub params: &'a [f32],
    pub samples: Packed<'a>,
    /// `[R, 3]`
    pub background: &'a [f32],
    /// Distance `D` within which gradients of samples are scaled by `(t / D)²`, so that space close to a
    /// camera, which few rays share, learns no faster than the rest (Philip and Deschaintre 2023); 0: none.
    pub near_scaling: f32,
}

/// What a step gives per ray and per sample.
#[derive(Clone, Debug, Default)]
pub struct StepOutput {
    /// `[R, 3]`, background included.
    pub rgb: Vec<f32>,
    /// `[R]`
    pub opacity: Vec<f32>,
    /// `Σ w t`, `[R]`
    pub depth: Vec<f32>,
    /// `[S]`
    pub weights: Vec<f32>,
    /// `[R, 3]`, zero without a loss.
    pub d_background: Vec<f32>,
    pub loss: f64,
}

/// Memory kept between steps.
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
    rgb: Vec<f32>,
    d_sigma: Vec<f32>,
    d_rgb: Vec<f32>,
    g: Vec<f32>,
    d_params: Vec<f32>,
    loss: f64,
}

/// Per-ray and per-sample arrays that blocks write to.
struct Shared<'a> {
    features: Option<(Disjoint<'a>, usize, usize)>,
    encoded: Option<(frequency::Frequency, &'a [f32], Option<Disjoint<'a>>)>,
    codes: Vec<(&'a [f32], usize, Option<Disjoint<'a>>)>,
    rgb: Disjoint<'a>,
    opacity: Disjoint<'a>,
    depth: Disjoint<'a>,
    weights: Disjoint<'a>,
    d_background: Disjoint<'a>,
}

/// Evaluates and composites all samples; with a loss, also runs back and adds to `d_params`.
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
    let (r, s) = (input.samples.rays(), input.samples.samples());
    let mlp = &input.net.mlp;
    assert!(input.background.len() == r * 3 && input.params.len() == mlp.params_len(), "ngp field: shapes");
    assert_eq!(codes.len() + 1, mlp.input_widths.len(), "ngp field: codes");
    for (v, n) in [(&mut out.rgb, r * 3), (&mut out.opacity, r), (&mut out.depth, r), (&mut out.weights, s), (&mut out.d_background, r * 3)]
    {
        v.resize(n, 0.0);
    }
    let shared = Shared {
        features: None,
        encoded: None,
        codes: codes
            .iter_mut()
            .map(|c| {
                assert_eq!(c.values.len(), r * c.width, "ngp field: code");
                (c.values, c.width, c.gradient.as_mut().map(|g| Disjoint::new(g)))
            })
            .collect(),
        rgb: Disjoint::new(&mut out.rgb),
        opacity: Disjoint::new(&mut out.opacity),
        depth: Disjoint::new(&mut out.depth),
        weights: Disjoint::new(&mut out.weights),
        d_background: Disjoint::new(&mut out.d_background),
    };
    let shared = match positions {
        Positions::Features { data, levels, width } => {
            assert_eq!(data.len(), levels * s * width, "ngp field: features");
            Shared { features: Some((Disjoint::new(data), levels, width)), ..shared }
        }
        Positions::Encoded { encoding, points, d_points } => {
            assert_eq!(points.len(), s * 3, "ngp field: points");
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
    let n = s1 - s0;
    gather_inputs(input, shared, rays.clone(), s0, n, group);
    let inputs: Vec<&[f32]> = group.inputs.iter().map(|v| &v[..]).collect();
    forward_block(&net.mlp, input.params, &inputs, n, &mut group.acts);
    group.sigma.resize(n, 0.0);
    group.rgb.resize(n * 3, 0.0);
    read_head(net, net.sigma, 1, n, &group.acts, &mut group.sigma);
    read_head(net, net.rgb, 3, n, &group.acts, &mut group.rgb);
    group.d_sigma.resize(n, 0.0);
    group.d_rgb.resize(n * 3, 0.0);
    // SAFETY (all parts below): blocks own disjoint ranges of rays and therefore of samples.
    let weights = unsafe { shared.weights.part(s0..s1) };
    for r in rays.clone() {
        let span = p.range(r);
        let own = span.start - s0..span.end - s0;
        let w = &mut weights[own.clone()];
        let dt = &p.dt[span.clone()];
        let t_out = composite::ray_weights(&group.sigma[own.clone()], dt, w);
        let bg = &input.background[r * 3..r * 3 + 3];
        let mut rgb = [t_out * bg[0], t_out * bg[1], t_out * bg[2]];
        let mut depth = 0.0;
        for (j, i) in span.clone().enumerate() {
            depth += w[j] * (p.t[i] + 0.5 * dt[j]);
            for k in 0..3 {
                rgb[k] += w[j] * group.rgb[(own.start + j) * 3 + k];
            }
        }
        // SAFETY: ray r belongs to this block alone.
        unsafe {
            shared.rgb.part(r * 3..r * 3 + 3).copy_from_slice(&rgb);
            shared.opacity.part(r..r + 1)[0] = 1.0 - t_out;
            shared.depth.part(r..r + 1)[0] = depth;
        }
        let Some(loss) = loss else { continue };
        group.g.clear();
        group.g.resize(span.len(), 0.0);
        let output = RayOutput { rgb, opacity: 1.0 - t_out, depth, weights: w, first: span.start };
        let mut grad = RayGradient { rgb: [0.0; 3], opacity: 0.0, depth: 0.0, weights: &mut group.g };
        group.loss += loss.ray(r, &output, &mut grad);
        let RayGradient { rgb: d, opacity: d_opacity, depth: d_depth, .. } = grad;
        for (j, i) in span.clone().enumerate() {
            let at = (own.start + j) * 3;
            let c = &group.rgb[at..at + 3];
            group.g[j] += d[0] * c[0] + d[1] * c[1] + d[2] * c[2] + d_depth * (p.t[i] + 0.5 * dt[j]);
            for k in 0..3 {
                group.d_rgb[at + k] = w[j] * d[k];
            }
        }
        let g_out = d[0] * bg[0] + d[1] * bg[1] + d[2] * bg[2] - d_opacity;
        composite::ray_sigma_gradient(&group.sigma[own.clone()], dt, w, t_out, &group.g, g_out, &mut group.d_sigma[own.clone()]);
        for (j, i) in span.clone().enumerate() {
            let reach = (p.t[i] + 0.5 * dt[j]) / input.near_scaling;
            if reach < 1.0 {
                group.d_sigma[own.start + j] *= reach * reach;
                group.d_rgb[(own.start + j) * 3..][..3].iter_mut().for_each(|d| *d *= reach * reach);
            }
        }
        // SAFETY: ray r belongs to this block alone.
        unsafe { shared.d_background.part(r * 3..r * 3 + 3) }.copy_from_slice(&d.map(|d| d * t_out));
    }
    if loss.is_some() {
        backward(input, shared, prepared, rays, s0, n, group);
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
    if let Some((features, levels, width)) = &shared.features {
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
        frequency::cpu::forward(encoding, &points[s0 * 3..(s0 + n) * 3], &mut group.inputs[0]);
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

/// Activated channels of a head, `[n, channels]`.
fn read_head(net: &FieldNet, head: Head, channels: usize, n: usize, acts: &Activations, out: &mut [f32]) {
    let width = net.mlp.layers[head.layer].width;
    for (o, v) in out.chunks_exact_mut(channels).zip(acts.values[head.layer].chunks_exact(width)).take(n) {
        for k in 0..channels {
            o[k] = v[head.channel + k] + head.shift;
        }
    }
    crate::ops::linear::cpu::activate(head.activation, out);
}

/// Adds the gradient of a head's channels to its layer's gradient.
fn write_head(net: &FieldNet, head: Head, channels: usize, out: &[f32], d: &[f32], acts: &mut Activations) {
    let width = net.mlp.layers[head.layer].width;
    let slope = |y: f32| match head.activation {
        Activation::None => 1.0,
        a => crate::ops::linear::cpu::slope_from_output(a, y),
    };
    let g = acts.seed(head.layer);
    for ((g, y), d) in g.chunks_exact_mut(width).zip(out.chunks_exact(channels)).zip(d.chunks_exact(channels)) {
        for k in 0..channels {
            g[head.channel + k] += slope(y[k]) * d[k];
        }
    }
}

fn backward(input: &StepInput, shared: &Shared, prepared: &Prepared, rays: std::ops::Range<usize>, s0: usize, n: usize, group: &mut Group) {
    let net = input.net;
    let widths = &net.mlp.input_widths;
    for head in [net.sigma, net.rgb] {
        let len = n * net.mlp.layers[head.layer].width;
        group.acts.seed(head.layer)[..len].fill(0.0);
    }
    write_head(net, net.sigma, 1, &group.sigma, &group.d_sigma, &mut group.acts);
    write_head(net, net.rgb, 3, &group.rgb, &group.d_rgb, &mut group.acts);
    group.d_inputs.resize_with(widths.len(), Vec::new);
    for (v, w) in group.d_inputs.iter_mut().zip(widths) {
        v.resize(n * w, 0.0);
    }
    let wanted = |i: usize| match i {
        0 => shared.features.is_some() || shared.encoded.as_ref().is_some_and(|e| e.2.is_some()),
        i => shared.codes[i - 1].2.is_some(),
    };
    let inputs: Vec<&[f32]> = group.inputs.iter().map(|v| &v[..]).collect();
    let mut d_inputs: Vec<Option<&mut [f32]>> =
        group.d_inputs.iter_mut().enumerate().map(|(i, v)| wanted(i).then_some(&mut v[..])).collect();
    backward_block(&net.mlp, prepared, &inputs, n, &mut group.acts, &mut group.d_params, &mut d_inputs);
    let total = input.samples.samples();
    if let Some((features, levels, width)) = &shared.features {
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
        let d = unsafe { d_points.part(s0 * 3..(s0 + n) * 3) };
        frequency::cpu::backward(encoding, &points[s0 * 3..(s0 + n) * 3], &group.d_inputs[0], d);
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
