//! A small network of fully connected layers evaluated block by block, so that activations stay in
//! cache in both passes. Layers read any of the inputs and earlier layers, joined side
//! by side, which covers skip connections and split heads.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use super::linear::Activation;
use crate::gemm::Precision;
use diorama_geom::rng::Rng;

/// Source of a layer's inputs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Source {
    Input(usize),
    Layer(usize),
}

/// One layer: `y = act(concat(inputs) W + b)`.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    pub inputs: Vec<Source>,
    pub width: usize,
    pub activation: Activation,
    pub bias: bool,
    /// Network input `[α, β]` of width `K + N` that modulates the layer (Hao et al. 2021, GANcraft):
    /// `y = act((α ⊙ concat(inputs)) W + b + β)`.
    pub modulation: Option<usize>,
    /// A frozen layer's parameters get no gradient.
    pub frozen: bool,
}

impl Layer {
    /// A trained layer without modulation.
    pub fn new(inputs: Vec<Source>, width: usize, activation: Activation, bias: bool) -> Layer {
        Layer { inputs, width, activation, bias, modulation: None, frozen: false }
    }
}

/// An output of a network: `channels` that begin at `channel` of a layer, with an activation of their own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Head {
    pub layer: usize,
    pub channel: usize,
    pub activation: Activation,
    /// Added before the activation.
    pub shift: f32,
}

/// A network. Parameters of layer `j` lie at `offsets[j]`: the weight `[K, N]` row-major, then the bias `[N]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Mlp {
    pub input_widths: Vec<usize>,
    pub layers: Vec<Layer>,
    pub offsets: Vec<usize>,
    /// Arithmetic of the layers' products.
    pub precision: Precision,
}

impl Mlp {
    /// # Panics
    /// When a layer reads an input or layer that does not come before it, or a modulation of another width.
    pub fn new(input_widths: Vec<usize>, layers: Vec<Layer>) -> Mlp {
        let mut mlp = Mlp { input_widths, layers, offsets: vec![0], precision: Precision::F32 };
        for j in 0..mlp.layers.len() {
            for s in &mlp.layers[j].inputs {
                let ok = match *s {
                    Source::Input(i) => i < mlp.input_widths.len(),
                    Source::Layer(i) => i < j,
                };
                assert!(ok, "layer {j} reads {s:?}, which does not come before it");
            }
            let (k, n) = (mlp.fan_in(j), mlp.layers[j].width);
            if let Some(i) = mlp.layers[j].modulation {
                let width = mlp.input_widths.get(i).copied().unwrap_or(0);
                assert_eq!(width, k + n, "layer {j} of {k} x {n} is modulated by input {i}");
            }
            mlp.offsets.push(mlp.offsets[j] + k * n + mlp.bias_len(j));
        }
        mlp
    }

    /// A chain of ReLU layers with a linear last layer, such as instant-ngp's small networks (which have no biases).
    pub fn chain(input_widths: Vec<usize>, widths: &[usize], bias: bool) -> Mlp {
        let layers = widths
            .iter()
            .enumerate()
            .map(|(j, &width)| {
                let inputs = if j == 0 { (0..input_widths.len()).map(Source::Input).collect() } else { vec![Source::Layer(j - 1)] };
                let activation = if j + 1 < widths.len() { Activation::Relu } else { Activation::None };
                Layer::new(inputs, width, activation, bias)
            })
            .collect();
        Mlp::new(input_widths, layers)
    }

    pub fn source_width(&self, s: Source) -> usize {
        match s {
            Source::Input(i) => self.input_widths[i],
            Source::Layer(j) => self.layers[j].width,
        }
    }

    /// Rows of layer `j`'s weight.
    pub fn fan_in(&self, j: usize) -> usize {
        self.layers[j].inputs.iter().map(|s| self.source_width(*s)).sum()
    }

    fn bias_len(&self, j: usize) -> usize {
        if self.layers[j].bias { self.layers[j].width } else { 0 }
    }

    /// Numbers in all weights and biases.
    pub fn params_len(&self) -> usize {
        self.offsets[self.layers.len()]
    }

    /// Ranges of parameters that are trained, in order; neighbors are joined.
    pub fn trained(&self) -> Vec<std::ops::Range<usize>> {
        let mut out: Vec<std::ops::Range<usize>> = Vec::new();
        for (_, at) in self.layers.iter().zip(self.offsets.windows(2)).filter(|(l, _)| !l.frozen) {
            match out.last_mut() {
                Some(last) if last.end == at[0] => last.end = at[1],
                _ => out.push(at[0]..at[1]),
            }
        }
        out
    }

    /// Multiply-adds per row, forward.
    pub fn macs(&self) -> usize {
        (0..self.layers.len()).map(|j| self.fan_in(j) * self.layers[j].width).sum()
    }

    /// Weights uniform in `±√(6 / fan_in)` before a rectifier (He et al. 2015), `±√(3 / fan_in)` else; biases 0.
    pub fn init(&self, rng: &Rng) -> Vec<f32> {
        let mut params = vec![0.0; self.params_len()];
        for (j, layer) in self.layers.iter().enumerate() {
            let k = self.fan_in(j);
            let rectifies = matches!(layer.activation, Activation::Relu | Activation::LeakyRelu | Activation::Silu);
            let bound = ((if rectifies { 6.0 } else { 3.0 }) / k as f32).sqrt();
            for i in self.offsets[j]..self.offsets[j] + k * layer.width {
                params[i] = (rng.uniform(i as u64) * 2.0 - 1.0) * bound;
            }
        }
        params
    }
}
