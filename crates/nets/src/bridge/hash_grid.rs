//! Multiresolution hash encoding in burn's graph.

#[cfg(feature = "gpu")]
use super::{DeviceKernels, DeviceOutputs, OnDevice};
use super::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu, Rows};
#[cfg(feature = "gpu")]
use diorama_kernels::ops::hash_grid::gpu::GpuHashGrid;
use diorama_kernels::ops::hash_grid::{HashGrid, cpu};

#[derive(Debug)]
struct HashGridOp(HashGrid);

impl SliceOp for HashGridOp {
    fn name(&self) -> &'static str {
        "hash grid"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 2)?;
        expect_shape(self.name(), "points", shapes[0], &[None, Some(3)])?;
        expect_shape(self.name(), "table", shapes[1], &[Some(self.0.rows()), Some(self.0.config.features)])
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let (g, s) = (&self.0, x[0].shape()[0]);
        let mut out = ValuesMut::zeros(&[g.levels.len(), s, g.config.features]);
        cpu::forward(g, &x[0], &x[1], &mut out);
        Forward::one(out.freeze(), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], wanted: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None, None] };
        let [points, table] = [&kept.values[0], &kept.values[1]];
        let d_points = wanted[0].then(|| {
            let mut out = ValuesMut::zeros(points.shape());
            cpu::backward_positions(&self.0, points, table, d, &mut out);
            out.freeze()
        });
        let d_table = wanted[1].then(|| {
            let mut out = ValuesMut::zeros(table.shape());
            cpu::backward(&self.0, points, d, &mut out, None);
            out.freeze()
        });
        vec![d_points, d_table]
    }

    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        Some(self)
    }
}

/// Encodes points, differentiable in the points and in the table.
///
/// # Shapes
/// points: `[S, 3]` in `[0, 1]³`; table: `[rows, F]`; result: `[L, S, F]`.
pub fn hash_grid(grid: &HashGrid, points: Tensor<2>, table: Tensor<2>) -> Result<Tensor<3>, OpError> {
    apply_one(HashGridOp(grid.clone()), vec![points.into_dispatch(), table.into_dispatch()])
}

#[cfg(feature = "gpu")]
impl DeviceKernels for HashGridOp {
    fn forward_on(&self, gpu: &Gpu, i: &[OnDevice]) -> DeviceOutputs {
        let (g, s) = (GpuHashGrid::new(gpu, &self.0), i[0].shape[0]);
        let out = g.forward(gpu, &Rows::all(gpu, s), &i[0].data, &i[1].data);
        DeviceOutputs { outputs: vec![(out, vec![self.0.levels.len(), s, self.0.config.features])], kept: vec![g.levels.cast()] }
    }

    fn backward_on(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let Some(d) = &d[0] else { return vec![None, None] };
        let g = GpuHashGrid { grid: self.0.clone(), levels: kept[0].cast() };
        let rows = Rows::all(gpu, i[0].shape[0]);
        let d_table = gpu.zeros(self.0.params_len());
        g.backward(gpu, &rows, &i[0].data, d, &d_table);
        vec![Some(g.backward_positions(gpu, &rows, &i[0].data, &i[1].data, d)), Some(d_table)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read_values;
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
        let grads = hash_grid(&grid, pt.clone(), tt.clone()).unwrap().sum().backward();
        let ones = vec![1.0; 9 * grid.output_dims()];
        let (dp, dt) = reference::backward(&grid, &wide(&p), &wide(&t), &ones);
        assert_close("points", &read_values(pt.grad(&grads).unwrap()), &dp, 1e-4);
        assert_close("table", &read_values(tt.grad(&grads).unwrap()), &dt, 1e-4);
    }
}
