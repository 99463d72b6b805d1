//! Weights in the order that tiles read them in.

use crate::ops::conv2d::shapes::{Correlation, Phase};
use crate::tile::Shared;
use rayon::prelude::*;
use std::cell::Cell;

/// Output channels per task of a copy.
const BLOCK: usize = 16;

thread_local! {
    static COPY: Cell<Vec<f32>> = const { Cell::new(Vec::new()) };
}

/// Weights of a correlation, and their strides.
#[derive(Clone, Copy)]
pub struct Factors<'a> {
    pub data: &'a [f32],
    /// Floats between groups, and between output channels.
    pub group: usize,
    pub feature: usize,
    is_copied: bool,
}

impl Factors<'_> {
    /// Offset of the weight of an input channel and a tap from the output channel's first; `first` is the number of taps before the phase.
    pub fn offset(&self, c: &Correlation, first: usize, phase: &Phase, channel: usize, tap: usize) -> usize {
        if self.is_copied {
            c.channels * first + channel * phase.taps.len() + tap
        } else {
            channel * c.weight_channel + phase.taps.get(tap).map_or(0, |t| t.weight)
        }
    }
}

impl Correlation {
    /// Calls `work` with the weights in place, or with a copy in which those of an output channel and a phase are contiguous.
    pub fn with_factors<R>(&self, weights: &[f32], work: impl FnOnce(Factors) -> R) -> R {
        let taps: usize = self.phases.iter().map(|p| p.taps.len()).sum();
        if self.weight_channel <= self.weight_feature || self.weight_feature == 1 {
            return work(Factors { data: weights, group: self.weight_group, feature: self.weight_feature, is_copied: false });
        }
        let feature = self.channels * taps;
        let group = feature * self.features;
        let mut copy = COPY.take();
        copy.resize(self.groups * group, 0.0);
        let out = Shared(copy.as_mut_ptr());
        let blocks = self.features.div_ceil(BLOCK);
        (0..self.groups * blocks).into_par_iter().for_each(|i| {
            let (g, first) = (i / blocks, i % blocks * BLOCK);
            for channel in 0..self.channels {
                for f in first..(first + BLOCK).min(self.features) {
                    let from = &weights[g * self.weight_group + f * self.weight_feature + channel * self.weight_channel..];
                    let mut at = g * group + f * feature;
                    for phase in &self.phases {
                        for (t, tap) in phase.taps.iter().enumerate() {
                            // SAFETY: every output channel has its own part of the copy.
                            unsafe { *out.at(at + channel * phase.taps.len() + t) = from[tap.weight] };
                        }
                        at += self.channels * phase.taps.len();
                    }
                }
            }
        });
        let result = work(Factors { data: &copy, group, feature, is_copied: true });
        COPY.set(copy);
        result
    }
}
