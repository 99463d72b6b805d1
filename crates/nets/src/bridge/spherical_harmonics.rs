//! Spherical harmonics of directions in burn's graph.

#[cfg(feature = "gpu")]
use super::{DeviceKernels, DeviceOutputs, OnDevice};
use super::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
use diorama_kernels::ops::spherical_harmonics::cpu;
#[cfg(feature = "gpu")]
use diorama_kernels::ops::spherical_harmonics::gpu as kernels;

#[derive(Debug)]
struct ShOp(usize);

impl SliceOp for ShOp {
    fn name(&self) -> &'static str {
        "spherical harmonics"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)?;
        if !(1..=4).contains(&self.0) {
            return Err(OpError::settings(self.name(), format!("degree {}, expected 1 to 4", self.0)));
        }
        expect_shape(self.name(), "directions", shapes[0], &[None, Some(3)])
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let mut out = ValuesMut::any(&[x[0].shape()[0], self.0 * self.0]);
        cpu::forward(self.0, &x[0], &mut out);
        Forward::one(out.freeze(), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let x = &kept.values[0];
        vec![d[0].as_ref().map(|d| {
            let mut dx = ValuesMut::zeros(x.shape());
            cpu::backward(self.0, x, d, &mut dx);
            dx.freeze()
        })]
    }

    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        Some(self)
    }
}

/// Encodes directions, differentiable in them.
///
/// # Shapes
/// directions: `[N, 3]`; result: `[N, degree²]`, `degree` from 1 to 4.
pub fn spherical_harmonics(degree: usize, directions: Tensor<2>) -> Result<Tensor<2>, OpError> {
    apply_one(ShOp(degree), vec![directions.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceKernels for ShOp {
    fn forward_on(&self, gpu: &Gpu, i: &[OnDevice]) -> DeviceOutputs {
        DeviceOutputs { outputs: vec![(kernels::forward(gpu, self.0, &i[0].data), vec![i[0].shape[0], self.0 * self.0])], kept: vec![] }
    }

    fn backward_on(&self, gpu: &Gpu, i: &[OnDevice], _: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        vec![d[0].as_ref().map(|d| kernels::backward(gpu, self.0, &i[0].data, d))]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read_values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::spherical_harmonics::reference;
    use diorama_testkit::{assert_close, random, wide};

    #[test]
    fn burn_sees_the_same_gradient() {
        let x = random(6, 1);
        let xt = Tensor::<2>::from_data(TensorData::new(x.clone(), [2, 3]), &Device::flex().autodiff()).require_grad();
        let grads = spherical_harmonics(4, xt.clone()).unwrap().sum().backward();
        assert_close("x", &read_values(xt.grad(&grads).unwrap()), &reference::backward(4, &wide(&x), &vec![1.0; 32]), 1e-4);
    }
}
