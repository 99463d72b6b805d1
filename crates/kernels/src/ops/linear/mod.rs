//! A fully connected layer, `y = act(x W + b)`, of any width, with one bias for all rows or one per row.

pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use crate::burn_op::{self, In, Out, SliceOp};
use burn::tensor::Tensor;

/// Elementwise non-linearity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    None,
    Relu,
    Sigmoid,
    /// `ln(1 + eˣ)`
    Softplus,
    /// `eˣ`, whose gradient is taken at `min(x, 15)` (instant-ngp).
    TruncatedExp,
}

/// What is added before the activation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BiasKind {
    None,
    /// `[N]`
    Shared,
    /// `[M, N]`
    PerRow,
}

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
    burn_op::apply_one(LinearOp { activation, bias: kind }, inputs)
}
