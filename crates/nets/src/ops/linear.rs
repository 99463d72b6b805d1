//! Fully connected layers on the last axis of tensors of any rank.

use super::Activation;
use crate::bridge::{OpError, linear_of_rows};
use burn::tensor::Tensor;
use diorama_kernels::ops::linear::Activation as Fused;

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
        Activation::Tanh => Some(Fused::Tanh),
        _ => None,
    };
    let out = linear_of_rows(x, weight, bias, fused.unwrap_or(Fused::None))?;
    if fused.is_some() { Ok(out) } else { super::activation(out, activation) }
}
