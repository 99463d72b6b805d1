//! Descriptions of correlations and weight gradients, shared by all algorithms that compute them.

use crate::gemm::{Precision, has_bf16};
use crate::ops::activation::Activation;

/// A weight, and the input pixel that it multiplies relative to a grid cell.
#[derive(Clone, Copy, Debug)]
pub struct Tap {
    /// Offset from the first weight of a channel.
    pub weight: usize,
    /// Input pixel: `step · grid + at`.
    pub at: [isize; 2],
}

/// Outputs that share their taps: pixels `start + spread · grid`.
#[derive(Clone, Debug, Default)]
pub struct Phase {
    pub start: [usize; 2],
    /// Cells of the grid.
    pub size: [usize; 2],
    pub taps: Vec<Tap>,
}

/// `out[n, g, f, start + spread · grid] = act(bias[g, f] + Σ_{c, tap} w[g, f, c, tap] x[n, g, c, step · grid + at])`.
#[derive(Clone, Debug)]
pub struct Correlation {
    pub batch: usize,
    pub groups: usize,
    /// Input channels per group.
    pub channels: usize,
    /// Size of the input.
    pub input: [usize; 2],
    /// Output channels per group.
    pub features: usize,
    /// Size of the output.
    pub output: [usize; 2],
    pub step: [usize; 2],
    pub spread: [usize; 2],
    pub phases: Vec<Phase>,
    /// Strides of the weights between groups, output channels and input channels.
    pub weight_group: usize,
    pub weight_feature: usize,
    pub weight_channel: usize,
    pub precision: Precision,
}

impl Correlation {
    /// Whether factors are rounded to bf16.
    pub(super) fn is_rounded(&self) -> bool {
        self.precision == Precision::Bf16 && has_bf16()
    }

    /// Whether every phase has one tap, at its own cell of the input.
    pub(super) fn is_pointwise(&self) -> bool {
        let one = |p: &Phase| matches!(&p.taps[..], [tap] if tap.at == [0; 2]) && p.size == self.input;
        self.step == [1; 2] && self.phases.iter().all(one)
    }

    /// Whether phases have equal sizes and each pair holds the even and the odd pixels of the same rows.
    pub(super) fn alternates(&self) -> bool {
        let alternate = |p: &[Phase]| matches!(p, [a, b] if a.start[0] == b.start[0] && [a.start[1], b.start[1]] == [0, 1]);
        let size = self.phases.first().map(|p| p.size);
        self.spread[1] == 2
            && !self.is_rounded()
            && self.phases.iter().all(|p| Some(p.size) == size)
            && self.phases.chunks(2).all(alternate)
    }

    /// Whether two phases read the same inputs.
    pub(super) fn reads_the_same(&self, a: usize, b: usize) -> bool {
        self.phases[a].taps.iter().map(|t| t.at).eq(self.phases[b].taps.iter().map(|t| t.at))
    }
}

/// Tensors of a [`Correlation`].
pub struct Tensors<'a> {
    pub x: &'a [f32],
    pub weights: &'a [f32],
    /// Empty for none.
    pub bias: &'a [f32],
    pub activation: Activation,
    pub out: &'a mut [f32],
    /// Values before the activation.
    pub before: Option<&'a mut [f32]>,
}

/// Converts an offset to the 32 bits of the offset tables.
pub(super) fn offset(v: usize) -> u32 {
    u32::try_from(v).expect("an image has less than 2³² floats")
}

/// Shapes of a weight gradient: `d` is `[batch, groups · rows, grid]`, `x` `[batch, groups · columns, input]`.
#[derive(Clone, Copy, Debug)]
pub struct WeightSums {
    pub batch: usize,
    pub groups: usize,
    pub rows: usize,
    pub grid: [usize; 2],
    pub columns: usize,
    pub input: [usize; 2],
    pub kernel: [usize; 2],
    pub step: [usize; 2],
    pub padding: [usize; 2],
    pub dilation: [usize; 2],
}
