//! 2-D transposed convolution, `y = act(wᵀ ∗ x + b)`: the adjoint of `conv2d`, which upsamples by its stride.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;

use super::activation::Activation;
use super::conv2d::Conv2d;
pub use super::conv2d::{Gradients, Images};
use crate::gemm::Precision;

/// Description of a transposed convolution without its weights; pairs are (vertical, horizontal).
///
/// # Shapes
/// x `[batch, channels_in, height, width]`; weights `[channels_in, channels_out / groups, kernel, kernel]`; bias empty or
/// `[channels_out]`; y `[batch, channels_out, (height − 1) stride − 2 padding + dilation (kernel − 1) + output_padding + 1, …]`.
/// All row-major, as in PyTorch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConvTranspose2d {
    pub channels_in: usize,
    pub channels_out: usize,
    pub kernel: [usize; 2],
    pub stride: [usize; 2],
    pub padding: [usize; 2],
    /// Extra rows and columns at the end, fewer than the stride or the dilation.
    pub output_padding: [usize; 2],
    pub dilation: [usize; 2],
    pub groups: usize,
    pub activation: Activation,
    /// As [`Conv2d::precision`].
    pub precision: Precision,
}

impl ConvTranspose2d {
    /// A square kernel without padding, with one group and no activation.
    pub fn new(channels_in: usize, channels_out: usize, kernel: usize, stride: usize) -> Self {
        ConvTranspose2d {
            channels_in,
            channels_out,
            kernel: [kernel; 2],
            stride: [stride; 2],
            padding: [0; 2],
            output_padding: [0; 2],
            dilation: [1; 2],
            groups: 1,
            activation: Activation::None,
            precision: Precision::F32,
        }
    }

    /// The convolution from outputs to inputs with the same weights and no activation.
    pub(crate) fn adjoint(&self) -> Conv2d {
        Conv2d {
            channels_in: self.channels_out,
            channels_out: self.channels_in,
            kernel: self.kernel,
            stride: self.stride,
            padding: self.padding,
            dilation: self.dilation,
            groups: self.groups,
            activation: Activation::None,
            precision: self.precision,
        }
    }

    /// Size of the outputs.
    ///
    /// # Panics
    /// When padding leaves nothing, or the description is invalid.
    pub fn output(&self, images: &Images) -> Images {
        self.adjoint().check();
        let size = |i: usize, n: usize| {
            let fits = self.output_padding[i] < self.stride[i].max(self.dilation[i]);
            assert!(fits, "conv_transpose2d: output padding is less than stride or dilation");
            let full = n.saturating_sub(1) * self.stride[i] + self.dilation[i] * (self.kernel[i] - 1) + self.output_padding[i] + 1;
            assert!(n > 0 && full > 2 * self.padding[i], "conv_transpose2d: padding leaves nothing of {full} pixels");
            full - 2 * self.padding[i]
        };
        Images { batch: images.batch, height: size(0, images.height), width: size(1, images.width) }
    }

    pub fn weights_len(&self) -> usize {
        self.adjoint().weights_len()
    }
}
