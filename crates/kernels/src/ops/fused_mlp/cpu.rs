//! One block of rows at a time; fused ops call [`forward_block`] and [`backward_block`].

use super::{Layer, Mlp, Source};
use crate::gemm::{self, Gemm, Init, View, gemm};
use crate::ops::linear::Activation;
use crate::ops::linear::cpu::{activate, scale_by_slope};
use rayon::prelude::*;

/// Rows per block of the stand-alone op.
const BLOCK: usize = 192;
/// Groups of blocks with parameter gradients of their own, added in order.
const GROUPS: usize = 16;

/// Parameters with each weight's transpose beside it, made once per step.
#[derive(Clone, Debug, Default)]
pub struct Prepared {
    transposed: Vec<Vec<f32>>,
}

impl Prepared {
    /// Updates the transposes from `params`.
    pub fn update(&mut self, mlp: &Mlp, params: &[f32]) {
        self.transposed.resize_with(mlp.layers.len(), Vec::new);
        for j in 0..mlp.layers.len() {
            gemm::transpose(mlp.fan_in(j), mlp.layers[j].width, &params[mlp.offsets[j]..], &mut self.transposed[j]);
        }
    }
}

/// Values and gradients of every layer for one block.
#[derive(Clone, Debug, Default)]
pub struct Activations {
    pub values: Vec<Vec<f32>>,
    pub grads: Vec<Vec<f32>>,
    /// Products before the activation, of layers whose slope needs them.
    pre: Vec<Vec<f32>>,
    /// Scaled inputs of modulated layers, concatenated.
    scaled: Vec<Vec<f32>>,
    seeded: Vec<bool>,
    /// Whether a layer's output needs a gradient, because a layer below it is trained or an input's gradient is wanted.
    wanted: Vec<bool>,
    input_seeded: Vec<bool>,
    d_scaled: Vec<f32>,
}

impl Activations {
    fn fit(&mut self, mlp: &Mlp, n: usize) {
        let layers = mlp.layers.len();
        for v in [&mut self.values, &mut self.grads, &mut self.pre, &mut self.scaled] {
            v.resize_with(layers, Vec::new);
        }
        self.seeded.clear();
        self.seeded.resize(layers, false);
        let grow = |v: &mut Vec<f32>, len: usize| {
            if v.len() < len {
                v.resize(len, 0.0);
            }
        };
        for (j, layer) in mlp.layers.iter().enumerate() {
            grow(&mut self.values[j], n * layer.width);
            grow(&mut self.grads[j], n * layer.width);
            if !layer.activation.is_monotonic() {
                grow(&mut self.pre[j], n * layer.width);
            }
            if layer.modulation.is_some() {
                grow(&mut self.scaled[j], n * mlp.fan_in(j));
            }
        }
    }

    /// The gradient buffer `[n, width]` of a layer's output, to be filled before [`backward_block`].
    pub fn seed(&mut self, layer: usize) -> &mut [f32] {
        self.seeded[layer] = true;
        &mut self.grads[layer]
    }

    /// Marks the layers whose gradients reach a trained layer or an input whose gradient is wanted.
    fn mark_wanted(&mut self, mlp: &Mlp, is_asked: impl Fn(usize) -> bool) {
        self.wanted.clear();
        for layer in &mlp.layers {
            let below = layer.inputs.iter().any(|s| match *s {
                Source::Input(i) => is_asked(i),
                Source::Layer(i) => self.wanted[i],
            });
            self.wanted.push(!layer.frozen || below || layer.modulation.is_some_and(&is_asked));
        }
    }
}

