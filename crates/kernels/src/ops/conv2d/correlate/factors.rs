//! Weights in the order that tiles read them in.

use crate::ops::conv2d::shapes::{Correlation, Phase};
use crate::tile::Shared;
use rayon::prelude::*;
use std::cell::Cell;

/// Weights of an input channel that are copied together: a cache line, where they are side by side.
const LINE: usize = 16;

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
        let taps = self.order();
        let block = (LINE / taps.len().max(1)).max(1);
        let blocks = self.features.div_ceil(block);
        (0..self.groups * blocks).into_par_iter().for_each(|i| {
            let (g, first) = (i / blocks, i % blocks * block);
            for channel in 0..self.channels {
                for f in first..(first + block).min(self.features) {
                    let from = &weights[g * self.weight_group + f * self.weight_feature + channel * self.weight_channel..];
                    let to = g * group + f * feature;
                    for t in &taps {
                        // SAFETY: every output channel has its own part of the copy.
                        unsafe { *out.at(to + t.to + channel * t.channel) = from[t.from] };
                    }
                }
            }
        });
        let result = work(Factors { data: &copy, group, feature, is_copied: true });
        COPY.set(copy);
        result
    }

    /// The taps of all phases, in the order of the copy.
    fn order(&self) -> Vec<Place> {
        let mut first = 0;
        let mut places = Vec::new();
        for phase in &self.phases {
            let channel = phase.taps.len();
            places.extend(phase.taps.iter().enumerate().map(|(t, tap)| Place { from: tap.weight, to: first + t, channel }));
            first += self.channels * channel;
        }
        places
    }
}

/// Where a tap's weights go: from the weights of an input and an output channel to the copy's part of the output channel.
struct Place {
    from: usize,
    to: usize,
    /// Floats between input channels in the copy.
    channel: usize,
}
