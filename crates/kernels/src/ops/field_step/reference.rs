//! The composition of the references of the network, its heads and compositing, in f64.

use super::FieldNet;
use crate::ops::composite::{self, Composited, Packed};
use crate::ops::fused_mlp::{Head, reference as mlp};
use crate::ops::linear::reference::{activate, slope};

/// Factor `min(m / reach, 1)²` of the gradient of sample `i` with middle `m`, where gradients closer to the camera than `reach` are scaled;
/// a `reach` of 0 scales none.
pub fn near_share(p: &Packed, i: usize, reach: f32) -> f64 {
    let middle = p.t[i] as f64 + 0.5 * p.dt[i] as f64;
    if reach > 0.0 { (middle / reach as f64).min(1.0).powi(2) } else { 1.0 }
}

/// Per-ray results and the gradients of a linear loss.
pub struct Step {
    pub out: Composited<f64>,
    /// `[S]`
    pub sigma: Vec<f64>,
    pub d_params: Vec<f64>,
    /// Per network input, `[S, K]`.
    pub d_inputs: Vec<Vec<f64>>,
    pub d_background: Vec<f64>,
    /// `[S, K]`
    pub d_extras: Vec<f64>,
}

fn head(net: &FieldNet, h: Head, channels: usize, values: &[Vec<f64>], s: usize, f: impl Fn(f64) -> f64) -> Vec<f64> {
    let width = net.mlp.layers[h.layer].width;
    (0..s * channels).map(|e| f(values[h.layer][e / channels * width + h.channel + e % channels] + h.shift as f64)).collect()
}

/// Softmax of rows.
fn shares(mut logits: Vec<f64>, channels: usize) -> Vec<f64> {
    for row in logits.chunks_exact_mut(channels) {
        let most = row.iter().copied().fold(f64::MIN, f64::max);
        let sum: f64 = row.iter().map(|v| (v - most).exp()).sum();
        row.iter_mut().for_each(|v| *v = (*v - most).exp() / sum);
    }
    logits
}

/// [`step_with_extras`] without any.
pub fn step(net: &FieldNet, params: &[f64], p: &Packed, inputs: &[&[f64]], background: &[f64], d: &Composited<f64>) -> Step {
    step_with_extras(net, params, p, inputs, &[], background, d)
}

/// Forward, then backward for the loss `Σ d · out` over outputs, extras `[S, K]`, depth, opacity and weights.
pub fn step_with_extras(
    net: &FieldNet,
    params: &[f64],
    p: &Packed,
    inputs: &[&[f64]],
    extras: &[f64],
    background: &[f64],
    d: &Composited<f64>,
) -> Step {
    let s = p.samples();
    let k = (background.len() / p.rays().max(1)).saturating_sub(net.channels());
    let values = mlp::forward(&net.mlp, params, inputs, s);
    let sigma = head(net, net.density, 1, &values, s, |x| activate(net.density.activation, x));
    let c = net.channels() + k;
    let (mut outputs, mut first) = (vec![0.0; s * c], 0);
    for o in &net.outputs {
        let own = head(net, o.head, o.channels, &values, s, |x| activate(o.head.activation, x));
        let own = if o.are_shares { shares(own, o.channels) } else { own };
        for (e, v) in own.into_iter().enumerate() {
            outputs[e / o.channels * c + first + e % o.channels] = v;
        }
        first += o.channels;
    }
    for (e, v) in extras.iter().enumerate() {
        outputs[e / k * c + first + e % k] = *v;
    }
    let out = composite::reference::forward(p, &sigma, &outputs, c, background);
    let (ds, dc, d_background) = composite::reference::backward(p, &sigma, &outputs, c, background, d);
    let mut seeds: Vec<Vec<f64>> = net.mlp.layers.iter().map(|l| vec![0.0; s * l.width]).collect();
    let mut first = 0;
    for (i, (h, channels)) in net.heads().enumerate() {
        let slopes = head(net, h, channels, &values, s, |x| slope(h.activation, x));
        let width = net.mlp.layers[h.layer].width;
        for e in 0..s * channels {
            let d = |k: usize| if i == 0 { ds[e] } else { dc[e / channels * c + first + k] };
            let mut g = d(e % channels);
            if i > 0 && net.outputs[i - 1].are_shares {
                let y = |k: usize| outputs[e / channels * c + first + k];
                g = y(e % channels) * (g - (0..channels).map(|k| y(k) * d(k)).sum::<f64>());
            }
            seeds[h.layer][e / channels * width + h.channel + e % channels] += g * slopes[e];
        }
        first += if i == 0 { 0 } else { channels };
    }
    let (d_params, d_inputs) = mlp::backward(&net.mlp, params, inputs, s, &seeds);
    let d_extras = (0..s * k).map(|e| dc[e / k * c + c - k + e % k]).collect();
    Step { out, sigma, d_params, d_inputs, d_background, d_extras }
}