/// Fills `acts.values` with every layer's output for `n` rows.
///
/// # Shapes
/// inputs: `[n, K_i]` each.
pub fn forward_block(mlp: &Mlp, params: &[f32], inputs: &[&[f32]], n: usize, acts: &mut Activations) {
    acts.fit(mlp, n);
    for (j, layer) in mlp.layers.iter().enumerate() {
        let (width, is_relu) = (layer.width, layer.activation == Activation::Relu);
        let (before, rest) = acts.values.split_at_mut(j);
        let out = &mut rest[0][..n * width];
        let mut at = mlp.offsets[j];
        let bias = at + mlp.fan_in(j) * width;
        let start = if layer.bias { Init::Bias(&params[bias..bias + width]) } else { Init::Zero };
        if let Some(m) = layer.modulation {
            let k = mlp.fan_in(j);
            let x = &mut acts.scaled[j][..n * k];
            join(mlp, layer, inputs, before, x);
            scale_rows(x, k, inputs[m], k + width);
            gemm(
                mlp.precision,
                Gemm { m: n, n: width, k, a: View::rows(x, k), b: &params[at..], ldb: width, ldc: width, init: start, relu: false },
                out,
            );
            for (o, row) in out.chunks_exact_mut(width).zip(inputs[m].chunks_exact(k + width)) {
                o.iter_mut().zip(&row[k..]).for_each(|(o, b)| *o += b);
            }
        } else {
            for (q, s) in layer.inputs.iter().enumerate() {
                let k = mlp.source_width(*s);
                let init = if q == 0 { start } else { Init::Accumulate };
                let relu = is_relu && q + 1 == layer.inputs.len();
                let x = read(*s, inputs, before);
                gemm(
                    mlp.precision,
                    Gemm { m: n, n: width, k, a: View::rows(x, k), b: &params[at..], ldb: width, ldc: width, init, relu },
                    out,
                );
                at += k * width;
            }
        }
        if !layer.activation.is_monotonic() {
            acts.pre[j][..n * width].copy_from_slice(out);
        }
        if !is_relu || layer.modulation.is_some() {
            activate(layer.activation, out);
        }
    }
}

fn read<'a>(s: Source, inputs: &[&'a [f32]], values: &'a [Vec<f32>]) -> &'a [f32] {
    match s {
        Source::Input(i) => inputs[i],
        Source::Layer(i) => &values[i],
    }
}

/// Concatenated inputs of a layer, `[n, K]`.
fn join(mlp: &Mlp, layer: &Layer, inputs: &[&[f32]], values: &[Vec<f32>], out: &mut [f32]) {
    let total: usize = layer.inputs.iter().map(|s| mlp.source_width(*s)).sum();
    let mut first = 0;
    for s in &layer.inputs {
        let k = mlp.source_width(*s);
        for (o, x) in out.chunks_exact_mut(total).zip(read(*s, inputs, values).chunks_exact(k)) {
            o[first..first + k].copy_from_slice(x);
        }
        first += k;
    }
}

/// Scales rows of length `k` by those of a code with rows `stride` apart.
fn scale_rows(x: &mut [f32], k: usize, code: &[f32], stride: usize) {
    for (x, code) in x.chunks_exact_mut(k).zip(code.chunks_exact(stride)) {
        x.iter_mut().zip(code).for_each(|(x, a)| *x *= a);
    }
}

/// Adds parameter gradients to `d_params` and overwrites the wanted gradients of inputs.
/// Gradients of layer outputs enter through [`Activations::seed`]. Frozen layers, and layers below them that nothing else needs, are skipped.
///
/// # Shapes
/// inputs and d_inputs: `[n, K_i]`; d_params: `[params_len]`.
pub fn backward_block(
    mlp: &Mlp,
    prepared: &Prepared,
    inputs: &[&[f32]],
    n: usize,
    acts: &mut Activations,
    d_params: &mut [f32],
    d_inputs: &mut [Option<&mut [f32]>],
) {
    acts.mark_wanted(mlp, |i| d_inputs[i].is_some());
    acts.input_seeded.clear();
    acts.input_seeded.resize(inputs.len(), false);
    for (j, layer) in mlp.layers.iter().enumerate().rev() {
        if !acts.seeded[j] || !acts.wanted[j] {
            continue;
        }
        let width = layer.width;
        let g = &mut acts.grads[j][..n * width];
        scale_by_slope(layer.activation, &acts.pre[j], &acts.values[j], g);
        if !layer.frozen && layer.bias {
            let at = mlp.offsets[j + 1] - width;
            let d_bias = &mut d_params[at..at + width];
            for row in g.chunks_exact(width) {
                d_bias.iter_mut().zip(row).for_each(|(b, g)| *b += g);
            }
        }
        let block = Block { mlp, prepared, inputs, n };
        match layer.modulation {
            Some(m) => block.backward_modulated(j, m, acts, d_params, d_inputs),
            None => block.backward_layer(j, acts, d_params, d_inputs),
        }
    }
}

