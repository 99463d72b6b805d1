//! The standard field on a device: encoded positions, network, compositing, and their gradients.

use super::{FieldNet, Output, shares};
use crate::gpu::{Accumulate, Buffer, Gpu, Rows, launch};
use crate::ops::composite::gpu::{self as composite, GpuComposited, GpuGradients, GpuPacked};
use crate::ops::fused_mlp::gpu::fused::{Element, Fused, Kept, tensor_element};
use crate::ops::fused_mlp::gpu::{self as mlp, columns};
use crate::ops::fused_mlp::{Head, Mlp, reference};
use crate::ops::linear::gpu as linear;
use crate::ops::linear::reference::{activate, slope};
use crate::ops::prune::gpu::{Joined, Pruned};
use cubecl::prelude::*;
use diorama_geom::rng::Rng;

/// Arithmetic and launches of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arithmetic {
    /// In one launch, on tensor cores if the device has them.
    Best,
    /// In one launch, in f32.
    Exact,
    /// Layer by layer, in f32.
    Layers,
}

/// A field's network on a device: in one launch where the device can and the network is small enough, else layer by layer.
pub struct GpuNet {
    pub net: FieldNet,
    /// The layers up to the density head.
    density: Mlp,
    /// Numbers per row and level of a hash grid; 0: positions are encoded in rows.
    per_level: usize,
    /// The whole network, and what its density needs.
    fused: Option<[Fused; 2]>,
}

/// Samples as a network reads them.
///
/// # Shapes
/// features: as [`GpuNet::features`] gives them; codes: `[R, K_i]`; beside, a second encoding of the positions: `[S, K]`.
#[derive(Clone, Copy)]
pub struct FieldInput<'a> {
    pub packed: &'a GpuPacked,
    pub features: &'a Buffer,
    pub codes: &'a [&'a Buffer],
    pub beside: Option<&'a Buffer>,
}

impl GpuNet {
    /// `density` is the network up to its density head, which reads input 0 alone; `wanted` says of which inputs
    /// gradients are asked.
    pub fn new(gpu: &Gpu, net: &FieldNet, density: &Mlp, per_level: usize, wanted: &[bool], arithmetic: Arithmetic) -> Self {
        let element = match arithmetic {
            Arithmetic::Best => tensor_element(gpu).unwrap_or(Element::F32),
            _ => Element::F32,
        };
        let both = |element| {
            if net.outputs.iter().any(|o| o.are_shares) {
                return None;
            }
            let whole = Fused::new(gpu, &net.mlp, &net.heads().collect::<Vec<_>>(), per_level, wanted, element)?;
            let part = Fused::new(gpu, density, &[(net.density, 1)], per_level, &wanted[..1], element)?;
            Some([whole, part])
        };
        let mut fused = if arithmetic == Arithmetic::Layers { None } else { both(element) };
        if element != Element::F32
            && let Some([whole, _]) = &fused
            && !agrees(gpu, net, whole, per_level)
        {
            fused = both(Element::F32);
        }
        GpuNet { net: net.clone(), density: density.clone(), per_level, fused }
    }

    /// Element type of a network that runs in one launch; `None` if it runs layer by layer.
    pub fn element(&self) -> Option<Element> {
        self.fused.as_ref().map(|[whole, _]| whole.element)
    }

    /// Whether features are wanted level by level, `[L, S, F]`, rather than in rows.
    fn in_levels(&self) -> bool {
        self.fused.is_some() && self.per_level > 0
    }

    /// Features of a hash grid `[L, S, F]` as the network reads them.
    pub fn features(&self, gpu: &Gpu, rows: &Rows, levels: Buffer) -> Buffer {
        if self.in_levels() { levels } else { transpose_levels(gpu, rows, &levels, self.per_level, self.net.mlp.input_widths[0], true) }
    }

    /// Features of the samples that stay.
    pub fn take(&self, gpu: &Gpu, pruned: &Pruned, features: &Buffer) -> Buffer {
        let width = self.net.mlp.input_widths[0];
        if self.in_levels() { pruned.take_levels(gpu, features, width, self.per_level) } else { pruned.take(gpu, features, width) }
    }

    /// Features of the samples of two marches.
    pub fn join(&self, gpu: &Gpu, joined: &Joined, of: [&Buffer; 2]) -> Buffer {
        let width = self.net.mlp.input_widths[0];
        if self.in_levels() { joined.take_levels(gpu, of, width, self.per_level) } else { joined.take(gpu, of, width) }
    }

