//! Triangle-wave encoding (tiny-cuda-nn): a continuous, piecewise linear wave in place of sines,
//! `y_k = 2 |((2ᵏ x + ½) mod 2) − 1| − 1` for band `k` with the mathematical (non-negative) modulus.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use crate::burn_op::{self, In, Out, SliceOp};
use burn::tensor::Tensor;

#[derive(Debug)]
struct WaveOp(usize);

impl SliceOp for WaveOp {
    fn forward(&self, i: &[In]) -> Vec<Out> {
        let [n, dims] = [i[0].shape[0], i[0].shape[1]];
        let mut out = vec![0.0; n * dims * self.0];
        cpu::forward(dims, self.0, i[0].data, &mut out);
        vec![(out, vec![n, dims * self.0])]
    }
    fn backward(&self, i: &[In], d: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>> {
        vec![d[0].map(|d| {
            let mut g = vec![0.0; i[0].data.len()];
            cpu::backward(i[0].shape[1], self.0, i[0].data, d, &mut g);
            g
        })]
    }
}

/// Encodes rows, differentiable in `x`.
///
/// # Shapes
/// x: `[N, dims]`; result: `[N, dims · bands]`, all bands of a coordinate together.
pub fn triangle_wave(bands: usize, x: Tensor<2>) -> Tensor<2> {
    burn_op::apply_one(WaveOp(bands), vec![x.into_dispatch()])
}
