//! Layer after layer through the `linear` reference, in f64.

use super::{Layer, Mlp, Source};
use crate::ops::linear::{BiasKind, Dense, reference as linear};

/// Concatenated inputs of a layer, `[N, K]`, scaled where it is modulated.
fn joined(mlp: &Mlp, layer: &Layer, inputs: &[&[f64]], values: &[Vec<f64>], n: usize) -> Vec<f64> {
    let mut out = Vec::new();
    for i in 0..n {
        let mut row = Vec::new();
        for s in &layer.inputs {
            let w = mlp.source_width(*s);
            row.extend_from_slice(match *s {
                Source::Input(k) => &inputs[k][i * w..(i + 1) * w],
                Source::Layer(k) => &values[k][i * w..(i + 1) * w],
            });
        }
        if let Some(m) = layer.modulation {
            let code = &inputs[m][i * mlp.input_widths[m]..];
            row.iter_mut().zip(code).for_each(|(x, a)| *x *= a);
        }
        out.extend(row);
    }
    out
}

fn weight<'a>(mlp: &Mlp, j: usize, params: &'a [f64]) -> &'a [f64] {
    &params[mlp.offsets[j]..mlp.offsets[j] + mlp.fan_in(j) * mlp.layers[j].width]
}

/// Layer `j` with its bias spread over the rows.
fn dense(mlp: &Mlp, j: usize) -> Dense {
    Dense { k: mlp.fan_in(j), n: mlp.layers[j].width, bias: BiasKind::PerRow, activation: mlp.layers[j].activation }
}

/// The bias of each row, `[N, width]`: the layer's own and that of its modulation.
fn row_bias(mlp: &Mlp, j: usize, params: &[f64], inputs: &[&[f64]], n: usize) -> Vec<f64> {
    let (layer, k) = (&mlp.layers[j], mlp.fan_in(j));
    let own = &params[mlp.offsets[j] + k * layer.width..mlp.offsets[j + 1]];
    let mut out = Vec::new();
    for i in 0..n {
        for c in 0..layer.width {
            let shift = layer.modulation.map_or(0.0, |m| inputs[m][i * mlp.input_widths[m] + k + c]);
            out.push(own.get(c).copied().unwrap_or(0.0) + shift);
        }
    }
    out
}

/// The outputs `[N, width]` of every layer.
pub fn forward(mlp: &Mlp, params: &[f64], inputs: &[&[f64]], n: usize) -> Vec<Vec<f64>> {
    let mut values: Vec<Vec<f64>> = Vec::new();
    for (j, layer) in mlp.layers.iter().enumerate() {
        let x = joined(mlp, layer, inputs, &values, n);
        let (w, b) = (weight(mlp, j, params), row_bias(mlp, j, params, inputs, n));
        values.push(linear::forward(n, &dense(mlp, j), &x, w, &b));
    }
    values
}

/// Gradients of the parameters (0 of frozen layers) and of each input, given those of every layer's output.
pub fn backward(mlp: &Mlp, params: &[f64], inputs: &[&[f64]], n: usize, d_layers: &[Vec<f64>]) -> (Vec<f64>, Vec<Vec<f64>>) {
    let values = forward(mlp, params, inputs, n);
    let mut d = d_layers.to_vec();
    let mut d_inputs: Vec<Vec<f64>> = inputs.iter().map(|i| vec![0.0; i.len()]).collect();
    let mut d_params = vec![0.0; params.len()];
    for (j, layer) in mlp.layers.iter().enumerate().rev() {
        let x = joined(mlp, layer, inputs, &values, n);
        let plain = joined(mlp, &Layer { modulation: None, ..layer.clone() }, inputs, &values, n);
        let (w, b) = (weight(mlp, j, params), row_bias(mlp, j, params, inputs, n));
        let (k, width) = (mlp.fan_in(j), layer.width);
        let (mut dx, dw, db) = linear::backward(n, &dense(mlp, j), &x, w, &b, &d[j]);
        if !layer.frozen {
            d_params[mlp.offsets[j]..][..k * width].copy_from_slice(&dw);
            for (e, g) in db.iter().enumerate().filter(|_| layer.bias) {
                d_params[mlp.offsets[j] + k * width + e % width] += g;
            }
        }
        if let Some(m) = layer.modulation {
            for i in 0..n {
                let code = i * mlp.input_widths[m];
                for p in 0..k {
                    d_inputs[m][code + p] += dx[i * k + p] * plain[i * k + p];
                    dx[i * k + p] *= inputs[m][code + p];
                }
                for c in 0..width {
                    d_inputs[m][code + k + c] += db[i * width + c];
                }
            }
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
