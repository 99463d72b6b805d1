//! Multiresolution hash encoding in burn's graph.

use crate::bridge::{In, Out, SliceOp, apply_one};
#[cfg(feature = "gpu")]
use crate::on_gpu::{Ahead, DeviceOp, OnDevice};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu, Rows};
#[cfg(feature = "gpu")]
use diorama_kernels::ops::hash_grid::gpu::GpuHashGrid;
use diorama_kernels::ops::hash_grid::{HashGrid, cpu};

#[derive(Debug)]
struct HashGridOp(HashGrid);

impl SliceOp for HashGridOp {
    fn forward(&self, i: &[In]) -> Vec<Out> {
        let g = &self.0;
        let s = i[0].shape[0];
        let mut out = vec![0.0; s * g.output_dims()];
        cpu::forward(g, i[0].data, i[1].data, &mut out);
        vec![(out, vec![g.levels.len(), s, g.config.features])]
    }
    fn backward(&self, i: &[In], d: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>> {
        let Some(d) = d[0] else { return vec![None, None] };
        let mut d_points = vec![0.0; i[0].data.len()];
        let mut d_table = vec![0.0; self.0.params_len()];
        cpu::backward(&self.0, i[0].data, d, &mut d_table, None);
        cpu::backward_positions(&self.0, i[0].data, i[1].data, d, &mut d_points);
        vec![Some(d_points), Some(d_table)]
    }
}

/// Encodes points, differentiable in the points and in the table.
///
/// # Shapes
/// points: `[S, 3]` in `[0, 1]³`; table: `[rows, F]`; result: `[L, S, F]`.
pub fn hash_grid(grid: &HashGrid, points: Tensor<2>, table: Tensor<2>) -> Tensor<3> {
    apply_one(HashGridOp(grid.clone()), vec![points.into_dispatch(), table.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceOp for HashGridOp {
    fn ahead(&self, gpu: &Gpu, i: &[OnDevice]) -> Ahead {
        let (g, s) = (GpuHashGrid::new(gpu, &self.0), i[0].shape[0]);
        let out = g.forward(gpu, &Rows::all(gpu, s), &i[0].data, &i[1].data);
        Ahead { outputs: vec![(out, vec![self.0.levels.len(), s, self.0.config.features])], kept: vec![g.levels] }
    }

    fn back(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let Some(d) = &d[0] else { return vec![None, None] };
        let g = GpuHashGrid { grid: self.0.clone(), levels: kept[0].clone() };
        let rows = Rows::all(gpu, i[0].shape[0]);
        let d_table = gpu.zeros(self.0.params_len());
        g.backward(gpu, &rows, &i[0].data, d, &d_table);
        vec![Some(g.backward_positions(gpu, &rows, &i[0].data, &i[1].data, d)), Some(d_table)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::hash_grid::{HashGridConfig, reference};
    use diorama_testkit::{assert_close, random, random_unit, wide};

    #[test]
    fn burn_sees_the_same_gradients() {
        let grid = HashGrid::new(HashGridConfig { levels: 4, features: 2, log2_size: 9, base: 3, finest: 40 });
        // Some points on the border and outside of the cube.
        let (mut p, t) = (random_unit(27, 11), random(grid.params_len(), 2));
        p[..9].copy_from_slice(&[0.0, 1.0, 0.5, -0.3, 0.4, 1.7, 1.0, 1.0, 1.0]);
        let device = Device::flex().autodiff();
        let pt = Tensor::<2>::from_data(TensorData::new(p.clone(), [9, 3]), &device).require_grad();
        let tt = Tensor::<2>::from_data(TensorData::new(t.clone(), [grid.rows(), 2]), &device).require_grad();
        let grads = hash_grid(&grid, pt.clone(), tt.clone()).sum().backward();
        let ones = vec![1.0; 9 * grid.output_dims()];
        let (dp, dt) = reference::backward(&grid, &wide(&p), &wide(&t), &ones);
        assert_close("points", &values(pt.grad(&grads).unwrap()), &dp, 1e-4);
        assert_close("table", &values(tt.grad(&grads).unwrap()), &dt, 1e-4);
    }
}
