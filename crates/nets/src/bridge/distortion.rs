//! Distortion loss in burn's graph.

#[cfg(feature = "gpu")]
use super::{DeviceKernels, DeviceOutputs, OnDevice};
use super::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
use diorama_kernels::ops::composite::Packed;
#[cfg(feature = "gpu")]
use diorama_kernels::ops::composite::gpu::GpuPacked;
use diorama_kernels::ops::distortion::cpu;
#[cfg(feature = "gpu")]
use diorama_kernels::ops::distortion::gpu as kernels;
use std::sync::Arc;

#[derive(Debug)]
struct DistortionOp {
    offsets: Arc<[u32]>,
    t: Arc<[f32]>,
    dt: Arc<[f32]>,
}

impl SliceOp for DistortionOp {
    fn name(&self) -> &'static str {
        "distortion"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)?;
        expect_shape(self.name(), "weights", shapes[0], &[Some(self.t.len())])
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let p = Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt };
        let mut out = ValuesMut::any(&[p.rays()]);
        for (r, loss) in out.iter_mut().enumerate() {
            *loss = cpu::ray(&p, r, &x[0][p.range(r)], 0.0, &mut []);
        }
        Forward::one(out.freeze(), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let (p, weights) = (Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt }, &kept.values[0]);
        vec![d[0].as_ref().map(|d| {
            let mut g = ValuesMut::zeros(weights.shape());
            for r in 0..p.rays() {
                cpu::ray(&p, r, &weights[p.range(r)], d[r], &mut g[p.range(r)]);
            }
            g.freeze()
        })]
    }

    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        Some(self)
    }
}

/// The loss per ray, differentiable in the weights.
///
/// # Shapes
/// weights: `[S]`; result: `[R]`.
pub fn distortion(samples: Packed, weights: Tensor<1>) -> Result<Tensor<1>, OpError> {
    let op = DistortionOp { offsets: samples.offsets.into(), t: samples.t.into(), dt: samples.dt.into() };
    apply_one(op, vec![weights.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceKernels for DistortionOp {
    fn forward_on(&self, gpu: &Gpu, i: &[OnDevice]) -> DeviceOutputs {
        let p = GpuPacked::upload(gpu, &Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt });
        DeviceOutputs { outputs: vec![(kernels::forward(gpu, &p, &i[0].data), vec![p.rays()])], kept: vec![p.offsets.cast(), p.t, p.dt] }
    }

    fn backward_on(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let p = GpuPacked { offsets: kept[0].cast(), t: kept[1].clone(), dt: kept[2].clone() };
        vec![d[0].as_ref().map(|d| kernels::backward(gpu, &p, &i[0].data, d))]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bridge::ragged_rays::ragged_rays;
    use crate::read_values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::distortion::reference;
    use diorama_testkit::{assert_close, random_unit, wide};

    #[test]
    fn burn_sees_the_same_gradient() {
        let s = ragged_rays(3, 4);
        let w = random_unit(s.t.len(), 1);
        let wt = Tensor::<1>::from_data(TensorData::new(w.clone(), [w.len()]), &Device::flex().autodiff()).require_grad();
        let grads = distortion(s.packed(), wt.clone()).unwrap().sum().backward();
        assert_close("w", &read_values(wt.grad(&grads).unwrap()), &reference::backward(&s.packed(), &wide(&w), &[1.0; 3]), 1e-4);
    }
}