    /// Densities `[S]` of features as the network reads them.
    pub fn density(&self, gpu: &Gpu, params: &Buffer, features: &Buffer, rows: &Rows) -> Buffer {
        match &self.fused {
            Some([_, part]) => part.forward(gpu, params, &[features], rows, false).heads.remove(0),
            None => {
                let values = mlp::forward(gpu, &self.density, params, &[features], rows);
                head(gpu, &self.net, self.net.density, &values, rows, 1)
            }
        }
    }

    /// Densities and colors of packed samples; with `keep`, also what [`GpuNet::gradients`] needs.
    pub fn evaluate(&self, gpu: &Gpu, params: &Buffer, input: &FieldInput, keep: bool) -> Evaluated {
        let (p, rows) = (input.packed, input.packed.rows());
        let mut inputs = vec![input.features.clone()];
        for (code, width) in input.codes.iter().zip(&self.net.mlp.input_widths[1..]) {
            let per_sample = gpu.empty(rows.most * width);
            expand_ray_code(gpu, p, code, &per_sample, *width, true);
            inputs.push(per_sample);
        }
        inputs.extend(input.beside.cloned());
        let refs: Vec<&Buffer> = inputs.iter().collect();
        let (values, sigma, outputs) = match &self.fused {
            Some([whole, _]) => {
                let kept = whole.forward(gpu, params, &refs, &rows, keep);
                let (sigma, outputs) = (kept.heads[0].clone(), kept.heads[1].clone());
                (Values::Kept(kept), sigma, outputs)
            }
            None => {
                let values = mlp::forward(gpu, &self.net.mlp, params, &refs, &rows);
                let sigma = head(gpu, &self.net, self.net.density, &values, &rows, 1);
                let outputs = self.side_by_side(gpu, &values, &rows);
                (Values::Layers(values), sigma, outputs)
            }
        };
        Evaluated { packed: p.clone(), codes: input.codes.len(), inputs, values, sigma, outputs }
    }

    /// Activated channels of all outputs, `[S, C]`.
    fn side_by_side(&self, gpu: &Gpu, values: &mlp::Values, rows: &Rows) -> Buffer {
        if let [only] = &self.net.outputs[..] {
            return output(gpu, &self.net, only, values, rows);
        }
        let c = self.net.channels();
        let (out, mut first) = (gpu.empty(rows.most * c), 0);
        for o in &self.net.outputs {
            let own = output(gpu, &self.net, o, values, rows);
            columns(gpu, rows, o.channels, (&own, o.channels, 0), (&out, c, first), false);
            first += o.channels;
        }
        out
    }

    /// [`GpuNet::evaluate`], composited on a background `[R, C]`.
    pub fn forward(&self, gpu: &Gpu, params: &Buffer, input: &FieldInput, background: &Buffer, keep: bool) -> GpuStep {
        let at = self.evaluate(gpu, params, input, keep);
        let out = composite::forward(gpu, &at.packed, &at.sigma, &at.outputs, self.net.channels(), background);
        GpuStep { out, at, background: background.clone() }
    }

