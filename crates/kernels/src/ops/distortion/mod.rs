//! Distortion loss (Barron et al. 2022, mip-NeRF 360, eq. 15), which pulls a ray's weights together:
//! `Σ_ij w_i w_j |m_i − m_j| + ⅓ Σ_i w_i² δ_i` with interval midpoints `m` and lengths `δ`.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use super::composite::Packed;
use crate::burn_op::{self, In, Out, SliceOp};
use burn::tensor::Tensor;
use std::sync::Arc;

/// Distance `t` as a coordinate in which all of space is finite, `s = 4 t / (1 + t)`: distance around 1, where its slope
/// is 1, and disparity beyond. Unbounded rays are judged in it, as mip-NeRF 360 does with its normalized distance.
#[inline(always)]
pub fn normalized_distance(t: f32) -> f32 {
    4.0 * t / (1.0 + t)
}

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
    burn_op::apply_one(op, vec![weights.into_dispatch()])
}
