//! A fully connected layer in burn's graph.

use super::precision::{Precision, precision};
#[cfg(feature = "gpu")]
use super::{DeviceKernels, DeviceOutputs, OnDevice};
use super::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu, Rows};
#[cfg(feature = "gpu")]
use diorama_kernels::ops::linear::gpu as kernels;
use diorama_kernels::ops::linear::{Activation, BiasKind, Dense, Gradients, Linear, cpu};

#[derive(Debug)]
struct LinearOp {
    activation: Activation,
    bias: BiasKind,
    precision: Precision,
}

impl LinearOp {
    /// Rows of x, its width, and that of the result.
    fn size(x: &[usize], weight: &[usize]) -> (usize, usize, usize) {
        (x[..x.len() - 1].iter().product(), weight[0], weight[1])
    }

    fn layer(&self, x: &[usize], weight: &[usize]) -> Linear {
        let (rows, k, n) = Self::size(x, weight);
        Linear { precision: self.precision, ..self.dense(k, n).of_rows(rows) }
    }

    fn dense(&self, k: usize, n: usize) -> Dense {
        Dense { k, n, bias: self.bias, activation: self.activation }
    }

    fn result(x: &[usize], width: usize) -> Vec<usize> {
        x[..x.len() - 1].iter().copied().chain([width]).collect()
    }
}

impl SliceOp for LinearOp {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, if self.bias == BiasKind::None { 2 } else { 3 })?;
        expect_shape(self.name(), "weight", shapes[1], &[None, None])?;
        if !self.activation.is_monotonic() {
            let message = format!("{:?} needs its input backward; make it a layer of its own", self.activation);
            return Err(OpError::settings(self.name(), message));
        }
        if shapes[0].last() != Some(&shapes[1][0]) {
            return Err(OpError::shape(self.name(), "x", shapes[0], format!("[…, {}]", shapes[1][0])));
        }
        let (m, _, n) = Self::size(shapes[0], shapes[1]);
        let Some(bias) = shapes.get(2) else { return Ok(()) };
        let rows = if self.bias == BiasKind::PerRow { m } else { 1 };
        if bias.last() == Some(&n) && bias.iter().product::<usize>() == rows * n {
            return Ok(());
        }
        Err(OpError::shape(self.name(), "bias", bias, format!("[{n}] or a row of {n} for each of {m} rows")))
    }

    fn forward(&self, x: &[Values], wanted: &[bool]) -> Forward {
        let (m, k, n) = Self::size(x[0].shape(), x[1].shape());
        super::work::book(m * k * n);
        let mut out = ValuesMut::any(&Self::result(x[0].shape(), n));
        let bias = x.get(2).map_or(&[][..], |b| &b[..]);
        cpu::forward(&self.layer(x[0].shape(), x[1].shape()), &x[0], &x[1], bias, &mut out);
        let out = out.freeze();
        if !wanted.contains(&true) {
            return Forward::one(out, Kept::default());
        }
        let mut kept = vec![x[0].clone(), x[1].clone(), out.clone()];
        // Of the bias its shape alone is needed.
        kept.extend(x.get(2).cloned());
        Forward::one(out, Kept::of(&kept))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], wanted: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None; wanted.len()] };
        let [x, w, out] = [&kept.values[0], &kept.values[1], &kept.values[2]];
        let bias_shape = kept.values.get(3).map_or(&[0][..], |b| b.shape());
        let shapes = [x.shape(), w.shape(), bias_shape];
        let mut all: [Option<ValuesMut>; 3] = std::array::from_fn(|i| wanted.get(i).is_some_and(|w| *w).then(|| ValuesMut::any(shapes[i])));
        let [dx, dw, db] = &mut all;
        let gradients = Gradients { x: dx.as_deref_mut(), w: dw.as_deref_mut(), bias: db.as_deref_mut() };
        cpu::backward(&self.layer(x.shape(), w.shape()), x, w, out, d, gradients);
        all.into_iter().take(wanted.len()).map(|v| v.map(ValuesMut::freeze)).collect()
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
    apply_one(LinearOp { activation, bias: kind, precision: precision() }, inputs)
}

/// The layer on the last axis of a tensor of any rank, with a shared bias `[N]`.
pub(crate) fn linear_of_rows<const D: usize>(
    x: Tensor<D>,
    weight: Tensor<2>,
    bias: Option<Tensor<1>>,
    activation: Activation,
) -> Result<Tensor<D>, OpError> {
    let kind = if bias.is_some() { BiasKind::Shared } else { BiasKind::None };
    let mut inputs = vec![x.into_dispatch(), weight.into_dispatch()];
    inputs.extend(bias.map(|b| b.into_dispatch()));
    apply_one(LinearOp { activation, bias: kind, precision: precision() }, inputs)
}

#[cfg(feature = "gpu")]
impl DeviceKernels for LinearOp {
    fn forward_on(&self, gpu: &Gpu, i: &[OnDevice]) -> DeviceOutputs {
        let (m, k, n) = Self::size(&i[0].shape, &i[1].shape);
        let (rows, bias) = (Rows::all(gpu, m), i.get(2).map(|b| &b.data));
        let out = kernels::forward(gpu, &rows, &self.dense(k, n), &i[0].data, &i[1].data, bias);
        DeviceOutputs { outputs: vec![(out.clone(), Self::result(&i[0].shape, n))], kept: vec![out] }
    }

    fn backward_on(&self, gpu: &Gpu, i: &[OnDevice], kept: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let Some(d) = &d[0] else { return vec![None; i.len()] };
        let (m, k, n) = Self::size(&i[0].shape, &i[1].shape);
        let g = kernels::backward(gpu, &Rows::all(gpu, m), &self.dense(k, n), &i[0].data, &i[1].data, &kept[0], d);
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
        let layer = Dense { k: 4, n: 3, bias: BiasKind::Shared, activation: Activation::Sigmoid };
        let (dx, dw, db) = reference::backward(5, &layer, &wide(&x), &wide(&w), &wide(&b), &[1.0; 15]);
        assert_close("x", &read_values(xt.grad(&grads).unwrap()), &dx, 1e-4);
        assert_close("w", &read_values(wt.grad(&grads).unwrap()), &dw, 1e-4);
        assert_close("b", &read_values(bt.grad(&grads).unwrap()), &db, 1e-4);
    }
}
