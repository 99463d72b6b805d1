//! A small network of fully connected layers evaluated block by block, so that activations stay in
//! cache on the way forward and back. Layers read any of the inputs and earlier layers, joined side
//! by side, which covers skip connections and split heads.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use crate::gemm::Precision;
use diorama_geom::rng::Rng;

/// What a layer reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Source {
    Input(usize),
    Layer(usize),
}

/// One layer: `y = relu?(concat(inputs) W + b?)`.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    pub inputs: Vec<Source>,
    pub width: usize,
    pub relu: bool,
    pub bias: bool,
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
    /// When a layer reads an input or layer that does not come before it.
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
            let size = mlp.fan_in(j) * mlp.layers[j].width + mlp.bias_len(j);
            mlp.offsets.push(mlp.offsets[j] + size);
        }
        mlp
    }

    /// A chain of ReLU layers with a linear last layer, without biases (instant-ngp's small networks).
    pub fn chain(input_widths: Vec<usize>, widths: &[usize], bias: bool) -> Mlp {
        let layers = widths
            .iter()
            .enumerate()
            .map(|(j, &width)| Layer {
                inputs: if j == 0 { (0..input_widths.len()).map(Source::Input).collect() } else { vec![Source::Layer(j - 1)] },
                width,
                relu: j + 1 < widths.len(),
                bias,
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

    /// Multiply-adds per row, forward.
    pub fn macs(&self) -> usize {
        (0..self.layers.len()).map(|j| self.fan_in(j) * self.layers[j].width).sum()
    }

    /// Weights uniform in `±√(6 / fan_in)` (He et al. 2015) before a ReLU, `±√(3 / fan_in)` else; biases 0.
    pub fn init(&self, rng: &Rng) -> Vec<f32> {
        let mut params = vec![0.0; self.params_len()];
        for (j, layer) in self.layers.iter().enumerate() {
            let k = self.fan_in(j);
            let bound = ((if layer.relu { 6.0 } else { 3.0 }) / k as f32).sqrt();
            for i in self.offsets[j]..self.offsets[j] + k * layer.width {
                params[i] = (rng.uniform(i as u64) * 2.0 - 1.0) * bound;
            }
        }
        params
    }
}
