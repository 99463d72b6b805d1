//! Real spherical harmonics of a unit direction, `degree²` values (degree 1 to 4), with the
//! Condon–Shortley phase, order `l² + l + m` (Sloan 2013).

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use crate::burn_op::{self, In, Out, SliceOp};
use burn::tensor::Tensor;

#[derive(Debug)]
struct ShOp(usize);

impl SliceOp for ShOp {
    fn forward(&self, i: &[In]) -> Vec<Out> {
        let n = i[0].shape[0];
        let mut out = vec![0.0; n * self.0 * self.0];
        cpu::forward(self.0, i[0].data, &mut out);
        vec![(out, vec![n, self.0 * self.0])]
    }
    fn backward(&self, i: &[In], d: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>> {
        vec![d[0].map(|d| {
            let mut g = vec![0.0; i[0].data.len()];
            cpu::backward(self.0, i[0].data, d, &mut g);
            g
        })]
    }
}

/// Encodes directions, differentiable in them.
///
/// # Shapes
/// directions: `[N, 3]`; result: `[N, degree²]`.
///
/// # Panics
/// When `degree` is not in 1..=4.
pub fn spherical_harmonics(degree: usize, directions: Tensor<2>) -> Tensor<2> {
    assert!((1..=4).contains(&degree), "spherical harmonics of degree {degree}: only 1 to 4");
    burn_op::apply_one(ShOp(degree), vec![directions.into_dispatch()])
}