    /// Gradients of parameters, features and codes, given those of densities and colors.
    pub fn gradients(&self, gpu: &Gpu, params: &Buffer, at: &Evaluated, g: &GpuGradients) -> GpuStepGradients {
        let (p, rows, net) = (&at.packed, at.packed.rows(), &self.net);
        let inputs: Vec<&Buffer> = at.inputs.iter().collect();
        let (d_params, d_inputs) = match (&self.fused, &at.values) {
            (Some([whole, _]), Values::Kept(kept)) => {
                // The loss is a mean over rays.
                let scale = (p.rays().max(1) as f32 * HALF_SCALE).log2().floor().exp2();
                whole.backward(gpu, params, &inputs, kept, &rows, (&[&g.sigma, &g.features], scale))
            }
            (_, Values::Layers(values)) => {
                let mut seeds: Vec<Option<Buffer>> = net.mlp.layers.iter().map(|_| None).collect();
                let (c, mut first) = (net.channels(), 0);
                for (i, (h, channels)) in net.heads().enumerate() {
                    let own = |all: &Buffer| {
                        let part = gpu.empty(rows.most * channels);
                        columns(gpu, &rows, channels, (all, c, first), (&part, channels, 0), false);
                        part
                    };
                    let (out, d) = match i {
                        0 => (at.sigma.clone(), g.sigma.clone()),
                        _ if channels == c => (at.outputs.clone(), g.features.clone()),
                        _ => (own(&at.outputs), own(&g.features)),
                    };
                    first += if i == 0 { 0 } else { channels };
                    let slope = match i {
                        1.. if net.outputs[i - 1].are_shares => shares::gpu::backward(gpu, &rows, channels, &out, &d),
                        _ => linear::before_activation(gpu, &rows, channels, h.activation, &out, &d),
                    };
                    let width = net.mlp.layers[h.layer].width;
                    let seed = seeds[h.layer].get_or_insert_with(|| gpu.zeros(rows.most * width));
                    columns(gpu, &rows, channels, (&slope, channels, 0), (seed, width, h.channel), true);
                }
                let (d_params, d_inputs) = mlp::backward(gpu, &net.mlp, params, &inputs, values, &rows, seeds);
                (d_params, d_inputs.into_iter().map(Some).collect())
            }
            (None, Values::Kept(_)) => unreachable!("the step is another network's"),
        };
        let mut d_inputs = d_inputs.into_iter();
        let features = d_inputs.next().flatten().map(|d| {
            let turned = self.per_level > 0 && !self.in_levels();
            if turned { transpose_levels(gpu, &rows, &d, self.per_level, net.mlp.input_widths[0], false) } else { d }
        });
        let mut others: Vec<Option<Buffer>> = d_inputs.collect();
        let beside = others.split_off(at.codes.min(others.len())).pop().flatten();
        let codes = others.into_iter().zip(&net.mlp.input_widths[1..]).map(|(d, width)| {
            d.map(|d| {
                let sum = gpu.empty(p.rays() * width);
                expand_ray_code(gpu, p, &sum, &d, *width, false);
                sum
            })
        });
        GpuStepGradients { codes: codes.collect(), beside, params: d_params, features, background: g.background.clone() }
    }

    /// [`GpuNet::gradients`], given those of what compositing gave; see [`super::StepInput::near_scaling`].
    pub fn backward(&self, gpu: &Gpu, params: &Buffer, step: &GpuStep, d: &GpuComposited, near_scaling: f32) -> GpuStepGradients {
        let p = &step.at.packed;
        let g = composite::backward(gpu, p, &step.at.outputs, self.net.channels(), &step.background, &step.out, d);
        if near_scaling > 0.0 {
            scale_near_gradients(gpu, p, &g.sigma, &g.features, near_scaling);
        }
        self.gradients(gpu, params, &step.at, &g)
    }
}

