//! Sums within rays in burn's graph.

#[cfg(feature = "gpu")]
use super::{DeviceKernels, DeviceOutputs, OnDevice};
use super::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
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
    fn name(&self) -> &'static str {
        "scan"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)?;
        expect_shape(self.name(), "values", shapes[0], &[self.0.last().map(|n| *n as usize)])
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let mut out = ValuesMut::zeros(x[0].shape());
        cpu::inclusive(&self.0, &x[0], &mut out);
        Forward::one(out.freeze(), Kept::default())
    }

    fn backward(&self, _: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        vec![d[0].as_ref().map(|d| {
            let mut dx = ValuesMut::zeros(d.shape());
            cpu::inclusive_backward(&self.0, d, &mut dx);
            dx.freeze()
        })]
    }

    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        Some(self)
    }
}

/// Inclusive sums within each ray, differentiable.
///
/// # Shapes
/// offsets: `[R + 1]`; values: `[S]`; result: `[S]`.
pub fn scan(offsets: &[u32], values: Tensor<1>) -> Result<Tensor<1>, OpError> {
    apply_one(ScanOp(offsets.into()), vec![values.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceKernels for ScanOp {
    fn forward_on(&self, gpu: &Gpu, i: &[OnDevice]) -> DeviceOutputs {
        let offsets = gpu.upload(&self.0);
        DeviceOutputs { outputs: vec![(kernels::inclusive(gpu, &offsets, &i[0].data), i[0].shape.clone())], kept: vec![offsets.cast()] }
    }

    fn backward_on(&self, gpu: &Gpu, _: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        vec![d[0].as_ref().map(|d| kernels::inclusive_backward(gpu, &kept[0].cast(), d))]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read_values;
    use burn::tensor::{Device, TensorData};
    use diorama_testkit::{assert_close, random};

    #[test]
    fn burn_sees_the_same_gradient() {
        let offsets = [0, 3, 8];
        let x = random(8, 1);
        let xt = Tensor::<1>::from_data(TensorData::new(x, [8]), &Device::flex().autodiff()).require_grad();
        let grads = scan(&offsets, xt.clone()).unwrap().sum().backward();
        assert_close("x", &read_values(xt.grad(&grads).unwrap()), &[3.0, 2.0, 1.0, 5.0, 4.0, 3.0, 2.0, 1.0], 1e-6);
    }
}
