//! Triangle-wave encoding in burn's graph.

use crate::bridge::{In, Out, SliceOp, apply_one};
#[cfg(feature = "gpu")]
use crate::on_gpu::{Ahead, DeviceOp, OnDevice};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
use diorama_kernels::ops::triangle_wave::cpu;
#[cfg(feature = "gpu")]
use diorama_kernels::ops::triangle_wave::gpu as kernels;

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
    apply_one(WaveOp(bands), vec![x.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceOp for WaveOp {
    fn ahead(&self, gpu: &Gpu, i: &[OnDevice]) -> Ahead {
        let [n, dims] = [i[0].shape[0], i[0].shape[1]];
        Ahead { outputs: vec![(kernels::forward(gpu, self.0, &i[0].data), vec![n, dims * self.0])], kept: vec![] }
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
    use diorama_kernels::ops::triangle_wave::reference;
    use diorama_testkit::{assert_close, random, wide};

    #[test]
    fn burn_sees_the_same_gradient() {
        let x = random(6, 1);
        let xt = Tensor::<2>::from_data(TensorData::new(x.clone(), [2, 3]), &Device::flex().autodiff()).require_grad();
        let grads = triangle_wave(3, xt.clone()).sum().backward();
        assert_close("x", &values(xt.grad(&grads).unwrap()), &reference::backward(3, &wide(&x), &[1.0; 18]), 1e-4);
    }
}
