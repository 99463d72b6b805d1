//! Positional encoding in burn's graph.

#[cfg(feature = "gpu")]
use super::{DeviceKernels, DeviceOutputs, OnDevice};
use super::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
#[cfg(feature = "gpu")]
use diorama_kernels::ops::frequency::gpu as kernels;
use diorama_kernels::ops::frequency::{Frequency, cpu};

#[derive(Debug)]
struct FrequencyOp(Frequency);

impl SliceOp for FrequencyOp {
    fn name(&self) -> &'static str {
        "frequency"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)?;
        expect_shape(self.name(), "x", shapes[0], &[None, Some(self.0.dims)])
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let mut out = ValuesMut::any(&[x[0].shape()[0], self.0.output_dims()]);
        cpu::forward(&self.0, &x[0], &mut out);
        Forward::one(out.freeze(), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let x = &kept.values[0];
        vec![d[0].as_ref().map(|d| {
            let mut dx = ValuesMut::zeros(x.shape());
            cpu::backward(&self.0, x, d, &mut dx);
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
/// x: `[N, dims]`; result: `[N, output_dims]`, per band all sines then all cosines.
pub fn frequency(f: &Frequency, x: Tensor<2>) -> Result<Tensor<2>, OpError> {
    apply_one(FrequencyOp(*f), vec![x.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceKernels for FrequencyOp {
    fn forward_on(&self, gpu: &Gpu, i: &[OnDevice]) -> DeviceOutputs {
        DeviceOutputs {
            outputs: vec![(kernels::forward(gpu, &self.0, &i[0].data), vec![i[0].shape[0], self.0.output_dims()])],
            kept: vec![],
        }
    }

    fn backward_on(&self, gpu: &Gpu, i: &[OnDevice], _: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        vec![d[0].as_ref().map(|d| kernels::backward(gpu, &self.0, &i[0].data, d))]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read_values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::frequency::reference;
    use diorama_testkit::{assert_close, random, wide};

    #[test]
    fn burn_sees_the_same_gradient() {
        let f = Frequency { dims: 3, bands: 10, include_input: false, pi: true, window: None };
        let x = random(6, 1);
        let xt = Tensor::<2>::from_data(TensorData::new(x.clone(), [2, 3]), &Device::flex().autodiff()).require_grad();
        let grads = frequency(&f, xt.clone()).unwrap().sum().backward();
        let want = reference::backward(&f, &wide(&x), &vec![1.0; 120]);
        assert_close("x", &read_values(xt.grad(&grads).unwrap()), &want, 1e-4);
    }
}
