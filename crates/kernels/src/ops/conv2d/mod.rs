//! 2-D convolution, `y = act(w ∗ x + b)`, with stride, padding, dilation and groups.

pub(crate) mod bands;
pub(crate) mod correlate;
pub mod cpu;
mod depthwise;
mod later;
mod paired;
mod planes;
pub mod reference;
pub(crate) mod shapes;
#[cfg(test)]
mod tests;
pub(crate) mod weights;
mod winograd;

use super::activation::Activation;
use crate::gemm::Precision;

/// Description of a convolution without its weights; pairs are (vertical, horizontal).
///
/// # Shapes
/// x `[batch, channels_in, height, width]`; weights `[channels_out, channels_in / groups, kernel, kernel]`; bias empty or
/// `[channels_out]`; y `[batch, channels_out, ⌊(height + 2 padding − dilation (kernel − 1) − 1) / stride⌋ + 1, …]`. All row-major, as in PyTorch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Conv2d {
    pub channels_in: usize,
    pub channels_out: usize,
    pub kernel: [usize; 2],
    pub stride: [usize; 2],
    pub padding: [usize; 2],
    pub dilation: [usize; 2],
    pub groups: usize,
    pub activation: Activation,
    /// Precision of inputs, weights and output gradients. Sums, weight gradients and depthwise layers are always f32.
    pub precision: Precision,
}

/// Number of images in a batch, and their size in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Images {
    pub batch: usize,
    pub height: usize,
    pub width: usize,
}

impl Images {
    pub fn pixels(&self) -> usize {
        self.height * self.width
    }

    pub(crate) fn size(&self) -> [usize; 2] {
        [self.height, self.width]
    }
}

/// Destinations of a backward pass, which overwrites them; a gradient that is `None` is not computed.
#[derive(Default)]
pub struct Gradients<'a> {
    /// Same shape as the input.
    pub input: Option<&'a mut [f32]>,
    /// Same shape as the weights.
    pub weights: Option<&'a mut [f32]>,
    /// `[channels_out]`
    pub bias: Option<&'a mut [f32]>,
}

impl Conv2d {
    /// A square kernel with stride 1, no padding, one group and no activation.
    pub fn new(channels_in: usize, channels_out: usize, kernel: usize) -> Self {
        Conv2d {
            channels_in,
            channels_out,
            kernel: [kernel; 2],
            stride: [1; 2],
            padding: [0; 2],
            dilation: [1; 2],
            groups: 1,
            activation: Activation::None,
            precision: Precision::F32,
        }
    }

    /// Size of the outputs.
    ///
    /// # Panics
    /// When the kernel is larger than a padded image, or the description is invalid.
    pub fn output(&self, images: &Images) -> Images {
        self.check();
        let size = |i: usize, n: usize| {
            let (padded, reach) = (n + 2 * self.padding[i], self.dilation[i] * (self.kernel[i] - 1) + 1);
            assert!(padded >= reach, "conv2d: a kernel that covers {reach} pixels on an image of {padded}");
            (padded - reach) / self.stride[i] + 1
        };
        Images { batch: images.batch, height: size(0, images.height), width: size(1, images.width) }
    }

    pub fn weights_len(&self) -> usize {
        self.channels_out * (self.channels_in / self.groups) * self.taps()
    }

    pub(crate) fn taps(&self) -> usize {
        self.kernel[0] * self.kernel[1]
    }

    pub(crate) fn check(&self) {
        assert!(
            self.groups > 0 && self.channels_in.is_multiple_of(self.groups) && self.channels_out.is_multiple_of(self.groups),
            "conv2d: groups"
        );
        let positive = [self.kernel, self.stride, self.dilation].iter().flatten().all(|&v| v > 0);
        assert!(positive, "conv2d: kernel, stride and dilation are at least 1");
    }
}

/// `values ← act(values)` on this thread.
fn activate(activation: Activation, values: &mut [f32]) {
    if activation != Activation::None {
        crate::ops::activation::cpu::forward_in_place(activation, values);
    }
}
