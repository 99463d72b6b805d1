//! Layer after layer through the `linear` reference, in f64.

use super::{Layer, Mlp, Source};
use crate::ops::linear::{Activation, BiasKind, reference as linear};

fn joined(mlp: &Mlp, layer: &Layer, inputs: &[&[f64]], values: &[Vec<f64>], n: usize) -> Vec<f64> {
    let mut out = Vec::new();
    for i in 0..n {
        for s in &layer.inputs {
            let w = mlp.source_width(*s);
            let row = match *s {
                Source::Input(k) => &inputs[k][i * w..(i + 1) * w],
                Source::Layer(k) => &values[k][i * w..(i + 1) * w],
            };
            out.extend_from_slice(row);
        }
    }
    out
}

fn parts<'a>(mlp: &Mlp, j: usize, params: &'a [f64]) -> (&'a [f64], &'a [f64], BiasKind, Activation) {
    let layer = &mlp.layers[j];
    let weights = mlp.offsets[j] + mlp.fan_in(j) * layer.width;
    let kind = if layer.bias { BiasKind::Shared } else { BiasKind::None };
    let act = if layer.relu { Activation::Relu } else { Activation::None };
    (&params[mlp.offsets[j]..weights], &params[weights..mlp.offsets[j + 1]], kind, act)
}

/// The outputs `[N, width]` of every layer.
pub fn forward(mlp: &Mlp, params: &[f64], inputs: &[&[f64]], n: usize) -> Vec<Vec<f64>> {
    let mut values: Vec<Vec<f64>> = Vec::new();
    for (j, layer) in mlp.layers.iter().enumerate() {
        let x = joined(mlp, layer, inputs, &values, n);
        let (w, b, kind, act) = parts(mlp, j, params);
        values.push(linear::forward(n, mlp.fan_in(j), layer.width, &x, w, b, kind, act));
    }
    values
}

/// Gradients of the parameters and of each input, given those of every layer's output.
pub fn backward(mlp: &Mlp, params: &[f64], inputs: &[&[f64]], n: usize, d_layers: &[Vec<f64>]) -> (Vec<f64>, Vec<Vec<f64>>) {
    let values = forward(mlp, params, inputs, n);
    let mut d = d_layers.to_vec();
    let mut d_inputs: Vec<Vec<f64>> = inputs.iter().map(|i| vec![0.0; i.len()]).collect();
    let mut d_params = vec![0.0; params.len()];
    for (j, layer) in mlp.layers.iter().enumerate().rev() {
        let x = joined(mlp, layer, inputs, &values, n);
        let (w, b, kind, act) = parts(mlp, j, params);
        let k = mlp.fan_in(j);
        let (dx, dw, db) = linear::backward(n, k, layer.width, &x, w, b, kind, act, &d[j]);
        for (g, v) in d_params[mlp.offsets[j]..].iter_mut().zip(dw.iter().chain(&db)) {
            *g += v;
        }
        for i in 0..n {
            let mut at = i * k;
            for s in &layer.inputs {
                let w = mlp.source_width(*s);
                let target = match *s {
                    Source::Input(q) => &mut d_inputs[q],
                    Source::Layer(q) => &mut d[q],
                };
                for c in 0..w {
                    target[i * w + c] += dx[at + c];
                }
                at += w;
            }
        }
    }
    (d_params, d_inputs)
}
