//! Positional encoding in burn's graph.

use crate::bridge::{In, Out, SliceOp, apply_one};
#[cfg(feature = "gpu")]
use crate::on_gpu::{Ahead, DeviceOp, OnDevice};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
#[cfg(feature = "gpu")]
use diorama_kernels::ops::frequency::gpu as kernels;
use diorama_kernels::ops::frequency::{Frequency, cpu};

#[derive(Debug)]
struct FrequencyOp(Frequency);

impl SliceOp for FrequencyOp {
    fn forward(&self, i: &[In]) -> Vec<Out> {
        let n = i[0].shape[0];
        let mut out = vec![0.0; n * self.0.output_dims()];
        cpu::forward(&self.0, i[0].data, &mut out);
        vec![(out, vec![n, self.0.output_dims()])]
    }
    fn backward(&self, i: &[In], d: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>> {
        vec![d[0].map(|d| {
            let mut dx = vec![0.0; i[0].data.len()];
            cpu::backward(&self.0, i[0].data, d, &mut dx);
            dx
        })]
    }
}

/// Encodes rows, differentiable in `x`.
///
/// # Shapes
/// x: `[N, dims]`; result: `[N, output_dims]`, per band all sines then all cosines.
pub fn frequency(f: &Frequency, x: Tensor<2>) -> Tensor<2> {
    apply_one(FrequencyOp(*f), vec![x.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceOp for FrequencyOp {
    fn ahead(&self, gpu: &Gpu, i: &[OnDevice]) -> Ahead {
        Ahead { outputs: vec![(kernels::forward(gpu, &self.0, &i[0].data), vec![i[0].shape[0], self.0.output_dims()])], kept: vec![] }
    }

    fn back(&self, gpu: &Gpu, i: &[OnDevice], _: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        vec![d[0].as_ref().map(|d| kernels::backward(gpu, &self.0, &i[0].data, d))]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::frequency::reference;
    use diorama_testkit::{assert_close, random, wide};

    #[test]
    fn burn_sees_the_same_gradient() {
        let f = Frequency { dims: 3, bands: 10, include_input: false, pi: true, window: None };
        let x = random(6, 1);
        let xt = Tensor::<2>::from_data(TensorData::new(x.clone(), [2, 3]), &Device::flex().autodiff()).require_grad();
        let grads = frequency(&f, xt.clone()).sum().backward();
        let want = reference::backward(&f, &wide(&x), &vec![1.0; 120]);
        assert_close("x", &values(xt.grad(&grads).unwrap()), &want, 1e-4);
    }
}
