//! Features at the corners of the occupied voxels of a sparse world (GANcraft, section 3.1): each voxel
//! names eight rows of a feature table, and a point takes their trilinear mix.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use crate::burn_op::{self, In, Out, SliceOp};
use burn::tensor::Tensor;
use std::sync::Arc;

/// Which rows the samples mix. Corner `c` of a voxel is its lowest corner plus bit `k` of `c` along axis `k`.
#[derive(Clone, Copy, Debug)]
pub struct Corners<'a> {
    /// Rows of each voxel's corners, `[voxels, 8]`.
    pub rows: &'a [u32],
    /// Voxel of each sample, `[S]`.
    pub voxel: &'a [u32],
}

#[derive(Debug)]
struct CornerOp {
    rows: Arc<[u32]>,
    voxel: Arc<[u32]>,
}

impl CornerOp {
    fn corners(&self) -> Corners<'_> {
        Corners { rows: &self.rows, voxel: &self.voxel }
    }
}

impl SliceOp for CornerOp {
    fn forward(&self, i: &[In]) -> Vec<Out> {
        let (s, c) = (i[0].shape[0], i[1].shape[1]);
        let mut out = vec![0.0; s * c];
        cpu::forward(&self.corners(), i[0].data, i[1].data, c, &mut out);
        vec![(out, vec![s, c])]
    }
    fn backward(&self, i: &[In], d: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>> {
        let Some(d) = d[0] else { return vec![None, None] };
        let (mut du, mut dt) = (vec![0.0; i[0].data.len()], vec![0.0; i[1].data.len()]);
        cpu::backward(&self.corners(), i[0].data, i[1].data, i[1].shape[1], d, &mut du, &mut dt);
        vec![Some(du), Some(dt)]
    }
}

/// Mixes corner features, differentiable in positions and table.
///
/// # Shapes
/// local: positions within the voxel in [0, 1], `[S, 3]`; table: `[rows, C]`; result: `[S, C]`.
pub fn trilinear_corner_grid(corners: Corners, local: Tensor<2>, table: Tensor<2>) -> Tensor<2> {
    let op = CornerOp { rows: corners.rows.into(), voxel: corners.voxel.into() };
    burn_op::apply_one(op, vec![local.into_dispatch(), table.into_dispatch()])
}
