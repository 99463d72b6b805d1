//! Prefetches the input of the next pass while tiles are computed.

use crate::simd;
use crate::tile::Ahead;

/// Rows of channels to prefetch, one channel after the other, in pieces.
pub struct Later {
    /// Start of the current channel's rows, and how many of their floats were requested.
    from: *const f32,
    at: usize,
    run: Run,
    /// Channels left.
    planes: usize,
    /// Floats from one piece to the next: all pieces together make up all rows, so that requests are spread over the pass.
    step: usize,
}

/// What of an input a pass reads.
#[derive(Clone, Copy)]
pub struct Run {
    /// First row of the first channel.
    pub from: *const f32,
    /// Floats of a channel's rows.
    pub len: usize,
    /// Images, and channels of each.
    pub images: usize,
    pub channels: usize,
    /// Floats to the next channel, and from the last channel of an image to the next image's first.
    pub to_channel: usize,
    pub to_image: usize,
}

impl Later {
    /// Rows that `pieces` request.
    pub fn new(run: Run, pieces: usize) -> Later {
        let planes = if run.len > 0 { run.images * run.channels } else { 0 };
        // At least a cache line; pieces, which are as wide as a tile, may overlap.
        let step = (planes * run.len).div_ceil(pieces.max(1)).max(16);
        Later { from: run.from, at: 0, run, planes, step }
    }

    /// The next `pieces`; none when all is requested.
    pub fn next(&mut self, pieces: usize) -> Option<Ahead> {
        if self.planes == 0 {
            return None;
        }
        let row = self.run.len.div_ceil(self.step);
        let ahead = Ahead {
            from: self.from.wrapping_add(self.at),
            left: (self.run.len - self.at).div_ceil(self.step),
            pieces: row,
            step: self.step,
            turn: self.run.to_channel.wrapping_sub((row - 1) * self.step),
        };
        self.advance(pieces * self.step, row * self.step);
        Some(ahead)
    }

    /// Prefetches the next `pieces` at once.
    pub fn fetch(&mut self, pieces: usize) {
        let mut floats = pieces * self.step;
        while floats > 0 && self.planes > 0 {
            let run = floats.min(self.run.len - self.at);
            simd::fetch_later(self.from.wrapping_add(self.at), run);
            self.advance(run, self.run.len);
            floats -= run;
        }
    }

    /// Skips `floats`, where each channel takes `row`.
    fn advance(&mut self, floats: usize, row: usize) {
        self.at += floats;
        while self.at >= self.run.len && self.planes > 0 {
            self.at = self.at.saturating_sub(row);
            self.planes -= 1;
            let is_last = self.planes.is_multiple_of(self.run.channels);
            self.from = self.from.wrapping_add(if is_last { self.run.to_image } else { self.run.to_channel });
        }
    }
}
