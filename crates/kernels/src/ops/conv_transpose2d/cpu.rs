//! Forward and backward passes on the CPU: those of the adjoint convolution, exchanged.

use super::{ConvTranspose2d, Gradients, Images};
use crate::ops::activation::Activation;
use crate::ops::conv2d::cpu::{bias_gradient, with_slopes};
use crate::ops::conv2d::shapes::{Tensors, WeightSums};

fn check(c: &ConvTranspose2d, images: &Images, x: &[f32], weights: &[f32], out: usize) -> Images {
    let output = c.output(images);
    assert_eq!(x.len(), images.batch * c.channels_in * images.pixels(), "conv_transpose2d: input");
    assert_eq!(weights.len(), c.weights_len(), "conv_transpose2d: weights");
    assert_eq!(out, images.batch * c.channels_out * output.pixels(), "conv_transpose2d: output");
    output
}

/// Overwrites `out` with `act(wᵀ ∗ x + bias)`, and `before` with the values before the activation.
///
/// # Shapes
/// As in [`ConvTranspose2d`]; `bias` may be empty; `before` is shaped like `out`.
pub fn forward(
    c: &ConvTranspose2d,
    images: &Images,
    x: &[f32],
    weights: &[f32],
    bias: &[f32],
    out: &mut [f32],
    before: Option<&mut [f32]>,
) {
    let output = check(c, images, x, weights, out.len());
    c.adjoint().transposed_from(&output, images).run(Tensors { x, weights, bias, activation: c.activation, out, before });
}

/// Computes gradients from the output gradient `d_out` and a result of the forward pass: `kept` is `before` if the activation needs its
/// input, else `out`.
///
/// # Shapes
/// As in [`ConvTranspose2d`]; `kept` and `d_out` are shaped like `out`; `kept` is not read without an activation.
pub fn backward(c: &ConvTranspose2d, images: &Images, x: &[f32], weights: &[f32], kept: &[f32], d_out: &[f32], gradients: Gradients) {
    let output = check(c, images, x, weights, d_out.len());
    let adjoint = c.adjoint();
    with_slopes(c.activation, kept, d_out, |d| {
        if let Some(bias) = gradients.bias {
            assert_eq!(bias.len(), c.channels_out, "conv_transpose2d: gradient of the bias");
            bias_gradient(images.batch, d, bias);
        }
        if let Some(out) = gradients.input {
            let correlation = adjoint.correlation_to(&output, images);
            correlation.run(Tensors { x: d, weights, bias: &[], activation: Activation::None, out, before: None });
        }
        if let Some(out) = gradients.weights {
            WeightSums { grid: images.size(), ..adjoint.weight_sums(&output) }.run(x, d, out);
        }
    });
}
