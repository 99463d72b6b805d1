//! Volume rendering by quadrature (Max 1995; NeRF eq. 3) over packed samples:
//! `w_i = T_i (1 − e^{−σ_i δ_i})`, `T_{i+1} = T_i e^{−σ_i δ_i}`, `Ĉ = Σ w_i c_i + T_out · background`.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
pub(crate) mod tests;

use crate::burn_op::{self, In, Out, SliceOp};
use burn::tensor::Tensor;
use std::sync::Arc;

/// Most channels per sample.
pub const MAX_CHANNELS: usize = 512;

/// Packed samples along rays: ray `r` owns samples `offsets[r]..offsets[r + 1]`, in order.
#[derive(Clone, Copy, Debug)]
pub struct Packed<'a> {
    /// `[R + 1]`
    pub offsets: &'a [u32],
    /// Start of each interval, `[S]`.
    pub t: &'a [f32],
    /// Length of each interval, `[S]`.
    pub dt: &'a [f32],
}

impl<'a> Packed<'a> {
    pub fn rays(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    pub fn samples(&self) -> usize {
        self.t.len()
    }

    /// Samples of ray `r`.
    pub fn range(&self, r: usize) -> std::ops::Range<usize> {
        self.offsets[r] as usize..self.offsets[r + 1] as usize
    }
}

/// What compositing gives per ray and per sample.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Composited<T> {
    /// `[R, C]`
    pub color: Vec<T>,
    /// `Σ w_i (t_i + δ_i / 2)`, `[R]`: divide by opacity for the expected depth.
    pub depth: Vec<T>,
    /// `Σ w_i = 1 − T_out`, `[R]`
    pub opacity: Vec<T>,
    /// `[S]`
    pub weights: Vec<T>,
}

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
    let out = burn_op::apply(op, vec![sigma.into_dispatch(), features.into_dispatch(), background.into_dispatch()]);
    let mut it = out.into_iter();
    let mut next = || it.next().expect("four outputs");
    (Tensor::from_dispatch(next()), Tensor::from_dispatch(next()), Tensor::from_dispatch(next()), Tensor::from_dispatch(next()))
}
