//! Structural similarity of two images in burn's graph.

#[cfg(feature = "gpu")]
use super::{DeviceKernels, DeviceOutputs, OnDevice};
use super::{Forward, Kept, OpError, SliceOp, Values, apply_one, expect_inputs, expect_shape};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
use diorama_kernels::ops::ssim::cpu;
#[cfg(feature = "gpu")]
use diorama_kernels::ops::ssim::gpu as kernels;

#[derive(Debug)]
struct SsimOp;

impl SliceOp for SsimOp {
    fn name(&self) -> &'static str {
        "ssim"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 2)?;
        expect_shape(self.name(), "x", shapes[0], &[None, None, None])?;
        if shapes[0][0] < 11 || shapes[0][1] < 11 {
            return Err(OpError::shape(self.name(), "x", shapes[0], "at least 11 x 11 pixels"));
        }
        let same: Vec<Option<usize>> = shapes[0].iter().map(|n| Some(*n)).collect();
        expect_shape(self.name(), "y", shapes[1], &same)
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let [h, w, c] = [x[0].shape()[0], x[0].shape()[1], x[0].shape()[2]];
        Forward::one(Values::from_vec(vec![cpu::ssim(w, h, c, &x[0], &x[1]) as f32], &[1]), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let [x, y] = [&kept.values[0], &kept.values[1]];
        let [h, w, c] = [x.shape()[0], x.shape()[1], x.shape()[2]];
        let Some(d) = &d[0] else { return vec![None, None] };
        let mut g = cpu::gradient(w, h, c, x, y);
        g.iter_mut().for_each(|g| *g *= d[0]);
        vec![Some(Values::from_vec(g, x.shape())), None]
    }

    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        Some(self)
    }
}

/// SSIM of two images, differentiable in the first.
///
/// # Shapes
/// x, y: `[H, W, C]` in [0, 1], at least 11×11; result: `[1]`.
pub fn ssim(x: Tensor<3>, y: Tensor<3>) -> Result<Tensor<1>, OpError> {
    apply_one(SsimOp, vec![x.into_dispatch(), y.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceKernels for SsimOp {
    fn forward_on(&self, gpu: &Gpu, i: &[OnDevice]) -> DeviceOutputs {
        let [h, w, c] = [i[0].shape[0], i[0].shape[1], i[0].shape[2]];
        let (mean, kept) = kernels::mean(gpu, kernels::Pair { size: (w, h, c), x: &i[0].data, y: &i[1].data });
        DeviceOutputs { outputs: vec![(mean, vec![1])], kept: kept.into() }
    }

    fn backward_on(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let Some(d) = &d[0] else { return vec![None, None] };
        let [h, w, c] = [i[0].shape[0], i[0].shape[1], i[0].shape[2]];
        let pair = kernels::Pair { size: (w, h, c), x: &i[0].data, y: &i[1].data };
        let kept = [kept[0].clone(), kept[1].clone()];
        vec![Some(kernels::mean_backward(gpu, pair, &kept, d)), None]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read_values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::ssim::reference;
    use diorama_testkit::{assert_close, random_unit, wide};

    #[test]
    fn burn_sees_the_same_gradient() {
        let (x, y) = (random_unit(169, 1), random_unit(169, 2));
        let d = Device::flex().autodiff();
        let xt = Tensor::<3>::from_data(TensorData::new(x.clone(), [13, 13, 1]), &d).require_grad();
        let yt = Tensor::<3>::from_data(TensorData::new(y.clone(), [13, 13, 1]), &d);
        let grads = (ssim(xt.clone(), yt).unwrap() * 2.0).backward();
        let want: Vec<f64> = reference::gradient(13, 13, 1, &wide(&x), &wide(&y)).iter().map(|v| v * 2.0).collect();
        assert_close("x", &read_values(xt.grad(&grads).unwrap()), &want, 1e-4);
    }
}
