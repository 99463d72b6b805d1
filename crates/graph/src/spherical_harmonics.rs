//! Spherical harmonics of directions in burn's graph.

use crate::bridge::{In, Out, SliceOp, apply_one};
#[cfg(feature = "gpu")]
use crate::on_gpu::{Ahead, DeviceOp, OnDevice};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
use diorama_kernels::ops::spherical_harmonics::cpu;
#[cfg(feature = "gpu")]
use diorama_kernels::ops::spherical_harmonics::gpu as kernels;

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
    apply_one(ShOp(degree), vec![directions.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceOp for ShOp {
    fn ahead(&self, gpu: &Gpu, i: &[OnDevice]) -> Ahead {
        Ahead { outputs: vec![(kernels::forward(gpu, self.0, &i[0].data), vec![i[0].shape[0], self.0 * self.0])], kept: vec![] }
    }

    fn back(&self, gpu: &Gpu, i: &[OnDevice], _: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        vec![d[0].as_ref().map(|d| kernels::backward(gpu, self.0, &i[0].data, d))]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::spherical_harmonics::reference;
    use diorama_testkit::{assert_close, random, wide};

    #[test]
    fn burn_sees_the_same_gradient() {
        let x = random(6, 1);
        let xt = Tensor::<2>::from_data(TensorData::new(x.clone(), [2, 3]), &Device::flex().autodiff()).require_grad();
        let grads = spherical_harmonics(4, xt.clone()).sum().backward();
        assert_close("x", &values(xt.grad(&grads).unwrap()), &reference::backward(4, &wide(&x), &vec![1.0; 32]), 1e-4);
    }
}
