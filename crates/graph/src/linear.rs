//! A fully connected layer in burn's graph.

use crate::bridge::{In, Out, SliceOp, apply_one};
#[cfg(feature = "gpu")]
use crate::on_gpu::{Ahead, DeviceOp, OnDevice};
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
    fn forward(&self, i: &[In]) -> Vec<Out> {
        let (m, k, n) = (i[0].shape[0], i[1].shape[0], i[1].shape[1]);
        let mut out = vec![0.0; m * n];
        let bias = i.get(2).map_or(&[][..], |b| b.data);
        cpu::forward(m, k, n, i[0].data, i[1].data, bias, self.bias, self.activation, &mut out);
        vec![(out, vec![m, n])]
    }
    fn backward(&self, i: &[In], d: &[Option<&[f32]>]) -> Vec<Option<Vec<f32>>> {
        let Some(d) = d[0] else { return vec![None; i.len()] };
        let (m, k, n) = (i[0].shape[0], i[1].shape[0], i[1].shape[1]);
        let out = &self.forward(i)[0].0;
        let bias_len = i.get(2).map_or(0, |b| b.data.len());
        let (mut dx, mut dw, mut db) = (vec![0.0; m * k], vec![0.0; k * n], vec![0.0; bias_len]);
        cpu::backward(m, k, n, i[0].data, i[1].data, self.bias, self.activation, out, d, &mut dx, &mut dw, &mut db);
        vec![Some(dx), Some(dw), Some(db)]
    }
}

/// The layer as a burn op, differentiable in all its inputs.
///
/// # Shapes
/// x: `[M, K]`; weight: `[K, N]`; bias: `[1, N]` shared or `[M, N]` per row; result: `[M, N]`.
pub fn linear(x: Tensor<2>, weight: Tensor<2>, bias: Option<Tensor<2>>, activation: Activation) -> Tensor<2> {
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
impl DeviceOp for LinearOp {
    fn ahead(&self, gpu: &Gpu, i: &[OnDevice]) -> Ahead {
        let (m, size) = (i[0].shape[0], (i[1].shape[0], i[1].shape[1]));
        let (rows, bias) = (Rows::all(gpu, m), i.get(2).map(|b| &b.data));
        let out = kernels::forward(gpu, &rows, size, &i[0].data, &i[1].data, bias, self.bias, self.activation);
        Ahead { outputs: vec![(out.clone(), vec![m, size.1])], kept: vec![out] }
    }

    fn back(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let Some(d) = &d[0] else { return vec![None; i.len()] };
        let (rows, size) = (Rows::all(gpu, i[0].shape[0]), (i[1].shape[0], i[1].shape[1]));
        let g = kernels::backward(gpu, &rows, size, &i[0].data, &i[1].data, self.bias, self.activation, &kept[0], d);
        vec![Some(g.x), Some(g.w), g.bias]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::values;
    use burn::tensor::{Device, TensorData};
    use diorama_kernels::ops::linear::reference;
    use diorama_testkit::{assert_close, random, wide};

    #[test]
    fn burn_sees_the_same_gradients() {
        let device = Device::flex().autodiff();
        let t = |v: &[f32], r: usize, c: usize| Tensor::<2>::from_data(TensorData::new(v.to_vec(), [r, c]), &device).require_grad();
        let (x, w, b) = (random(20, 1), random(12, 2), random(3, 3));
        let (xt, wt, bt) = (t(&x, 5, 4), t(&w, 4, 3), t(&b, 1, 3));
        let grads = linear(xt.clone(), wt.clone(), Some(bt.clone()), Activation::Sigmoid).sum().backward();
        let (dx, dw, db) = reference::backward(5, 4, 3, &wide(&x), &wide(&w), &wide(&b), BiasKind::Shared, Activation::Sigmoid, &[1.0; 15]);
        assert_close("x", &values(xt.grad(&grads).unwrap()), &dx, 1e-4);
        assert_close("w", &values(wt.grad(&grads).unwrap()), &dw, 1e-4);
        assert_close("b", &values(bt.grad(&grads).unwrap()), &db, 1e-4);
    }
}
