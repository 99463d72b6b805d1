//! Plain loops in f64: reverse mode for the gradient, forward mode along a direction for its backward pass.

use crate::ops::field_step::FieldNet;
use crate::ops::fused_mlp::{Source, reference as mlp};
use crate::ops::linear::reference::{activate, second_slope, slope};

/// The density before its activation as a linear function of the features.
struct Linearized {
    /// Outputs of every layer, `[N, width]`.
    values: Vec<Vec<f64>>,
    /// Its gradient before each layer's activation, `[N, width]`.
    u: Vec<Vec<f64>>,
    /// Its gradient with respect to the features, `[N, K]`.
    g: Vec<f64>,
    /// With the head's shift, `[N]`.
    raw: Vec<f64>,
}

/// Calls `f(row, sample's place in the source, source)` for all inputs of a layer.
fn each_input(net: &FieldNet, j: usize, mut f: impl FnMut(usize, usize, Source)) {
    let mut row = 0;
    for s in &net.mlp.layers[j].inputs {
        for k in 0..net.mlp.source_width(*s) {
            f(row + k, k, *s);
        }
        row += net.mlp.source_width(*s);
    }
}

fn linearize(net: &FieldNet, params: &[f64], features: &[f64]) -> Linearized {
    let (all, last) = (&net.mlp, net.density.layer);
    let n = features.len() / all.input_widths[0];
    let codes: Vec<Vec<f64>> = all.input_widths[1..].iter().map(|w| vec![0.0; n * w]).collect();
    let inputs: Vec<&[f64]> = [features].into_iter().chain(codes.iter().map(|c| &c[..])).collect();
    let values = mlp::forward(all, params, &inputs, n);
    let mut u: Vec<Vec<f64>> = values[..=last].iter().map(|v| vec![0.0; v.len()]).collect();
    let mut g = vec![0.0; features.len()];
    let at = |i: usize| i * all.layers[last].width + net.density.channel;
    for i in 0..n {
        u[last][at(i)] = 1.0;
        for j in (0..=last).rev() {
            let width = all.layers[j].width;
            for c in 0..width {
                // Of piecewise linear activations, the output has the sign of the input.
                u[j][i * width + c] *= slope(all.layers[j].activation, values[j][i * width + c]);
                let own = u[j][i * width + c];
                each_input(net, j, |row, k, s| {
                    let by = params[all.offsets[j] + row * width + c] * own;
                    match s {
                        Source::Input(0) => g[i * all.input_widths[0] + k] += by,
                        Source::Input(_) => {}
                        Source::Layer(q) => u[q][i * all.layers[q].width + k] += by,
                    }
                });
            }
        }
    }
    let raw = (0..n).map(|i| values[last][at(i)] + net.density.shift as f64).collect();
    Linearized { values, u, g, raw }
}

/// `Jᵀ g` per sample.
fn transposed(jacobian: &[f64], g: &[f64], n: usize) -> Vec<f64> {
    let k = g.len().checked_div(n).unwrap_or(0);
    (0..n * 3).map(|e| (0..k).map(|f| jacobian[(e / 3 * k + f) * 3 + e % 3] * g[e / 3 * k + f]).sum()).collect()
}

/// Densities `[N]` and their gradients `[N, 3]` from features `[N, K]` with derivatives `[N, K, 3]`.
pub fn forward(net: &FieldNet, params: &[f64], features: &[f64], jacobian: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let l = linearize(net, params, features);
    let a = net.density.activation;
    let n = transposed(jacobian, &l.g, l.raw.len());
    (l.raw.iter().map(|r| activate(a, *r)).collect(), n.iter().enumerate().map(|(e, n)| slope(a, l.raw[e / 3]) * n).collect())
}

/// Gradients of parameters (0 of frozen layers), features `[N, K]` and their derivatives `[N, K, 3]`, given those of [`forward`]'s results.
pub fn backward(
    net: &FieldNet,
    params: &[f64],
    features: &[f64],
    jacobian: &[f64],
    d_sigma: &[f64],
    d_gradient: &[f64],
) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let l = linearize(net, params, features);
    let (all, a, n, k) = (&net.mlp, net.density.activation, l.raw.len(), net.mlp.input_widths[0]);
    let along = transposed(jacobian, &l.g, n);
    let mut d_params = vec![0.0; params.len()];
    let (mut d_features, mut d_jacobian) = (vec![0.0; features.len()], vec![0.0; jacobian.len()]);
    for i in 0..n {
        let by: f64 = (0..3).map(|c| d_gradient[i * 3 + c] * along[i * 3 + c]).sum();
        let d_raw = d_sigma[i] * slope(a, l.raw[i]) + second_slope(a, l.raw[i]) * by;
        let v: [f64; 3] = std::array::from_fn(|c| slope(a, l.raw[i]) * d_gradient[i * 3 + c]);
        let tangent_of = |f: usize| -> f64 { (0..3).map(|c| jacobian[(i * k + f) * 3 + c] * v[c]).sum() };
        let mut tangents: Vec<Vec<f64>> = Vec::new();
        for (j, layer) in all.layers[..=net.density.layer].iter().enumerate() {
            let mut t = vec![0.0; layer.width];
            for c in 0..layer.width {
                let u = l.u[j][i * layer.width + c];
                each_input(net, j, |row, p, s| {
                    let (x, dx) = match s {
                        Source::Input(0) => (features[i * k + p], tangent_of(p)),
                        Source::Input(_) => (0.0, 0.0),
                        Source::Layer(q) => (l.values[q][i * all.layers[q].width + p], tangents[q][p]),
                    };
                    let at = all.offsets[j] + row * layer.width + c;
                    t[c] += params[at] * dx;
                    d_params[at] += if layer.frozen { 0.0 } else { (d_raw * x + dx) * u };
                });
                t[c] *= slope(layer.activation, l.values[j][i * layer.width + c]);
                if layer.bias && !layer.frozen {
                    d_params[all.offsets[j] + all.fan_in(j) * layer.width + c] += d_raw * u;
                }
            }
            tangents.push(t);
        }
        for f in 0..k {
            let g = l.g[i * k + f];
            d_features[i * k + f] = d_raw * g;
            (0..3).for_each(|c| d_jacobian[(i * k + f) * 3 + c] = g * v[c]);
        }
    }
    (d_params, d_features, d_jacobian)
}
