//! Applies the activation to tiles and writes them to the output tensor.

use super::{Job, Part, Step};
use crate::ops::activation::Activation;
use crate::ops::conv2d::activate;
use crate::simd;
use crate::tile::{Segment, Shared};
use crate::vector::by_lanes;

impl Job<'_> {
    /// Prefetches the outputs that a tile will write.
    pub(super) fn fetch_outputs(&self, step: &Step, channel: usize, rows: usize) {
        let (pixels, spread) = (self.c.output[0] * self.c.output[1], self.c.spread[1]);
        for r in (step.share.0..rows).step_by(step.share.1) {
            for s in step.segments {
                simd::fetch_to_write(self.out.0.wrapping_add((channel + r) * pixels + step.to + s.to), s.len * spread);
            }
        }
    }

    /// The segment of a tile that can be written directly: the only one, whole vectors, and complete after one pass.
    pub(super) fn straight<'a>(&self, step: &Step<'a>) -> Option<&'a Segment> {
        let [segment] = step.segments else { return None };
        let whole = segment.at == 0 && segment.len.is_multiple_of(self.kernel.lanes);
        let plain = self.c.spread[1] == 1 && self.before.is_none() && self.joined == 1;
        (whole && plain && step.last && step.channels.start == 0).then_some(segment)
    }

    /// Applies the activation to outputs that were written directly.
    pub(super) fn activate_outputs(&self, segment: &Segment, channel: usize, rows: usize) {
        if self.activation == Activation::None {
            return;
        }
        let pixels = self.c.output[0] * self.c.output[1];
        for r in 0..rows {
            // SAFETY: the pixels of a segment are this task's own, and lie inside the output.
            let row = unsafe { std::slice::from_raw_parts_mut(self.out.at((channel + r) * pixels + segment.to), segment.len) };
            activate(self.activation, row);
        }
    }

    /// Writes the outputs of some channels from their sums.
    pub(super) fn finish(&self, segments: &[Segment], channel: usize, rows: usize, sums: &mut [f32]) {
        if let Some(before) = self.before {
            self.store(segments, channel, rows, sums, before);
        }
        activate(self.activation, sums);
        self.store(segments, channel, rows, sums, self.out);
    }

    /// Writes the outputs of all channels of a part; `sums` holds those of even pixels, then those of odd ones.
    pub(super) fn finish_both(&self, segments: &[Segment], to: usize, part: &Part, sums: &mut [f32]) {
        if let Some(before) = self.before {
            self.store_both(segments, to, part, sums, before);
        }
        activate(self.activation, sums);
        self.store_both(segments, to, part, sums, self.out);
    }

    fn store_both(&self, segments: &[Segment], to: usize, part: &Part, sums: &[f32], out: Shared) {
        let (even, odd) = sums.split_at(sums.len() / 2);
        let pixels = self.c.output[0] * self.c.output[1];
        let first = (part.group * self.c.features + part.features.start) * pixels;
        // SAFETY: the pixels of a segment in both phases are this task's own, and lie inside the output.
        unsafe { alternate([even, odd], self.kernel.width(), segments, out.at(first + to), pixels) };
    }

    fn store(&self, segments: &[Segment], channel: usize, rows: usize, sums: &[f32], out: Shared) {
        let (width, pixels, spread) = (self.kernel.width(), self.c.output[0] * self.c.output[1], self.c.spread[1]);
        for (r, sums) in sums.chunks_exact(width).enumerate().take(rows) {
            for s in segments {
                let from = &sums[s.at..s.at + s.len];
                // SAFETY: the pixels of a segment are this task's own, and lie inside the output, whose length `run` checked.
                unsafe {
                    let to = out.at((channel + r) * pixels + s.to);
                    if spread == 1 {
                        std::ptr::copy_nonoverlapping(from.as_ptr(), to, s.len);
                    } else {
                        for (i, v) in from.iter().enumerate() {
                            *to.add(i * spread) = *v;
                        }
                    }
                }
            }
        }
    }
}

by_lanes! {
    /// Interleaves: `out[row · stride + to + 2 i] = even[row, at + i]`, and `odd` one float later, for all segments of rows of `width`.
    ///
    /// # Safety
    /// The rows of `out` have the pixels of all segments.
    unsafe fn alternate<L>(sums: [&[f32]; 2], width: usize, segments: &[Segment], out: *mut f32, stride: usize) {
        let [even, odd] = sums.map(|s| s.chunks_exact(width));
        for (r, (even, odd)) in even.zip(odd).enumerate() {
            for s in segments {
                let (even, odd) = (&even[s.at..s.at + s.len], &odd[s.at..s.at + s.len]);
                let out = out.add(r * stride + s.to);
                let mut i = 0;
                while i + L::N <= s.len {
                    L::store_pairs(out.add(2 * i), L::load(even.as_ptr().add(i)), L::load(odd.as_ptr().add(i)));
                    i += L::N;
                }
                for i in i..s.len {
                    *out.add(2 * i) = even[i];
                    *out.add(2 * i + 1) = odd[i];
                }
            }
        }
    }
}
