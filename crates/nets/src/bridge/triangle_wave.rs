//! Triangle-wave encoding in burn's graph.

#[cfg(feature = "gpu")]
use super::{DeviceKernels, DeviceOutputs, OnDevice};
use super::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
use diorama_kernels::ops::triangle_wave::cpu;
#[cfg(feature = "gpu")]
use diorama_kernels::ops::triangle_wave::gpu as kernels;

#[derive(Debug)]
struct WaveOp(usize);

impl SliceOp for WaveOp {
    fn name(&self) -> &'static str {
        "triangle wave"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)?;
        expect_shape(self.name(), "x", shapes[0], &[None, None])
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let (n, dims) = (x[0].shape()[0], x[0].shape()[1]);
        let mut out = ValuesMut::any(&[n, dims * self.0]);
        cpu::forward(dims, self.0, &x[0], &mut out);
        Forward::one(out.freeze(), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let x = &kept.values[0];
        vec![d[0].as_ref().map(|d| {
            let mut dx = ValuesMut::zeros(x.shape());
            cpu::backward(x.shape()[1], self.0, x, d, &mut dx);
            dx.freeze()
        })]
    }

    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        Some(self)
    }
}

/// Encodes rows, differentiable in `x`.
///
/// # Shapes
/// x: `[N, dims]`; result: `[N, dims · bands]`, all bands of a coordinate together.
pub fn triangle_wave(bands: usize, x: Tensor<2>) -> Result<Tensor<2>, OpError> {
    apply_one(WaveOp(bands), vec![x.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceKernels for WaveOp {
    fn forward_on(&self, gpu: &Gpu, i: &[OnDevice]) -> DeviceOutputs {
        let [n, dims] = [i[0].shape[0], i[0].shape[1]];
        DeviceOutputs { outputs: vec![(kernels::forward(gpu, self.0, &i[0].data), vec![n, dims * self.0])], kept: vec![] }
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
    use diorama_kernels::ops::triangle_wave::reference;
    use diorama_testkit::{assert_close, random, wide};

    #[test]
    fn burn_sees_the_same_gradient() {
        let x = random(6, 1);
        let xt = Tensor::<2>::from_data(TensorData::new(x.clone(), [2, 3]), &Device::flex().autodiff()).require_grad();
        let grads = triangle_wave(3, xt.clone()).unwrap().sum().backward();
        assert_close("x", &read_values(xt.grad(&grads).unwrap()), &reference::backward(3, &wide(&x), &[1.0; 18]), 1e-4);
    }
}
