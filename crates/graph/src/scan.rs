//! Sums within rays in burn's graph.

use crate::bridge::{In, Out, SliceOp, apply_one};
#[cfg(feature = "gpu")]
use crate::on_gpu::{Ahead, DeviceOp, OnDevice};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
use diorama_kernels::ops::scan::cpu;
#[cfg(feature = "gpu")]
use diorama_kernels::ops::scan::gpu as kernels;
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
    apply_one(ScanOp(offsets.into()), vec![values.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceOp for ScanOp {
    fn ahead(&self, gpu: &Gpu, i: &[OnDevice]) -> Ahead {
        let offsets = gpu.upload_u32(&self.0);
        Ahead { outputs: vec![(kernels::inclusive(gpu, &offsets, &i[0].data), i[0].shape.clone())], kept: vec![offsets] }
    }

    fn back(&self, gpu: &Gpu, _: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        vec![d[0].as_ref().map(|d| kernels::inclusive_backward(gpu, &kept[0], d))]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::values;
    use burn::tensor::{Device, TensorData};
    use diorama_testkit::{assert_close, random};

    #[test]
    fn burn_sees_the_same_gradient() {
        let offsets = [0, 3, 8];
        let x = random(8, 1);
        let xt = Tensor::<1>::from_data(TensorData::new(x, [8]), &Device::flex().autodiff()).require_grad();
        let grads = scan(&offsets, xt.clone()).sum().backward();
        assert_close("x", &values(xt.grad(&grads).unwrap()), &[3.0, 2.0, 1.0, 5.0, 4.0, 3.0, 2.0, 1.0], 1e-6);
    }
}
