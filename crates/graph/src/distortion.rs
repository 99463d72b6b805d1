//! Distortion loss in burn's graph.

use crate::bridge::{In, Out, SliceOp, apply_one};
#[cfg(feature = "gpu")]
use crate::on_gpu::{Ahead, DeviceOp, OnDevice};
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
    fn forward(&self, i: &[In]) -> Vec<Out> {
        let p = Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt };
        let loss = (0..p.rays()).map(|r| cpu::ray(&p, r, &i[0].data[p.range(r)], 0.0, &mut [])).collect();
        vec![(loss, vec![p.rays()])]
    }
    fn backward(&self, i: &[In], d: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>> {
        let p = Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt };
        vec![d[0].map(|d| {
            let mut g = vec![0.0; p.samples()];
            for r in 0..p.rays() {
                cpu::ray(&p, r, &i[0].data[p.range(r)], d[r], &mut g[p.range(r)]);
            }
            g
        })]
    }
}

/// The loss per ray, differentiable in the weights.
///
/// # Shapes
/// weights: `[S]`; result: `[R]`.
pub fn distortion(samples: Packed, weights: Tensor<1>) -> Tensor<1> {
    let op = DistortionOp { offsets: samples.offsets.into(), t: samples.t.into(), dt: samples.dt.into() };
    apply_one(op, vec![weights.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceOp for DistortionOp {
    fn ahead(&self, gpu: &Gpu, i: &[OnDevice]) -> Ahead {
        let p = GpuPacked::upload(gpu, &Packed { offsets: &self.offsets, t: &self.t, dt: &self.dt });
        Ahead { outputs: vec![(kernels::forward(gpu, &p, &i[0].data), vec![p.rays()])], kept: vec![p.offsets, p.t, p.dt] }
    }

    fn back(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let p = GpuPacked { offsets: kept[0].clone(), t: kept[1].clone(), dt: kept[2].clone() };
        vec![d[0].as_ref().map(|d| kernels::backward(gpu, &p, &i[0].data, d))]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ragged_rays::ragged_rays;
    use crate::values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::distortion::reference;
    use diorama_testkit::{assert_close, random_unit, wide};

    #[test]
    fn burn_sees_the_same_gradient() {
        let s = ragged_rays(3, 4);
        let w = random_unit(s.t.len(), 1);
        let wt = Tensor::<1>::from_data(TensorData::new(w.clone(), [w.len()]), &Device::flex().autodiff()).require_grad();
        let grads = distortion(s.packed(), wt.clone()).sum().backward();
        assert_close("w", &values(wt.grad(&grads).unwrap()), &reference::backward(&s.packed(), &wide(&w), &[1.0; 3]), 1e-4);
    }
}
