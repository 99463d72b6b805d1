//! Volume rendering by quadrature in burn's graph.

#[cfg(feature = "gpu")]
use super::{DeviceKernels, DeviceOutputs, OnDevice};
use super::{Forward, Kept, OpError, SliceOp, Values, apply, expect_inputs, expect_shape};
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
    fn name(&self) -> &'static str {
        "composite"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 3)?;
        expect_shape(self.name(), "sigma", shapes[0], &[Some(self.t.len())])?;
        expect_shape(self.name(), "features", shapes[1], &[Some(self.t.len()), None])?;
        if shapes[1][1] > MAX_CHANNELS {
            return Err(OpError::shape(self.name(), "features", shapes[1], format!("at most {MAX_CHANNELS} channels")));
        }
        expect_shape(self.name(), "background", shapes[2], &[Some(self.offsets.len() - 1), Some(shapes[1][1])])
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let (r, c) = (self.offsets.len() - 1, x[1].shape()[1]);
        let out = cpu::forward(&self.packed(), &x[0], &x[1], c, &x[2]);
        let (color, depth) = (Values::from_vec(out.color, &[r, c]), Values::from_vec(out.depth, &[r]));
        let (opacity, weights) = (Values::from_vec(out.opacity, &[r]), Values::from_vec(out.weights, &[self.t.len()]));
        Forward { outputs: vec![color, depth, opacity, weights], kept: Kept::of(x) }
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let [sigma, features, background] = [&kept.values[0], &kept.values[1], &kept.values[2]];
        let at = |k: usize| d[k].as_deref();
        let d = cpu::Upstream { color: at(0), depth: at(1), opacity: at(2), weights: at(3) };
        let g = cpu::backward(&self.packed(), sigma, features, features.shape()[1], background, &d);
        let like = |g: Vec<f32>, of: &Values| Some(Values::from_vec(g, of.shape()));
        vec![like(g.sigma, sigma), like(g.features, features), like(g.background, background)]
    }

    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        Some(self)
    }
}

/// What compositing gives.
pub struct Composited {
    /// `[R, C]`.
    pub color: Tensor<2>,
    /// `[R]`.
    pub depth: Tensor<1>,
    /// `[R]`.
    pub opacity: Tensor<1>,
    /// `[S]`.
    pub weights: Tensor<1>,
}

/// Composites features, differentiable in densities, features and background.
///
/// # Shapes
/// sigma: `[S]`; features: `[S, C]`, `C` at most [`MAX_CHANNELS`]; background: `[R, C]`.
pub fn composite(samples: Packed, sigma: Tensor<1>, features: Tensor<2>, background: Tensor<2>) -> Result<Composited, OpError> {
    let op = CompositeOp { offsets: samples.offsets.into(), t: samples.t.into(), dt: samples.dt.into() };
    let out = apply(op, vec![sigma.into_dispatch(), features.into_dispatch(), background.into_dispatch()])?;
    let [color, depth, opacity, weights] = out.try_into().expect("four outputs");
    Ok(Composited {
        color: Tensor::from_dispatch(color),
        depth: Tensor::from_dispatch(depth),
        opacity: Tensor::from_dispatch(opacity),
        weights: Tensor::from_dispatch(weights),
    })
}

#[cfg(feature = "gpu")]
impl DeviceKernels for CompositeOp {
    fn forward_on(&self, gpu: &Gpu, i: &[OnDevice]) -> DeviceOutputs {
        let (r, c) = (self.offsets.len() - 1, i[1].shape[1]);
        let p = GpuPacked::upload(gpu, &self.packed());
        let out = kernels::forward(gpu, &p, &i[0].data, &i[1].data, c, &i[2].data);
        let GpuComposited { color, depth, opacity, weights } = out;
        let kept = vec![p.offsets.cast(), p.t, p.dt, color.clone(), depth.clone(), opacity.clone(), weights.clone()];
        DeviceOutputs { outputs: vec![(color, vec![r, c]), (depth, vec![r]), (opacity, vec![r]), (weights, vec![self.t.len()])], kept }
    }

    fn backward_on(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let at = |k: usize| kept[k].clone();
        let p = GpuPacked { offsets: at(0).cast(), t: at(1), dt: at(2) };
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
    use crate::bridge::ragged_rays::ragged_rays;
    use crate::read_values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::composite::{Composited as Upstream, reference};
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
        let Composited { color, weights, .. } = composite(s.packed(), st.clone(), ft.clone(), bt).unwrap();
        let grads = (color.sum() + weights.sum() * 0.5).backward();
        let d = Upstream { color: vec![1.0; 15], depth: vec![0.0; 5], opacity: vec![0.0; 5], weights: vec![0.5; n] };
        let (ds, df, _) = reference::backward(&s.packed(), &wide(&s.sigma), &wide(&f), 3, &[0.0; 15], &d);
        assert_close("sigma", &read_values(st.grad(&grads).unwrap()), &ds, 1e-4);
        assert_close("features", &read_values(ft.grad(&grads).unwrap()), &df, 1e-4);
    }
}
