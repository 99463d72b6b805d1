//! Packed prefix sums: exclusive sums of counts, and sums of values within each ray.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use crate::burn_op::{self, In, Out, SliceOp};
use burn::tensor::Tensor;
use std::sync::Arc;

#[derive(Debug)]
struct ScanOp(Arc<[u32]>);

impl SliceOp for ScanOp {
    fn forward(&self, i: &[In]) -> Vec<Out> {
        let mut out = vec![0.0; i[0].data.len()];
        cpu::inclusive(&self.0, i[0].data, &mut out);
        vec![(out, i[0].shape.to_vec())]
    }
    fn backward(&self, _: &[In], d: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>> {
        vec![d[0].map(|d| {
            let mut g = vec![0.0; d.len()];
            cpu::inclusive_backward(&self.0, d, &mut g);
            g
        })]
    }
}

/// Inclusive sums within each ray, differentiable.
///
/// # Shapes
/// offsets: `[R + 1]`; values: `[S]`; result: `[S]`.
pub fn scan(offsets: &[u32], values: Tensor<1>) -> Tensor<1> {
    burn_op::apply_one(ScanOp(offsets.into()), vec![values.into_dispatch()])
}
