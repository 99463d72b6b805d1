//! Forward and backward passes on the CPU, as correlations of the input and of the output gradient.

use super::shapes::{Correlation, Phase, Tap, Tensors, WeightSums};
use super::{Conv2d, Gradients, Images};
use crate::math::multiversion;
use crate::ops::activation::Activation;
use crate::ops::activation::cpu::backward_of_kept;
use crate::simd;
use rayon::prelude::*;
use std::cell::RefCell;

impl Conv2d {
    /// Stride of the weights between output channels.
    fn weight_feature(&self) -> usize {
        self.channels_in / self.groups * self.taps()
    }

    /// Every tap, with its offset in the kernel and its distance in pixels from `stride · output pixel`.
    pub(crate) fn each_tap(&self) -> impl Iterator<Item = Tap> + Clone {
        let c = *self;
        (0..c.taps()).map(move |t| {
            let at = |i: usize, k: usize| (k * c.dilation[i]) as isize - c.padding[i] as isize;
            Tap { weight: t, at: [at(0, t / c.kernel[1]), at(1, t % c.kernel[1])] }
        })
    }

    /// From inputs to outputs.
    pub(crate) fn correlation(&self, images: &Images) -> Correlation {
        self.correlation_to(images, &self.output(images))
    }

    /// As [`Self::correlation`], for an output size that may be smaller than what the inputs allow.
    pub(crate) fn correlation_to(&self, images: &Images, output: &Images) -> Correlation {
        let output = output.size();
        Correlation {
            batch: images.batch,
            groups: self.groups,
            channels: self.channels_in / self.groups,
            input: images.size(),
            features: self.channels_out / self.groups,
            output,
            step: self.stride,
            spread: [1; 2],
            phases: vec![Phase { start: [0; 2], size: output, taps: self.each_tap().collect() }],
            weight_group: self.channels_out / self.groups * self.weight_feature(),
            weight_feature: self.weight_feature(),
            weight_channel: self.taps(),
            precision: self.precision,
        }
    }

    /// Correlation from the output gradient to the input gradient, which is also the forward pass of the transposed convolution.
    ///
    /// Input pixel `stride · grid + start` meets output pixel `grid + d` through the taps with `start − at = stride · d`.
    pub(crate) fn transposed(&self, images: &Images) -> Correlation {
        self.transposed_from(images, &self.output(images))
    }

    /// As [`Self::transposed`], for an output size that may be smaller than what the inputs allow.
    pub(crate) fn transposed_from(&self, images: &Images, output: &Images) -> Correlation {
        let input = images.size();
        let mut phases = Vec::new();
        for start in (0..self.stride[0]).flat_map(|y| (0..self.stride[1]).map(move |x| [y, x])) {
            if start[0] >= input[0] || start[1] >= input[1] {
                continue;
            }
            let size = std::array::from_fn(|i| (input[i] - start[i]).div_ceil(self.stride[i]));
            let taps = self.each_tap().filter_map(|t| {
                let distance: [isize; 2] = std::array::from_fn(|i| start[i] as isize - t.at[i]);
                let fits = (0..2).all(|i| distance[i].rem_euclid(self.stride[i] as isize) == 0);
                fits.then(|| Tap { weight: t.weight, at: std::array::from_fn(|i| distance[i].div_euclid(self.stride[i] as isize)) })
            });
            phases.push(Phase { start, size, taps: taps.collect() });
        }
        Correlation {
            batch: images.batch,
            groups: self.groups,
            channels: self.channels_out / self.groups,
            input: output.size(),
            features: self.channels_in / self.groups,
            output: input,
            step: [1; 2],
            spread: self.stride,
            phases,
            weight_group: self.channels_out / self.groups * self.weight_feature(),
            weight_feature: self.taps(),
            weight_channel: self.weight_feature(),
            precision: self.precision,
        }
    }

    /// Sums of products of the output gradient and the input, which give the weight gradient.
    pub(crate) fn weight_sums(&self, images: &Images) -> WeightSums {
        WeightSums {
            batch: images.batch,
            groups: self.groups,
            rows: self.channels_out / self.groups,
            grid: self.output(images).size(),
            columns: self.channels_in / self.groups,
            input: images.size(),
            kernel: self.kernel,
            step: self.stride,
            padding: self.padding,
            dilation: self.dilation,
        }
    }