/// Inputs of the backward pass of a block of rows.
#[derive(Clone, Copy)]
struct Block<'a> {
    mlp: &'a Mlp,
    prepared: &'a Prepared,
    inputs: &'a [&'a [f32]],
    n: usize,
}

impl Block<'_> {
    /// Backward pass of one layer, whose gradient before the activation is in `acts.grads`.
    fn backward_layer(&self, j: usize, acts: &mut Activations, d_params: &mut [f32], d_inputs: &mut [Option<&mut [f32]>]) {
        let (mlp, n, layer) = (self.mlp, self.n, &self.mlp.layers[j]);
        let (precision, width, total) = (mlp.precision, layer.width, mlp.fan_in(j));
        let (before, rest) = acts.grads.split_at_mut(j);
        let g = &rest[0][..n * width];
        let wt = &self.prepared.transposed[j];
        let (mut at, mut first) = (mlp.offsets[j], 0);
        for s in &layer.inputs {
            let k = mlp.source_width(*s);
            if !layer.frozen {
                let x = View::transposed(read(*s, self.inputs, &acts.values), k);
                gemm(
                    precision,
                    Gemm { m: k, n: width, k: n, a: x, b: g, ldb: width, ldc: width, init: Init::Accumulate, relu: false },
                    &mut d_params[at..at + k * width],
                );
            }
            let (target, seeded) = match *s {
                Source::Input(i) => (d_inputs[i].as_deref_mut(), &mut acts.input_seeded[i]),
                Source::Layer(i) => (acts.wanted[i].then_some(&mut before[i][..]), &mut acts.seeded[i]),
            };
            if let Some(target) = target {
                let init = if *seeded { Init::Accumulate } else { Init::Zero };
                gemm(
                    precision,
                    Gemm { m: n, n: k, k: width, a: View::rows(g, width), b: &wt[first..], ldb: total, ldc: k, init, relu: false },
                    target,
                );
                *seeded = true;
            }
            at += k * width;
            first += k;
        }
    }

    /// [`Self::backward_layer`] for a layer that input `m` modulates.
    fn backward_modulated(&self, j: usize, m: usize, acts: &mut Activations, d_params: &mut [f32], d_inputs: &mut [Option<&mut [f32]>]) {
        let (mlp, n, layer) = (self.mlp, self.n, &self.mlp.layers[j]);
        let (precision, width, total, at) = (mlp.precision, layer.width, mlp.fan_in(j), mlp.offsets[j]);
        let (before, rest) = acts.grads.split_at_mut(j);
        let g = &rest[0][..n * width];
        if !layer.frozen {
            let x = View::transposed(&acts.scaled[j], total);
            let d_weight = &mut d_params[at..at + total * width];
            gemm(
                precision,
                Gemm { m: total, n: width, k: n, a: x, b: g, ldb: width, ldc: width, init: Init::Accumulate, relu: false },
                d_weight,
            );
        }
        // The gradient of the scaled rows; another scaling makes it that of the rows.
        acts.d_scaled.resize(n * total, 0.0);
        let d = &mut acts.d_scaled[..];
        gemm(
            precision,
            Gemm {
                m: n,
                n: total,
                k: width,
                a: View::rows(g, width),
                b: &self.prepared.transposed[j],
                ldb: total,
                ldc: total,
                init: Init::Zero,
                relu: false,
            },
            d,
        );
        if let Some(d_code) = d_inputs[m].as_deref_mut() {
            let x = &mut acts.scaled[j][..n * total];
            join(mlp, layer, self.inputs, &acts.values, x);
            let is_first = !std::mem::replace(&mut acts.input_seeded[m], true);
            let rows =
                d_code.chunks_exact_mut(total + width).zip(x.chunks_exact(total)).zip(d.chunks_exact(total)).zip(g.chunks_exact(width));
            for (((code, x), d), g) in rows {
                if is_first {
                    code.fill(0.0);
                }
                let (scale, shift) = code.split_at_mut(total);
                scale.iter_mut().zip(x).zip(d).for_each(|((c, x), d)| *c += x * d);
                shift.iter_mut().zip(g).for_each(|(c, g)| *c += g);
            }
        }
        scale_rows(d, total, self.inputs[m], total + width);
        let mut first = 0;
        for s in &layer.inputs {
            let k = mlp.source_width(*s);
            let (target, seeded) = match *s {
                Source::Input(i) => (d_inputs[i].as_deref_mut(), &mut acts.input_seeded[i]),
                Source::Layer(i) => (acts.wanted[i].then_some(&mut before[i][..]), &mut acts.seeded[i]),
            };
            if let Some(target) = target {
                let is_first = !std::mem::replace(seeded, true);
                for (t, d) in target.chunks_exact_mut(k).zip(d.chunks_exact(total)) {
                    let d = &d[first..first + k];
                    if is_first { t.copy_from_slice(d) } else { t.iter_mut().zip(d).for_each(|(t, d)| *t += d) }
                }
            }
            first += k;
        }
    }
}

