//! One block of rows at a time; [`forward_block`] and [`backward_block`] are what fused ops call.

use super::{Mlp, Source};
use crate::gemm::{self, Init, View, gemm};
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
    /// Brings the transposes up to date with `params`.
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
    seeded: Vec<bool>,
}

impl Activations {
    fn fit(&mut self, mlp: &Mlp, n: usize) {
        self.values.resize_with(mlp.layers.len(), Vec::new);
        self.grads.resize_with(mlp.layers.len(), Vec::new);
        self.seeded.clear();
        self.seeded.resize(mlp.layers.len(), false);
        for (j, layer) in mlp.layers.iter().enumerate() {
            let len = n * layer.width;
            if self.values[j].len() < len {
                self.values[j].resize(len, 0.0);
                self.grads[j].resize(len, 0.0);
            }
        }
    }

    /// The gradient buffer `[n, width]` of a layer's output, to be filled before [`backward_block`].
    pub fn seed(&mut self, layer: usize) -> &mut [f32] {
        self.seeded[layer] = true;
        &mut self.grads[layer]
    }
}

/// Fills `acts.values` with every layer's output for `n` rows.
///
/// # Shapes
/// inputs: `[n, K_i]` each.
pub fn forward_block(mlp: &Mlp, params: &[f32], inputs: &[&[f32]], n: usize, acts: &mut Activations) {
    acts.fit(mlp, n);
    for (j, layer) in mlp.layers.iter().enumerate() {
        let width = layer.width;
        let (before, rest) = acts.values.split_at_mut(j);
        let out = &mut rest[0][..n * width];
        let mut at = mlp.offsets[j];
        let bias = at + mlp.fan_in(j) * width;
        for (q, s) in layer.inputs.iter().enumerate() {
            let k = mlp.source_width(*s);
            let x = match *s {
                Source::Input(i) => inputs[i],
                Source::Layer(i) => &before[i],
            };
            let init = match (q, layer.bias) {
                (0, true) => Init::Bias(&params[bias..bias + width]),
                (0, false) => Init::Zero,
                _ => Init::Accumulate,
            };
            let last = q + 1 == layer.inputs.len();
            gemm(mlp.precision, n, width, k, View::rows(x, k), &params[at..], width, out, width, init, layer.relu && last);
            at += k * width;
        }
    }
}

/// Adds parameter gradients to `d_params` and overwrites those inputs' gradients that are asked for.
/// Gradients of layer outputs enter through [`Activations::seed`].
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
    let mut input_seeded = [false; 8];
    for (j, layer) in mlp.layers.iter().enumerate().rev() {
        if !acts.seeded[j] {
            continue;
        }
        let width = layer.width;
        let (before, rest) = acts.grads.split_at_mut(j);
        let g = &mut rest[0][..n * width];
        if layer.relu {
            for (g, v) in g.iter_mut().zip(&acts.values[j]) {
                *g = if *v > 0.0 { *g } else { 0.0 };
            }
        }
        let total = mlp.fan_in(j);
        let wt = &prepared.transposed[j];
        let (mut at, mut first) = (mlp.offsets[j], 0);
        for s in &layer.inputs {
            let k = mlp.source_width(*s);
            let x: &[f32] = match *s {
                Source::Input(i) => inputs[i],
                Source::Layer(i) => &acts.values[i],
            };
            gemm(
                mlp.precision,
                k,
                width,
                n,
                View::transposed(x, k),
                g,
                width,
                &mut d_params[at..at + k * width],
                width,
                Init::Accumulate,
                false,
            );
            let (target, seeded) = match *s {
                Source::Input(i) => (d_inputs[i].as_deref_mut(), &mut input_seeded[i]),
                Source::Layer(i) => (Some(&mut before[i][..]), &mut acts.seeded[i]),
            };
            if let Some(target) = target {
                let init = if *seeded { Init::Accumulate } else { Init::Zero };
                gemm(mlp.precision, n, k, width, View::rows(g, width), &wt[first..], total, target, k, init, false);
                *seeded = true;
            }
            at += k * width;
            first += k;
        }
        if layer.bias {
            let d_bias = &mut d_params[at..at + width];
            for row in g.chunks_exact(width) {
                d_bias.iter_mut().zip(row).for_each(|(b, g)| *b += g);
            }
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
