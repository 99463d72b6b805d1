//! Structural similarity (Wang et al. 2004): Gaussian window 11×11 with σ = 1.5, `C₁ = 0.01²`,
//! `C₂ = 0.03²`, windows inside the image only, mean over positions and channels.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use crate::burn_op::{self, In, Out, SliceOp};
use burn::tensor::Tensor;

pub const WINDOW: usize = 11;
pub const SIGMA: f64 = 1.5;
pub const C1: f64 = 0.01 * 0.01;
pub const C2: f64 = 0.03 * 0.03;

/// The window's one-dimensional weights, which sum to 1.
pub fn gaussian() -> [f64; WINDOW] {
    let g: [f64; WINDOW] = std::array::from_fn(|i| (-((i as f64 - 5.0).powi(2)) / (2.0 * SIGMA * SIGMA)).exp());
    let sum: f64 = g.iter().sum();
    g.map(|v| v / sum)
}

#[derive(Debug)]
struct SsimOp;

impl SliceOp for SsimOp {
    fn forward(&self, i: &[In]) -> Vec<Out> {
        let [h, w, c] = [i[0].shape[0], i[0].shape[1], i[0].shape[2]];
        vec![(vec![cpu::ssim(w, h, c, i[0].data, i[1].data) as f32], vec![1])]
    }
    fn backward(&self, i: &[In], d: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>> {
        let [h, w, c] = [i[0].shape[0], i[0].shape[1], i[0].shape[2]];
        let Some(d) = d[0] else { return vec![None, None] };
        let mut g = cpu::gradient(w, h, c, i[0].data, i[1].data);
        g.iter_mut().for_each(|g| *g *= d[0]);
        vec![Some(g), None]
    }
}

/// SSIM of two images, differentiable in the first.
///
/// # Shapes
/// x, y: `[H, W, C]` in [0, 1], at least 11×11; result: `[1]`.
pub fn ssim(x: Tensor<3>, y: Tensor<3>) -> Tensor<1> {
    burn_op::apply_one(SsimOp, vec![x.into_dispatch(), y.into_dispatch()])
}
