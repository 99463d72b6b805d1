//! Gradient of texels. Small textures are summed up by tasks in copies of their own. For large ones, points are sorted by the ranges of
//! texels that they read (counts, prefix sum, fill), and each range adds up its points in their order.

use super::taps::{BLOCK, Lookup, Points, Table, Taps, find};
use super::{Filter, Texture};
use crate::math::multiversion;
use crate::partials;
use crate::tasks::{self, Parts};
use std::ops::Range;

/// Ranges of texels at most, as many as a word has bits.
const RANGES: usize = 64;
/// Texels of a range at least.
const LEAST: usize = 1024;
/// Points per chunk at least, and chunks at most.
const CHUNK: usize = 4096;
const CHUNKS: usize = 64;

/// What points read and what they pass back.
struct Source<'a> {
    texture: &'a Texture,
    table: Table,
    coordinates: &'a [f32],
    level: &'a [f32],
    d: &'a [f32],
    per_image: usize,
}

impl Source<'_> {
    /// Finds what up to [`BLOCK`] points read.
    fn find(&self, points: &mut Points, found: &mut Lookup, of: impl Iterator<Item = usize>) {
        points.read(self.texture, self.coordinates, self.level, self.per_image, of);
        find(self.texture, &self.table, points, found);
    }

    /// Adds the gradients of a block's points, whose number `i` is a point and the levels of it that count, to the texels from `first` on
    /// that `to` holds.
    fn add(&self, found: &Lookup, points: impl Iterator<Item = (usize, Range<usize>)>, first: u32, to: &mut [f32]) {
        match self.texture.channels {
            1 => self.add_channels::<1>(found, points, first, to),
            2 => self.add_channels::<2>(found, points, first, to),
            3 => self.add_channels::<3>(found, points, first, to),
            4 => self.add_channels::<4>(found, points, first, to),
            _ => self.add_channels::<0>(found, points, first, to),
        }
    }

    /// `C` channels, or if that is 0 any number of them.
    #[inline(always)]
    fn add_channels<const C: usize>(
        &self,
        found: &Lookup,
        points: impl Iterator<Item = (usize, Range<usize>)>,
        first: u32,
        to: &mut [f32],
    ) {
        let n = if C == 0 { self.texture.channels } else { C };
        for (i, (p, levels)) in points.enumerate() {
            let d = &self.d[p * n..(p + 1) * n];
            for l in levels {
                let taps = &found.taps[l];
                let (weights, share) = (taps.weights(i), found.share(l, i));
                for (k, weight) in weights.into_iter().enumerate() {
                    // Texels before the range wrap to numbers beyond it.
                    let at = taps.texel[k][i].wrapping_sub(first) as usize * n;
                    if let Some(to) = to.get_mut(at..at + n) {
                        to.iter_mut().zip(d).for_each(|(to, d)| *to += share * weight * d);
                    }
                }
            }
        }
    }

    /// Levels that each point reads.
    fn depth(&self) -> usize {
        if self.texture.filter == Filter::Trilinear { 2 } else { 1 }
    }
}

/// Levels of points by the ranges of texels that they read.
struct Sorted {
    /// Where each range's entries begin, `[ranges + 1]`.
    offsets: Vec<u32>,
    /// `point · levels + level`
    entries: Vec<u32>,
}

/// Marks entries that read several ranges.
const SEVERAL: u8 = u8::MAX;

multiversion! {
    /// The one range of `2^shift` texels that each point reads in a level, or [`SEVERAL`].
    fn find_ranges(taps: &Taps, shift: u32, ranges: &mut [u8; BLOCK]) {
        for i in 0..BLOCK {
            let [a, b, c, d] = [taps.texel[0][i], taps.texel[1][i], taps.texel[2][i], taps.texel[3][i]].map(|t| t >> shift);
            ranges[i] = if (a == b) & (a == c) & (a == d) { a as u8 } else { SEVERAL };
        }
    }
}

/// Calls `visit` once for every range that a point reads in a level.
fn each_range(taps: &Taps, shift: u32, i: usize, mut visit: impl FnMut(usize)) {
    let mut seen = 0u64;
    for texel in &taps.texel {
        let range = texel[i] >> shift;
        if seen >> range & 1 == 0 {
            seen |= 1 << range;
            visit(range as usize);
        }
    }
}

