//! Features at the corners of sparse voxels in burn's graph.

#[cfg(feature = "gpu")]
use super::{DeviceKernels, DeviceOutputs, OnDevice};
use super::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
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
    fn name(&self) -> &'static str {
        "corner grid"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 2)?;
        expect_shape(self.name(), "local", shapes[0], &[Some(self.voxel.len()), Some(3)])?;
        expect_shape(self.name(), "table", shapes[1], &[None, None])
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let (s, c) = (x[0].shape()[0], x[1].shape()[1]);
        let mut out = ValuesMut::zeros(&[s, c]);
        cpu::forward(&self.corners(), &x[0], &x[1], c, &mut out);
        Forward::one(out.freeze(), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None, None] };
        let [local, table] = [&kept.values[0], &kept.values[1]];
        let (mut du, mut dt) = (ValuesMut::zeros(local.shape()), ValuesMut::zeros(table.shape()));
        cpu::backward(&self.corners(), local, table, table.shape()[1], d, &mut du, &mut dt);
        vec![Some(du.freeze()), Some(dt.freeze())]
    }

    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        Some(self)
    }
}

/// Mixes corner features, differentiable in positions and table.
///
/// # Shapes
/// local: positions within the voxel in [0, 1], `[S, 3]`; table: `[rows, C]`; result: `[S, C]`.
pub fn trilinear_corner_grid(corners: Corners, local: Tensor<2>, table: Tensor<2>) -> Result<Tensor<2>, OpError> {
    let op = CornerOp { rows: corners.rows.into(), voxel: corners.voxel.into() };
    apply_one(op, vec![local.into_dispatch(), table.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceKernels for CornerOp {
    fn forward_on(&self, gpu: &Gpu, i: &[OnDevice]) -> DeviceOutputs {
        let c = i[1].shape[1];
        let corners = GpuCorners::upload(gpu, &self.corners());
        let out = corners.forward(gpu, &i[0].data, &i[1].data, c);
        DeviceOutputs { outputs: vec![(out, vec![i[0].shape[0], c])], kept: vec![corners.rows.cast(), corners.voxel.cast()] }
    }

    fn backward_on(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let Some(d) = &d[0] else { return vec![None, None] };
        let corners = GpuCorners { rows: kept[0].cast(), voxel: kept[1].cast() };
        let d_table = gpu.zeros(i[1].data.len());
        let d_local = corners.backward(gpu, &i[0].data, &i[1].data, i[1].shape[1], d, &d_table);
        vec![Some(d_local), Some(d_table)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read_values;
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
        let grads = trilinear_corner_grid(k, ut.clone(), tt.clone()).unwrap().sum().backward();
        let (du, dt) = reference::backward(&k, &wide(&u), &wide(&t), 3, &[1.0; 12]);
        assert_close("positions", &read_values(ut.grad(&grads).unwrap()), &du, 1e-4);
        assert_close("table", &read_values(tt.grad(&grads).unwrap()), &dt, 1e-4);
    }
}
