//! Structural similarity of two images in burn's graph.

use crate::bridge::{In, Out, SliceOp, apply_one};
#[cfg(feature = "gpu")]
use crate::on_gpu::{Ahead, DeviceOp, OnDevice};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
use diorama_kernels::ops::ssim::cpu;
#[cfg(feature = "gpu")]
use diorama_kernels::ops::ssim::gpu as kernels;

#[derive(Debug)]
struct SsimOp;

impl SliceOp for SsimOp {
    fn forward(&self, i: &[In]) -> Vec<Out> {
        let [h, w, c] = [i[0].shape[0], i[0].shape[1], i[0].shape[2]];
        vec![(vec![cpu::ssim(w, h, c, i[0].data, i[1].data) as f32], vec![1])]
    }
    fn backward(&self, i: &[In], d: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>> {
        let [h, w, c] = [i[0].shape[0], i[0].shape[1], i[0].shape[2]];
        let Some(d) = d[0] else { return vec![None, None] };
        let mut g = cpu::gradient(w, h, c, i[0].data, i[1].data);
        g.iter_mut().for_each(|g| *g *= d[0]);
        vec![Some(g), None]
    }
}

/// SSIM of two images, differentiable in the first.
///
/// # Shapes
/// x, y: `[H, W, C]` in [0, 1], at least 11×11; result: `[1]`.
pub fn ssim(x: Tensor<3>, y: Tensor<3>) -> Tensor<1> {
    apply_one(SsimOp, vec![x.into_dispatch(), y.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceOp for SsimOp {
    fn ahead(&self, gpu: &Gpu, i: &[OnDevice]) -> Ahead {
        let [h, w, c] = [i[0].shape[0], i[0].shape[1], i[0].shape[2]];
        let (mean, kept) = kernels::mean(gpu, (w, h, c), &i[0].data, &i[1].data);
        Ahead { outputs: vec![(mean, vec![1])], kept: kept.into() }
    }

    fn back(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let Some(d) = &d[0] else { return vec![None, None] };
        let [h, w, c] = [i[0].shape[0], i[0].shape[1], i[0].shape[2]];
        vec![Some(kernels::mean_backward(gpu, (w, h, c), &i[0].data, &i[1].data, [&kept[0], &kept[1]], d)), None]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::ssim::reference;
    use diorama_testkit::{assert_close, random_unit, wide};

    #[test]
    fn burn_sees_the_same_gradient() {
        let (x, y) = (random_unit(169, 1), random_unit(169, 2));
        let d = Device::flex().autodiff();
        let xt = Tensor::<3>::from_data(TensorData::new(x.clone(), [13, 13, 1]), &d).require_grad();
        let yt = Tensor::<3>::from_data(TensorData::new(y.clone(), [13, 13, 1]), &d);
        let grads = (ssim(xt.clone(), yt) * 2.0).backward();
        let want: Vec<f64> = reference::gradient(13, 13, 1, &wide(&x), &wide(&y)).iter().map(|v| v * 2.0).collect();
        assert_close("x", &values(xt.grad(&grads).unwrap()), &want, 1e-4);
    }
}