fn block<'a>(mlp: &Mlp, inputs: &[&'a [f32]], first: usize, n: usize) -> Vec<&'a [f32]> {
    inputs.iter().zip(&mlp.input_widths).map(|(x, k)| &x[first * k..(first + n) * k]).collect()
}

/// The last layer's output for all rows.
///
/// # Shapes
/// inputs `[n, K_i]`, out `[n, width]`.
pub fn forward(mlp: &Mlp, params: &[f32], inputs: &[&[f32]], n: usize, out: &mut [f32]) {
    let width = mlp.layers.last().map_or(0, |l| l.width);
    assert!(out.len() == n * width && params.len() == mlp.params_len(), "fused mlp: shapes");
    if out.is_empty() {
        return;
    }
    out.par_chunks_mut(BLOCK * width).enumerate().for_each_init(Activations::default, |acts, (b, out)| {
        let rows = out.len() / width;
        forward_block(mlp, params, &block(mlp, inputs, b * BLOCK, rows), rows, acts);
        out.copy_from_slice(&acts.values[mlp.layers.len() - 1][..rows * width]);
    });
}

/// Gradients of parameters and inputs, overwritten, for a gradient `[n, width]` of the last layer.
pub fn backward(mlp: &Mlp, params: &[f32], inputs: &[&[f32]], n: usize, d_out: &[f32], d_params: &mut [f32], d_inputs: &mut [Vec<f32>]) {
    let width = mlp.layers.last().map_or(0, |l| l.width);
    assert!(d_out.len() == n * width && params.len() == mlp.params_len(), "fused mlp: shapes");
    d_params.fill(0.0);
    if n == 0 {
        return;
    }
    let mut prepared = Prepared::default();
    prepared.update(mlp, params);
    let rows_per_group = n.div_ceil(GROUPS).next_multiple_of(BLOCK);
    let mut groups: Vec<Vec<&mut [f32]>> = (0..n.div_ceil(rows_per_group)).map(|_| Vec::new()).collect();
    for (d, k) in d_inputs.iter_mut().zip(&mlp.input_widths) {
        for (g, chunk) in groups.iter_mut().zip(d.chunks_mut(rows_per_group * k)) {
            g.push(chunk);
        }
    }
    let partial: Vec<Vec<f32>> = groups
        .into_par_iter()
        .enumerate()
        .map(|(g, mut d_inputs)| {
            let mut d_params = vec![0.0; mlp.params_len()];
            let mut acts = Activations::default();
            let first = g * rows_per_group;
            let last = (first + rows_per_group).min(n);
            for start in (first..last).step_by(BLOCK) {
                let rows = BLOCK.min(last - start);
                let x = block(mlp, inputs, start, rows);
                forward_block(mlp, params, &x, rows, &mut acts);
                acts.seed(mlp.layers.len() - 1)[..rows * width].copy_from_slice(&d_out[start * width..(start + rows) * width]);
                let mut d: Vec<Option<&mut [f32]>> = d_inputs
                    .iter_mut()
                    .zip(&mlp.input_widths)
                    .map(|(d, k)| Some(&mut d[(start - first) * k..(start - first + rows) * k]))
                    .collect();
                backward_block(mlp, &prepared, &x, rows, &mut acts, &mut d_params, &mut d);
            }
            d_params
        })
        .collect();
    for p in &partial {
        d_params.iter_mut().zip(p).for_each(|(a, b)| *a += b);
    }
}
