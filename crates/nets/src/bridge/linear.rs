//! A fully connected layer in burn's graph.

use super::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
#[cfg(feature = "gpu")]
use super::{DeviceKernels, DeviceOutputs, OnDevice};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu, Rows};
#[cfg(feature = "gpu")]
use diorama_kernels::ops::linear::gpu as kernels;
use diorama_kernels::ops::linear::{Activation, BiasKind, cpu};

#[derive(Debug)]
struct LinearOp {
    activation: Activation,
    bias: BiasKind,
}

impl SliceOp for LinearOp {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, if self.bias == BiasKind::None { 2 } else { 3 })?;
        expect_shape(self.name(), "weight", shapes[1], &[None, None])?;
        expect_shape(self.name(), "x", shapes[0], &[None, Some(shapes[1][0])])?;
        let rows = if self.bias == BiasKind::PerRow { shapes[0][0] } else { 1 };
        shapes.get(2).map_or(Ok(()), |b| expect_shape(self.name(), "bias", b, &[Some(rows), Some(shapes[1][1])]))
    }

    fn forward(&self, x: &[Values], wanted: &[bool]) -> Forward {
        let (m, k, n) = (x[0].shape()[0], x[1].shape()[0], x[1].shape()[1]);
        let mut out = ValuesMut::any(&[m, n]);
        let bias = x.get(2).map_or(&[][..], |b| &b[..]);
        cpu::forward(m, k, n, &x[0], &x[1], bias, self.bias, self.activation, &mut out);
        let out = out.freeze();
        let kept = if wanted.contains(&true) { Kept::of(&[x[0].clone(), x[1].clone(), out.clone()]) } else { Kept::default() };
        Forward::one(out, kept)
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], wanted: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None; wanted.len()] };
        let [x, w, out] = [&kept.values[0], &kept.values[1], &kept.values[2]];
        let (m, k, n) = (x.shape()[0], w.shape()[0], w.shape()[1]);
        let bias_rows = [(BiasKind::None, 0), (BiasKind::Shared, 1)].iter().find(|b| b.0 == self.bias).map_or(m, |b| b.1);
        let (mut dx, mut dw, mut db) = (ValuesMut::any(&[m, k]), ValuesMut::any(&[k, n]), ValuesMut::any(&[bias_rows, n]));
        cpu::backward(m, k, n, x, w, self.bias, self.activation, out, d, &mut dx, &mut dw, &mut db);
        let mut all = vec![Some(dx.freeze()), Some(dw.freeze()), Some(db.freeze())];
        all.truncate(wanted.len());
        all
    }

    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        Some(self)
    }
}

/// The layer as a burn op, differentiable in all its inputs.
///
/// # Shapes
/// x: `[M, K]`; weight: `[K, N]`; bias: `[1, N]` shared or `[M, N]` per row; result: `[M, N]`.
pub fn linear(x: Tensor<2>, weight: Tensor<2>, bias: Option<Tensor<2>>, activation: Activation) -> Result<Tensor<2>, OpError> {
    let kind = match &bias {
        None => BiasKind::None,
        Some(b) if b.dims()[0] == 1 => BiasKind::Shared,
        Some(_) => BiasKind::PerRow,
    };
    let mut inputs = vec![x.into_dispatch(), weight.into_dispatch()];
    inputs.extend(bias.map(|b| b.into_dispatch()));
    apply_one(LinearOp { activation, bias: kind }, inputs)
}

#[cfg(feature = "gpu")]
impl DeviceKernels for LinearOp {
    fn forward_on(&self, gpu: &Gpu, i: &[OnDevice]) -> DeviceOutputs {
        let (m, size) = (i[0].shape[0], (i[1].shape[0], i[1].shape[1]));
        let (rows, bias) = (Rows::all(gpu, m), i.get(2).map(|b| &b.data));
        let out = kernels::forward(gpu, &rows, size, &i[0].data, &i[1].data, bias, self.bias, self.activation);
        DeviceOutputs { outputs: vec![(out.clone(), vec![m, size.1])], kept: vec![out] }
    }

    fn backward_on(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let Some(d) = &d[0] else { return vec![None; i.len()] };
        let (rows, size) = (Rows::all(gpu, i[0].shape[0]), (i[1].shape[0], i[1].shape[1]));
        let g = kernels::backward(gpu, &rows, size, &i[0].data, &i[1].data, self.bias, self.activation, &kept[0], d);
        vec![Some(g.x), Some(g.w), g.bias]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read_values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::linear::reference;
    use diorama_testkit::{assert_close, random, wide};

    #[test]
    fn burn_sees_the_same_gradients() {
        let device = Device::flex().autodiff();
        let t = |v: &[f32], r: usize, c: usize| Tensor::<2>::from_data(TensorData::new(v.to_vec(), [r, c]), &device).require_grad();
        let (x, w, b) = (random(20, 1), random(12, 2), random(3, 3));
        let (xt, wt, bt) = (t(&x, 5, 4), t(&w, 4, 3), t(&b, 1, 3));
        let grads = linear(xt.clone(), wt.clone(), Some(bt.clone()), Activation::Sigmoid).unwrap().sum().backward();
        let (dx, dw, db) = reference::backward(5, 4, 3, &wide(&x), &wide(&w), &wide(&b), BiasKind::Shared, Activation::Sigmoid, &[1.0; 15]);
        assert_close("x", &read_values(xt.grad(&grads).unwrap()), &dx, 1e-4);
        assert_close("w", &read_values(wt.grad(&grads).unwrap()), &dw, 1e-4);
        assert_close("b", &read_values(bt.grad(&grads).unwrap()), &db, 1e-4);
    }
}
