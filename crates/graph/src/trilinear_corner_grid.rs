//! Features at the corners of sparse voxels in burn's graph.

use crate::bridge::{In, Out, SliceOp, apply_one};
#[cfg(feature = "gpu")]
use crate::on_gpu::{Ahead, DeviceOp, OnDevice};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
#[cfg(feature = "gpu")]
use diorama_kernels::ops::trilinear_corner_grid::gpu::GpuCorners;
use diorama_kernels::ops::trilinear_corner_grid::{Corners, cpu};
use std::sync::Arc;

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
    apply_one(op, vec![local.into_dispatch(), table.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceOp for CornerOp {
    fn ahead(&self, gpu: &Gpu, i: &[OnDevice]) -> Ahead {
        let c = i[1].shape[1];
        let corners = GpuCorners::upload(gpu, &self.corners());
        let out = corners.forward(gpu, &i[0].data, &i[1].data, c);
        Ahead { outputs: vec![(out, vec![i[0].shape[0], c])], kept: vec![corners.rows, corners.voxel] }
    }

    fn back(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let Some(d) = &d[0] else { return vec![None, None] };
        let corners = GpuCorners { rows: kept[0].clone(), voxel: kept[1].clone() };
        let d_table = gpu.zeros(i[1].data.len());
        let d_local = corners.backward(gpu, &i[0].data, &i[1].data, i[1].shape[1], d, &d_table);
        vec![Some(d_local), Some(d_table)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::trilinear_corner_grid::reference;
    use diorama_testkit::{assert_close, random, random_unit, wide};

    #[test]
    fn burn_sees_the_same_gradients() {
        // Two voxels that share a face: twelve corners.
        let rows = [0, 1, 2, 3, 4, 5, 6, 7, 1, 8, 3, 9, 5, 10, 7, 11];
        let k = Corners { rows: &rows, voxel: &[0, 1, 0, 1] };
        let (u, t) = (random_unit(12, 1), random(36, 2));
        let device = Device::flex().autodiff();
        let ut = Tensor::<2>::from_data(TensorData::new(u.clone(), [4, 3]), &device).require_grad();
        let tt = Tensor::<2>::from_data(TensorData::new(t.clone(), [12, 3]), &device).require_grad();
        let grads = trilinear_corner_grid(k, ut.clone(), tt.clone()).sum().backward();
        let (du, dt) = reference::backward(&k, &wide(&u), &wide(&t), 3, &[1.0; 12]);
        assert_close("positions", &values(ut.grad(&grads).unwrap()), &du, 1e-4);
        assert_close("table", &values(tt.grad(&grads).unwrap()), &dt, 1e-4);
    }
}
