//! Fully connected layers on the last axis of tensors of any rank.

use super::Activation;
use crate::bridge::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::tensor::Tensor;
use diorama_kernels::ops::linear::{Activation as Fused, BiasKind, cpu};

#[derive(Debug)]
struct LinearOp {
    activation: Fused,
}

impl LinearOp {
    fn bias(inputs: usize) -> BiasKind {
        if inputs == 3 { BiasKind::Shared } else { BiasKind::None }
    }
}

impl SliceOp for LinearOp {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        if shapes.len() != 2 {
            expect_inputs(self.name(), shapes, 3)?;
        }
        expect_shape(self.name(), "weight", shapes[1], &[None, None])?;
        if shapes[0].last() != Some(&shapes[1][0]) {
            return Err(OpError::shape(self.name(), "x", shapes[0], format!("[…, {}]", shapes[1][0])));
        }
        shapes.get(2).map_or(Ok(()), |b| expect_shape(self.name(), "bias", b, &[Some(shapes[1][1])]))
    }

    fn forward(&self, x: &[Values], wanted: &[bool]) -> Forward {
        let (k, n) = (x[1].shape()[0], x[1].shape()[1]);
        let mut shape = x[0].shape().to_vec();
        *shape.last_mut().expect("checked") = n;
        let m = x[0].shape()[..x[0].shape().len() - 1].iter().product();
        let mut out = ValuesMut::any(&shape);
        let bias = x.get(2).map_or(&[][..], |b| &b[..]);
        cpu::forward(m, k, n, &x[0], &x[1], bias, Self::bias(x.len()), self.activation, &mut out);
        let out = out.freeze();
        let kept = if wanted.contains(&true) { Kept::of(&[x[0].clone(), x[1].clone(), out.clone()]) } else { Kept::default() };
        Forward::one(out, kept)
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], wanted: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None; wanted.len()] };
        let [x, w, out] = [&kept.values[0], &kept.values[1], &kept.values[2]];
        let (k, n) = (w.shape()[0], w.shape()[1]);
        let m = x.len() / k.max(1);
        let kind = Self::bias(wanted.len());
        let bias_len = if kind == BiasKind::Shared { n } else { 0 };
        let (mut dx, mut dw, mut db) = (ValuesMut::any(x.shape()), ValuesMut::any(w.shape()), ValuesMut::any(&[bias_len]));
        cpu::backward(m, k, n, x, w, kind, self.activation, out, d, &mut dx, &mut dw, &mut db);
        let mut all = vec![Some(dx.freeze()), Some(dw.freeze()), Some(db.freeze())];
        all.truncate(wanted.len());
        all
    }
}

/// `act(x W + b)`; activations that the kernel lacks are a layer of their own.
///
/// # Shapes
/// x `[…, K]`; weight `[K, N]`, the transpose of PyTorch's; bias `[N]`; result `[…, N]`.
pub fn linear<const D: usize>(
    x: Tensor<D>,
    weight: Tensor<2>,
    bias: Option<Tensor<1>>,
    activation: Activation,
) -> Result<Tensor<D>, OpError> {
    let fused = match activation {
        Activation::None => Some(Fused::None),
        Activation::Relu => Some(Fused::Relu),
        Activation::Sigmoid => Some(Fused::Sigmoid),
        _ => None,
    };
    let mut inputs = vec![x.into_dispatch(), weight.into_dispatch()];
    inputs.extend(bias.map(|b| b.into_dispatch()));
    let out = apply_one(LinearOp { activation: fused.unwrap_or(Fused::None) }, inputs)?;
    if fused.is_some() { Ok(out) } else { super::activation(out, activation) }
}
