//! Volume rendering by quadrature in burn's graph.

use crate::bridge::{In, Out, SliceOp, apply};
#[cfg(feature = "gpu")]
use crate::on_gpu::{Ahead, DeviceOp, OnDevice};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
#[cfg(feature = "gpu")]
use diorama_kernels::ops::composite::gpu::{self as kernels, GpuComposited, GpuPacked};
use diorama_kernels::ops::composite::{MAX_CHANNELS, Packed, cpu};
use std::sync::Arc;

#[derive(Debug)]
struct CompositeOp {
    offsets: Arc<[u32]>,
    t: Arc<[f32]>,
    dt: Arc<[f32]>,
}

impl CompositeOp {
    fn packed(&self) -> Packed<'_> {
        Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt }
    }
}

impl SliceOp for CompositeOp {
    fn forward(&self, i: &[In]) -> Vec<Out> {
        let (r, c) = (self.offsets.len() - 1, i[1].shape[1]);
        let out = cpu::forward(&self.packed(), i[0].data, i[1].data, c, i[2].data);
        vec![(out.color, vec![r, c]), (out.depth, vec![r]), (out.opacity, vec![r]), (out.weights, vec![self.t.len()])]
    }
    fn backward(&self, i: &[In], d: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>> {
        let d = cpu::Upstream { color: d[0], depth: d[1], opacity: d[2], weights: d[3] };
        let g = cpu::backward(&self.packed(), i[0].data, i[1].data, i[1].shape[1], i[2].data, &d);
        vec![Some(g.sigma), Some(g.features), Some(g.background)]
    }
}

/// Composites features, differentiable in densities, features and background.
///
/// # Shapes
/// sigma: `[S]`; features: `[S, C]`; background: `[R, C]`; results: color `[R, C]`, depth `[R]`,
/// opacity `[R]`, weights `[S]`.
///
/// # Panics
/// When `C` exceeds [`MAX_CHANNELS`].
pub fn composite(
    samples: Packed,
    sigma: Tensor<1>,
    features: Tensor<2>,
    background: Tensor<2>,
) -> (Tensor<2>, Tensor<1>, Tensor<1>, Tensor<1>) {
    assert!(features.dims()[1] <= MAX_CHANNELS, "composite: more than {MAX_CHANNELS} channels");
    let op = CompositeOp { offsets: samples.offsets.into(), t: samples.t.into(), dt: samples.dt.into() };
    let out = apply(op, vec![sigma.into_dispatch(), features.into_dispatch(), background.into_dispatch()]);
    let mut it = out.into_iter();
    let mut next = || it.next().expect("four outputs");
    (Tensor::from_dispatch(next()), Tensor::from_dispatch(next()), Tensor::from_dispatch(next()), Tensor::from_dispatch(next()))
}

#[cfg(feature = "gpu")]
impl DeviceOp for CompositeOp {
    fn ahead(&self, gpu: &Gpu, i: &[OnDevice]) -> Ahead {
        let (r, c) = (self.offsets.len() - 1, i[1].shape[1]);
        let p = GpuPacked::upload(gpu, &self.packed());
        let out = kernels::forward(gpu, &p, &i[0].data, &i[1].data, c, &i[2].data);
        let GpuComposited { color, depth, opacity, weights } = out;
        let kept = vec![p.offsets, p.t, p.dt, color.clone(), depth.clone(), opacity.clone(), weights.clone()];
        Ahead { outputs: vec![(color, vec![r, c]), (depth, vec![r]), (opacity, vec![r]), (weights, vec![self.t.len()])], kept }
    }

    fn back(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let at = |k: usize| kept[k].clone();
        let p = GpuPacked { offsets: at(0), t: at(1), dt: at(2) };
        let out = GpuComposited { color: at(3), depth: at(4), opacity: at(5), weights: at(6) };
        let of = |k: usize, like: &Buffer| d[k].clone().unwrap_or_else(|| gpu.zeros(like.len()));
        let d = GpuComposited {
            color: of(0, &out.color),
            depth: of(1, &out.depth),
            opacity: of(2, &out.opacity),
            weights: of(3, &out.weights),
        };
        let g = kernels::backward(gpu, &p, &i[1].data, i[1].shape[1], &i[2].data, &out, &d);
        vec![Some(g.sigma), Some(g.features), Some(g.background)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ragged_rays::ragged_rays;
    use crate::values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::composite::{Composited, reference};
    use diorama_testkit::{assert_close, random, wide};

    #[test]
    fn burn_sees_the_same_gradients() {
        let s = ragged_rays(5, 4);
        let n = s.t.len();
        let device = Device::flex().autodiff();
        let f = random(n * 3, 1);
        let st = Tensor::<1>::from_data(TensorData::new(s.sigma.clone(), [n]), &device).require_grad();
        let ft = Tensor::<2>::from_data(TensorData::new(f.clone(), [n, 3]), &device).require_grad();
        let bt = Tensor::<2>::zeros([5, 3], &device);
        let (color, _, _, weights) = composite(s.packed(), st.clone(), ft.clone(), bt);
        let grads = (color.sum() + weights.sum() * 0.5).backward();
        let d = Composited { color: vec![1.0; 15], depth: vec![0.0; 5], opacity: vec![0.0; 5], weights: vec![0.5; n] };
        let (ds, df, _) = reference::backward(&s.packed(), &wide(&s.sigma), &wide(&f), 3, &[0.0; 15], &d);
        assert_close("sigma", &values(st.grad(&grads).unwrap()), &ds, 1e-4);
        assert_close("features", &values(ft.grad(&grads).unwrap()), &df, 1e-4);
    }
}