/// Whether tensor cores agree with the reference on a few rows, forward and backward: a driver that multiplies wrongly must not spoil a
/// run unnoticed.
fn agrees(gpu: &Gpu, net: &FieldNet, whole: &Fused, per_level: usize) -> bool {
    const ROWS: usize = 80;
    let noise = |n: usize, stream: u64| -> Vec<f32> {
        let rng = Rng::new(1, stream);
        (0..n).map(|i| rng.uniform(i as u64) * 2.0 - 1.0).collect()
    };
    let wide = |v: &[f32]| v.iter().map(|v| *v as f64).collect::<Vec<f64>>();
    let (mlp, params) = (&net.mlp, net.mlp.init(&Rng::new(1, 0)));
    let inputs: Vec<Vec<f32>> = mlp.input_widths.iter().enumerate().map(|(i, w)| noise(ROWS * w, 1 + i as u64)).collect();
    let d: Vec<Vec<f32>> = net.heads().enumerate().map(|(i, (_, channels))| noise(ROWS * channels, 11 + i as u64)).collect();

    let wide_inputs: Vec<Vec<f64>> = inputs.iter().map(|v| wide(v)).collect();
    let refs: Vec<&[f64]> = wide_inputs.iter().map(|v| &v[..]).collect();
    let values = reference::forward(mlp, &wide(&params), &refs, ROWS);
    let mut seeds: Vec<Vec<f64>> = mlp.layers.iter().map(|l| vec![0.0; ROWS * l.width]).collect();
    let mut heads = Vec::new();
    for ((h, channels), d) in net.heads().zip(&d) {
        let width = mlp.layers[h.layer].width;
        heads.push(
            (0..ROWS * channels)
                .map(|e| {
                    let at = e / channels * width + h.channel + e % channels;
                    let x = values[h.layer][at] + h.shift as f64;
                    seeds[h.layer][at] += d[e] as f64 * slope(h.activation, x);
                    activate(h.activation, x)
                })
                .collect::<Vec<f64>>(),
        );
    }
    let (want, _) = reference::backward(mlp, &wide(&params), &refs, ROWS, &seeds);

    let up = |v: &[f32]| gpu.upload(v);
    let (rows, params) = (Rows::all(gpu, ROWS), up(&params));
    let mut on_gpu: Vec<Buffer> = inputs.iter().map(|v| up(v)).collect();
    if per_level > 0 {
        on_gpu[0] = transpose_levels(gpu, &rows, &on_gpu[0], per_level, mlp.input_widths[0], false);
    }
    let refs: Vec<&Buffer> = on_gpu.iter().collect();
    let kept = whole.forward(gpu, &params, &refs, &rows, true);
    let d: Vec<Buffer> = d.iter().map(|d| up(d)).collect();
    let (got, _) = whole.backward(gpu, &params, &refs, &kept, &rows, (&d.iter().collect::<Vec<_>>(), HALF_SCALE));
    let energy = |v: &mut dyn Iterator<Item = f64>| v.map(|x| x * x).sum::<f64>().sqrt();
    let close = |got: &Buffer, want: &[f64]| {
        gpu.read(got).is_ok_and(|got| {
            let error = energy(&mut got.iter().zip(want).map(|(g, w)| *g as f64 - w));
            got.len() == want.len() && error <= 0.25 * energy(&mut want.iter().copied())
        })
    };
    kept.heads.iter().zip(&heads).all(|(got, want)| close(got, want)) && close(&got, &want)
}

/// Factor of gradients in half precision, per ray of the batch, because they belong to a mean over rays.
const HALF_SCALE: f32 = 64.0;

/// Activations of a forward pass.
enum Values {
    Kept(Kept),
    Layers(mlp::Values),
}

/// Densities `[S]` and outputs `[S, C]`, with the values that a backward pass needs.
pub struct Evaluated {
    packed: GpuPacked,
    codes: usize,
    inputs: Vec<Buffer>,
    values: Values,
    pub sigma: Buffer,
    pub outputs: Buffer,
}

/// Values that a forward pass keeps for the backward pass.
pub struct GpuStep {
    pub out: GpuComposited,
    at: Evaluated,
    background: Buffer,
}

/// Gradients of a step.
pub struct GpuStepGradients {
    pub params: Buffer,
    /// Of a hash grid level by level, `[L, S, F]`, else in rows `[S, K]`; none: not wanted.
    pub features: Option<Buffer>,
    /// Per code, `[R, K]`, where wanted.
    pub codes: Vec<Option<Buffer>>,
    /// Of the second encoding, `[S, K]`, where wanted.
    pub beside: Option<Buffer>,
    pub background: Buffer,
}

/// Activated channels of a layer, `[S, channels]`.
fn head(gpu: &Gpu, net: &FieldNet, h: Head, values: &mlp::Values, rows: &Rows, channels: usize) -> Buffer {
    linear::head(gpu, rows, (&values.layers[h.layer], net.mlp.layers[h.layer].width, h.channel), channels, h.shift, h.activation)
}

/// Values of an output, `[S, channels]`.
fn output(gpu: &Gpu, net: &FieldNet, o: &Output, values: &mlp::Values, rows: &Rows) -> Buffer {
    let own = head(gpu, net, o.head, values, rows, o.channels);
    if o.are_shares {
        shares::gpu::forward(gpu, rows, o.channels, &own);
    }
    own
}

/// Rows `[R, width]` of `table` `[N, width]` named by `index` `[R]`.
pub fn look_up(gpu: &Gpu, table: &Buffer, index: &Buffer<u32>, width: usize) -> Buffer {
    let rows = index.len();
    let (n, out) = (rows * width, gpu.empty(rows * width));
    launch!(gpu, read_rows, n, [table => table.len(), index => rows, out => n], n as u32, width as u32);
    out
}