/// Calls `visit(entry, range)` for what some points with a gradient read, in the points' order.
fn each_entry(s: &Source, shift: u32, points: Range<usize>, mut visit: impl FnMut(usize, usize)) {
    let (mut block, mut found, mut ranges) = (Points::EMPTY, Lookup::EMPTY, [[0; BLOCK]; 2]);
    for first in points.clone().step_by(BLOCK) {
        s.find(&mut block, &mut found, first..points.end);
        for l in 0..s.depth() {
            find_ranges(&found.taps[l], shift, &mut ranges[l]);
        }
        let n = s.texture.channels;
        for i in 0..block.len {
            // Pixels of the background, say.
            if s.d[(first + i) * n..(first + i + 1) * n].iter().all(|d| *d == 0.0) {
                continue;
            }
            for (l, ranges) in ranges.iter().enumerate().take(s.depth()) {
                let entry = (first + i) * s.depth() + l;
                match ranges[i] {
                    SEVERAL => each_range(&found.taps[l], shift, i, |range| visit(entry, range)),
                    range => visit(entry, range as usize),
                }
            }
        }
    }
}

impl Sorted {
    fn new(s: &Source, shift: u32, ranges: usize) -> Sorted {
        let total = s.coordinates.len() / s.texture.coordinates();
        let chunk = total.div_ceil(CHUNKS).max(CHUNK);
        let chunks = total.div_ceil(chunk);
        let of = |i: usize| i * chunk..((i + 1) * chunk).min(total);
        let mut counts = vec![0u32; chunks * ranges];
        let parts = Parts::new(&mut counts);
        tasks::run(chunks, total, |task| {
            // SAFETY: each task has a chunk of its own.
            let counts = unsafe { parts.chunk(task, ranges) };
            each_entry(s, shift, of(task), |_, range| counts[range] += 1);
        });
        let (mut offsets, mut sum) = (Vec::with_capacity(ranges + 1), 0u32);
        for range in 0..ranges {
            offsets.push(sum);
            for chunk in 0..chunks {
                let count = &mut counts[chunk * ranges + range];
                sum = sum.checked_add(*count).expect("texture: fewer than 2^32 texels that points read");
                *count = sum - *count;
            }
        }
        offsets.push(sum);
        let mut entries = vec![0u32; sum as usize];
        let (to, nexts) = (Parts::new(&mut entries), Parts::new(&mut counts));
        tasks::run(chunks, total, |task| {
            // SAFETY: each task has a chunk of its own.
            let next = unsafe { nexts.chunk(task, ranges) };
            each_entry(s, shift, of(task), |entry, range| {
                let at = next[range] as usize;
                next[range] += 1;
                // SAFETY: the counts give every chunk and range places of their own.
                unsafe { to.range(at..at + 1) }.fill(entry as u32);
            });
        });
        Sorted { offsets, entries }
    }
}

/// Gradient of the texels of all levels, overwritten; [`mips::backward`](super::mips::backward) adds them to the finest one.
///
/// # Shapes
/// coordinates `[P, 2]` or `[P, 3]`, level `[P]` or empty, d `[P, C]`, d_texels all levels.
///
/// # Panics
/// When shapes disagree.
pub fn backward_texels(t: &Texture, coordinates: &[f32], level: &[f32], d: &[f32], d_texels: &mut [f32]) {
    let total = coordinates.len() / t.coordinates();
    t.check(d_texels.len(), total, level.len(), d.len());
    assert!(total < u32::MAX as usize / 2, "texture: too many points");
    if t.channels == 0 {
        return;
    }
    let s = Source { texture: t, table: Table::new(t), coordinates, level, d, per_image: total / t.images.max(1) };
    let (texels, elements) = (d_texels.len() / t.channels, 8 * d.len());
    let tasks = partials::tasks_for(1, total, texels);
    if tasks >= 8 || texels <= LEAST {
        let share = total.div_ceil(tasks);
        return partials::scatter(1, tasks, elements, d_texels, |_, task, to| {
            let (mut points, mut found) = (Points::EMPTY, Lookup::EMPTY);
            let end = ((task + 1) * share).min(total);
            for first in (task * share..end).step_by(BLOCK) {
                s.find(&mut points, &mut found, first..end);
                s.add(&found, (first..first + points.len).map(|p| (p, 0..s.depth())), 0, to);
            }
        });
    }
    let size = texels.div_ceil(RANGES).max(LEAST).next_power_of_two();
    let ranges = texels.div_ceil(size);
    let sorted = Sorted::new(&s, size.trailing_zeros(), ranges);
    let parts = Parts::new(d_texels);
    tasks::run(ranges, elements, |range| {
        // SAFETY: each task has a chunk of its own.
        let to = unsafe { parts.chunk(range, size * t.channels) };
        to.fill(0.0);
        let (mut points, mut found) = (Points::EMPTY, Lookup::EMPTY);
        let depth = s.depth();
        for list in sorted.entries[sorted.offsets[range] as usize..sorted.offsets[range + 1] as usize].chunks(BLOCK) {
            let entries = || list.iter().map(|e| (*e as usize / depth, *e as usize % depth));
            s.find(&mut points, &mut found, entries().map(|e| e.0));
            s.add(&found, entries().map(|(p, l)| (p, l..l + 1)), (range * size) as u32, to);
        }
    });
}