    fn check_tensors(&self, images: &Images, x: &[f32], weights: &[f32], out: usize) -> Images {
        let output = self.output(images);
        assert_eq!(x.len(), images.batch * self.channels_in * images.pixels(), "conv2d: input");
        assert_eq!(weights.len(), self.weights_len(), "conv2d: weights");
        assert_eq!(out, images.batch * self.channels_out * output.pixels(), "conv2d: output");
        output
    }
}

/// Overwrites `out` with `act(w ∗ x + bias)`, and `before` with the values before the activation.
///
/// # Shapes
/// As in [`Conv2d`]; `bias` may be empty; `before` is shaped like `out`.
pub fn forward(c: &Conv2d, images: &Images, x: &[f32], weights: &[f32], bias: &[f32], out: &mut [f32], before: Option<&mut [f32]>) {
    c.check_tensors(images, x, weights, out.len());
    c.correlation(images).run(Tensors { x, weights, bias, activation: c.activation, out, before });
}

/// Computes gradients from the output gradient `d_out` and a result of the forward pass: `kept` is `before` if the activation needs its
/// input, else `out`.
///
/// # Shapes
/// As in [`Conv2d`]; `kept` and `d_out` are shaped like `out`; `kept` is not read without an activation.
pub fn backward(c: &Conv2d, images: &Images, x: &[f32], weights: &[f32], kept: &[f32], d_out: &[f32], gradients: Gradients) {
    c.check_tensors(images, x, weights, d_out.len());
    with_slopes(c.activation, kept, d_out, |d| {
        if let Some(bias) = gradients.bias {
            assert_eq!(bias.len(), c.channels_out, "conv2d: gradient of the bias");
            bias_gradient(images.batch, d, bias);
        }
        if let Some(out) = gradients.input {
            c.transposed(images).run(Tensors { x: d, weights, bias: &[], activation: Activation::None, out, before: None });
        }
        if let Some(out) = gradients.weights {
            c.weight_sums(images).run(d, x, out);
        }
    });
}

thread_local! {
    static SLOPES: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// Floats per task of an elementwise pass.
const CHUNK: usize = 1 << 14;

/// Calls `work` with the gradient of the values before the activation, `d_out · act′`.
pub(crate) fn with_slopes(activation: Activation, kept: &[f32], d_out: &[f32], work: impl FnOnce(&[f32])) {
    if activation == Activation::None {
        return work(d_out);
    }
    assert_eq!(kept.len(), d_out.len(), "convolution: kept values");
    let mut d = SLOPES.take();
    d.resize(d_out.len(), 0.0);
    let level = simd::level();
    d.par_chunks_mut(CHUNK).zip(kept.par_chunks(CHUNK)).zip(d_out.par_chunks(CHUNK)).for_each(|((d, kept), d_out)| {
        simd::with_level(level, || backward_of_kept(activation, kept, d_out, d));
    });
    work(&d);
    SLOPES.set(d);
}

/// Bias gradient: sums of `d` `[batch, out.len(), pixels]` over images and pixels, per channel.
pub(crate) fn bias_gradient(batch: usize, d: &[f32], out: &mut [f32]) {
    let (channels, level) = (out.len(), simd::level());
    let pixels = d.len() / (batch * channels).max(1);
    out.par_iter_mut().enumerate().for_each(|(c, out)| {
        let planes = (0..batch).map(|n| sum(&d[(n * channels + c) * pixels..][..pixels]));
        *out = simd::with_level(level, || planes.sum());
    });
}

multiversion! {
    fn sum(values: &[f32]) -> f32 {
        let mut lanes = [0.0f32; 64];
        let chunks = values.chunks_exact(64);
        let rest: f32 = chunks.remainder().iter().sum();
        for chunk in chunks {
            for (l, v) in lanes.iter_mut().zip(chunk) {
                *l += v;
            }
        }
        lanes.iter().sum::<f32>() + rest
    }
}
