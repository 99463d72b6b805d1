//! Gradient of texels. Small textures are summed up by tasks in copies of their own. For large ones, points are sorted by the ranges of
//! texels that they read (counts, prefix sum, fill), and each range adds up its points in their order.

use super::taps::{BLOCK, Lookup, Points, find};
use super::{Level, Texture};
use crate::partials;
use crate::tasks::{self, Parts};

/// Ranges of texels at most.
const RANGES: usize = 64;
/// Texels of a range at least.
const LEAST: usize = 1024;
/// Points per chunk at least, and chunks at most.
const CHUNK: usize = 4096;
const CHUNKS: usize = 64;

/// What points read and what they pass back.
struct Source<'a> {
    texture: &'a Texture,
    levels: Vec<Level>,
    coordinates: &'a [f32],
    level: &'a [f32],
    d: &'a [f32],
    per_image: usize,
}

impl Source<'_> {
    /// Finds what up to [`BLOCK`] points read.
    fn find(&self, points: &mut Points, found: &mut Lookup, of: impl Iterator<Item = usize>) {
        points.read(self.texture, self.coordinates, self.level, self.per_image, of);
        find(self.texture, &self.levels, points, found);
    }

    /// Adds the gradients of a block's points, whose number `i` is point `of(i)`, to the texels from `first` on that `to` holds.
    fn add(&self, points: &Points, found: &Lookup, of: impl Fn(usize) -> usize, first: u32, to: &mut [f32]) {
        match self.texture.channels {
            1 => self.add_channels::<1>(points, found, of, first, to),
            2 => self.add_channels::<2>(points, found, of, first, to),
            3 => self.add_channels::<3>(points, found, of, first, to),
            4 => self.add_channels::<4>(points, found, of, first, to),
            _ => self.add_channels::<0>(points, found, of, first, to),
        }
    }

    /// `C` channels, or if that is 0 any number of them.
    #[inline(always)]
    fn add_channels<const C: usize>(&self, points: &Points, found: &Lookup, of: impl Fn(usize) -> usize, first: u32, to: &mut [f32]) {
        let n = if C == 0 { self.texture.channels } else { C };
        for i in 0..points.len {
            let p = of(i);
            let d = &self.d[p * n..(p + 1) * n];
            for (l, taps) in found.taps(self.texture).iter().enumerate() {
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
}

/// Points by the ranges of texels that they read.
struct Sorted {
    /// Where each range's points begin, `[ranges + 1]`.
    offsets: Vec<u32>,
    points: Vec<u32>,
}

/// Calls `visit(point, range)` once for every range that a point of some reads, of ranges of `2^shift` texels.
fn each_range(s: &Source, shift: u32, points: std::ops::Range<usize>, mut visit: impl FnMut(usize, usize)) {
    let (mut block, mut found) = (Points::EMPTY, Lookup::EMPTY);
    for first in points.clone().step_by(BLOCK) {
        s.find(&mut block, &mut found, first..points.end);
        for i in 0..block.len {
            let mut seen = [u32::MAX; 8];
            for (l, taps) in found.taps(s.texture).iter().enumerate() {
                for k in 0..4 {
                    let range = taps.texel[k][i] >> shift;
                    if !seen.contains(&range) {
                        seen[4 * l + k] = range;
                        visit(first + i, range as usize);
                    }
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
            each_range(s, shift, of(task), |_, range| counts[range] += 1);
        });
        let (mut offsets, mut sum) = (Vec::with_capacity(ranges + 1), 0u32);
        for range in 0..ranges {
            offsets.push(sum);
            for chunk in 0..chunks {
                let count = &mut counts[chunk * ranges + range];
                sum = sum.checked_add(*count).expect("texture: fewer than 2^32 points");
                *count = sum - *count;
            }
        }
        offsets.push(sum);
        let mut points = vec![0u32; sum as usize];
        let (to, nexts) = (Parts::new(&mut points), Parts::new(&mut counts));
        tasks::run(chunks, total, |task| {
            // SAFETY: each task has a chunk of its own.
            let next = unsafe { nexts.chunk(task, ranges) };
            each_range(s, shift, of(task), |point, range| {
                let at = next[range] as usize;
                next[range] += 1;
                // SAFETY: the counts give every chunk and range places of their own.
                unsafe { to.range(at..at + 1) }.fill(point as u32);
            });
        });
        Sorted { offsets, points }
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
    assert!(total < u32::MAX as usize, "texture: too many points");
    if t.channels == 0 {
        return;
    }
    let s = Source { texture: t, levels: t.levels(), coordinates, level, d, per_image: total / t.images.max(1) };
    let (texels, elements) = (d_texels.len() / t.channels, 8 * d.len());
    let tasks = partials::tasks_for(1, total, texels);
    if tasks >= 8 || texels <= LEAST {
        let share = total.div_ceil(tasks);
        return partials::scatter(1, tasks, elements, d_texels, |_, task, to| {
            let (mut points, mut found) = (Points::EMPTY, Lookup::EMPTY);
            let end = ((task + 1) * share).min(total);
            for first in (task * share..end).step_by(BLOCK) {
                s.find(&mut points, &mut found, first..end);
                s.add(&points, &found, |i| first + i, 0, to);
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
        for list in sorted.points[sorted.offsets[range] as usize..sorted.offsets[range + 1] as usize].chunks(BLOCK) {
            s.find(&mut points, &mut found, list.iter().map(|p| *p as usize));
            s.add(&points, &found, |i| list[i] as usize, (range * size) as u32, to);
        }
    });
}