/// Adds rows `d` `[R, width]` to the gradient of the table.
pub fn look_up_backward(gpu: &Gpu, d: &Buffer, index: &Buffer<u32>, width: usize, d_table: &Buffer) {
    let rows = index.len();
    let n = rows * width;
    launch!(gpu, add_rows::<Adder>, n, [d => n, index => rows, d_table => d_table.len()], n as u32, width as u32);
}

/// Scales gradients of densities `[S]` and outputs `[S, C]` of samples closer than `reach` by the square of their share of it.
pub fn scale_near_gradients(gpu: &Gpu, p: &GpuPacked, d_sigma: &Buffer, d_outputs: &Buffer, reach: f32) {
    let (rows, s) = (p.rows(), p.t.len());
    let channels = d_outputs.len() / s.max(1);
    launch!(
        gpu,
        scale_near,
        s,
        [rows.live => rows.at + 1, p.t => s, p.dt => s, d_sigma => s, d_outputs => s * channels],
        rows.place(),
        channels as u32,
        reach,
    );
}

/// Transposes features from level-major to row-major order, or from row-major to level-major.
fn transpose_levels(gpu: &Gpu, rows: &Rows, from: &Buffer, per_level: usize, dims: usize, to_rows: bool) -> Buffer {
    let n = rows.most * dims;
    let to = gpu.empty(n);
    launch!(
        gpu,
        transpose,
        n,
        [rows.live => rows.at + 1, from => n, to => n],
        rows.place(),
        rows.most as u32,
        per_level as u32,
        dims as u32,
        to_rows,
    );
    to
}

/// Copies each ray's code `[R, K]` to its samples `[S, K]`, or sums samples' gradients per ray.
fn expand_ray_code(gpu: &Gpu, p: &GpuPacked, code: &Buffer, samples: &Buffer, width: usize, spread: bool) {
    let (rays, s) = (p.rays(), p.t.len());
    let n = rays * width;
    launch!(
        gpu,
        share,
        n,
        [p.offsets => rays + 1, code => n, samples => s * width],
        n as u32,
        width as u32,
        spread,
    );
}

#[cube(launch_unchecked)]
fn transpose(live: &[u32], from: &[f32], to: &mut [f32], at: u32, samples: u32, per_level: u32, dims: u32, #[comptime] to_rows: bool) {
    let unit = ABSOLUTE_POS;
    if unit >= live[at as usize] as usize * dims as usize {
        terminate!();
    }
    let f = per_level as usize;
    let row = unit / dims as usize;
    let col = unit % dims as usize;
    let level_major = (col / f * samples as usize + row) * f + col % f;
    if comptime!(to_rows) {
        to[unit] = from[level_major];
    } else {
        to[level_major] = from[unit];
    }
}

#[cube(launch_unchecked)]
fn share(offsets: &[u32], code: &mut [f32], samples: &mut [f32], n: u32, width: u32, #[comptime] spread: bool) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let k = width as usize;
    let r = unit / k;
    let col = unit % k;
    let mut sum = 0.0f32;
    for i in offsets[r] as usize..offsets[r + 1] as usize {
        if comptime!(spread) {
            samples[i * k + col] = code[unit];
        } else {
            sum += samples[i * k + col];
        }
    }
    if comptime!(!spread) {
        code[unit] = sum;
    }
}

#[cube(launch_unchecked)]
fn read_rows(table: &[f32], index: &[u32], out: &mut [f32], n: u32, width: u32) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    let w = width as usize;
    out[i] = table[index[i / w] as usize * w + i % w];
}

#[cube(launch_unchecked)]
fn add_rows<A: Accumulate>(d: &[f32], index: &[u32], d_table: &[Atomic<A::Cell>], n: u32, width: u32) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    let w = width as usize;
    A::add(&d_table[index[i / w] as usize * w + i % w], d[i]);
}

#[cube(launch_unchecked)]
fn scale_near(live: &[u32], t: &[f32], dt: &[f32], d_sigma: &mut [f32], d_outputs: &mut [f32], at: u32, channels: u32, reach: f32) {
    let i = ABSOLUTE_POS;
    if i >= live[at as usize] as usize {
        terminate!();
    }
    let share = (t[i] + 0.5 * dt[i]) / reach;
    if share < 1.0 {
        d_sigma[i] *= share * share;
        for k in 0..channels as usize {
            d_outputs[i * channels as usize + k] *= share * share;
        }
    }
}
