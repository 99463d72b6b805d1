//! Padded copies of input channels, split by stride, in which every tap of a kernel has a fixed offset.

use super::shapes::offset;
use crate::simd::Lane;
use crate::vector::by_lanes;
use std::ops::Range;

/// Layout of the padded channels of a band: `[channel, image, residue, row, column]`.
///
/// A tap reads input pixel `step · grid + d`. With `d − low = step · shift + residue`, the pixels of one residue form a
/// separate plane, in which neighbors on the grid are neighbors in memory, and the tap is a shift.
#[derive(Clone, Debug, Default)]
pub struct Planes {
    input: [usize; 2],
    step: [usize; 2],
    low: [isize; 2],
    reach: [usize; 2],
    residues: Vec<[usize; 2]>,
    rows_per_channel: usize,
    /// Input rows from the first tap of a cell to its last.
    span: usize,
    rows: usize,
    pub pitch: usize,
    plane: usize,
    /// Floats between images of a band.
    pub image: usize,
    /// Floats between channels.
    pub channel: usize,
}

/// Channels of a tensor that are copied: `data[image_stride · image + pixels · (first_channel + channel) ..]`.
#[derive(Clone, Copy)]
pub struct Source<'a> {
    pub data: &'a [f32],
    pub image_stride: usize,
    pub first_channel: usize,
}

impl Planes {
    /// Plans the planes for inputs of size `input`, taps at distances `taps`, and `step` input pixels per grid cell.
    pub fn update(&mut self, input: [usize; 2], step: [usize; 2], taps: impl Iterator<Item = [isize; 2]> + Clone) {
        (self.input, self.step) = (input, step);
        let first = taps.clone().next().unwrap_or([0; 2]);
        self.low = taps.clone().fold(first, |a, t| [a[0].min(t[0]), a[1].min(t[1])]);
        self.span = taps.clone().map(|t| (t[0] - self.low[0]) as usize + 1).max().unwrap_or(0);
        self.reach = [0; 2];
        self.residues.clear();
        let mut rows = Vec::new();
        for tap in taps {
            let (residue, shift) = self.split(tap);
            self.reach = [self.reach[0].max(shift[0]), self.reach[1].max(shift[1])];
            if !self.residues.contains(&residue) {
                self.residues.push(residue);
            }
            if !rows.contains(&(residue, shift[0])) {
                rows.push((residue, shift[0]));
            }
        }
        if self.residues.is_empty() {
            // Without taps nothing is read, but grid cells still need an offset.
            self.residues.push([0; 2]);
        }
        self.rows_per_channel = rows.len().max(1);
        self.residues.sort_unstable();
    }

    /// Sets the strides for bands of `images` and a grid of `rows` by `columns`.
    pub fn fit(&mut self, images: usize, rows: usize, columns: usize) {
        self.rows = rows;
        self.pitch = self.pitch_of(columns);
        self.plane = (rows + self.reach[0]) * self.pitch;
        self.image = self.plane * self.residues.len();
        // An odd number of cache lines, so that channels do not map to the same cache set.
        self.channel = (images * self.image).div_ceil(16) / 2 * 32 + 16;
    }

    /// Rows of a channel that the taps of one grid row read.
    pub fn rows_per_channel(&self) -> usize {
        self.rows_per_channel
    }

    /// Floats of a copy per row of a grid with `columns`.
    pub fn floats_per_row(&self, columns: usize) -> usize {
        self.pitch_of(columns) * self.residues.len().max(1)
    }

    /// Floats between rows of a plane, for a grid with `columns`.
    pub fn pitch_of(&self, columns: usize) -> usize {
        columns + self.reach[1]
    }

    /// Input rows that a grid's rows read.
    pub fn rows_of(&self, grid: Range<usize>) -> Range<usize> {
        let first = self.low[0] + (grid.start * self.step[0]) as isize;
        let end = self.low[0] + ((grid.end.max(1) - 1) * self.step[0] + self.span) as isize;
        let clip = |row: isize| row.clamp(0, self.input[0] as isize) as usize;
        clip(first)..clip(end).max(clip(first))
    }

    fn split(&self, tap: [isize; 2]) -> ([usize; 2], [usize; 2]) {
        let d = [(tap[0] - self.low[0]) as usize, (tap[1] - self.low[1]) as usize];
        ([d[0] % self.step[0], d[1] % self.step[1]], [d[0] / self.step[0], d[1] / self.step[1]])
    }

    /// Offset of a tap from a grid cell's position in the first plane.
    pub fn offset(&self, tap: [isize; 2]) -> usize {
        let (residue, shift) = self.split(tap);
        let plane = self.residues.iter().position(|r| *r == residue).unwrap_or(0);
        plane * self.plane + shift[0] * self.pitch + shift[1]
    }

    /// Lists the rows (offset in a channel, offset in its copy) that rows of the grid read, and returns their length; the caller zeroes
    /// all other floats. Neighboring columns of the input are neighbors in the copy.
    pub fn list_rows(&self, grid: Range<usize>, out: &mut Vec<(u32, u32)>) -> usize {
        assert_eq!(self.step[1], 1, "rows are copied as they are");
        let [height, width] = self.input;
        let (begin, skipped) = ((-self.low[1]).max(0) as usize, self.low[1].max(0) as usize);
        let len = width.saturating_sub(skipped).min(self.pitch.saturating_sub(begin));
        out.clear();
        for d in 0..(grid.len().max(1) - 1) * self.step[0] + self.span {
            let y = self.low[0] + (grid.start * self.step[0] + d) as isize;
            let plane = self.residues.iter().position(|r| r[0] == d % self.step[0]);
            if let (0.., Some(plane)) = (y, plane)
                && len > 0
                && (y as usize) < height
            {
                let to = plane * self.plane + d / self.step[0] * self.pitch + begin;
                out.push((offset(y as usize * width + skipped), offset(to)));
            }
        }
        len
    }

    /// Copies `channels` of some images into `out`, with the rows that a grid beginning at `first_row` reads.
    pub fn fill(&self, source: Source, channels: Range<usize>, images: Range<usize>, first_row: usize, out: &mut [f32]) {
        let pixels = self.input[0] * self.input[1];
        for (c, channel) in channels.enumerate() {
            for (i, image) in images.clone().enumerate() {
                let at = image * source.image_stride + (source.first_channel + channel) * pixels;
                let from = &source.data[at..at + pixels];
                let at = c * self.channel + i * self.image;
                let to = &mut out[at..at + self.image];
                if self.plane > 0 {
                    for (plane, residue) in to.chunks_exact_mut(self.plane).zip(&self.residues) {
                        // SAFETY: the slices have the sizes given by `self`.
                        unsafe { fill_plane(self, from, *residue, first_row, plane) };
                    }
                }
            }
        }
    }
}

by_lanes! {
    /// Copies the pixels of one residue.
    ///
    /// # Safety
    /// `from` holds one channel of an image, `plane` whole rows of `p.pitch`.
    unsafe fn fill_plane<L>(p: &Planes, from: &[f32], residue: [usize; 2], first_row: usize, plane: &mut [f32]) {
        let [height, width] = p.input;
        let start = p.low[1] + residue[1] as isize;
        // Columns t with 0 ≤ start + step t < width.
        let step = p.step[1] as isize;
        let begin = (-start).max(0).div_ceil_by(step).min(p.pitch);
        let end = (width as isize - start).max(0).div_ceil_by(step).clamp(begin, p.pitch);
        for (t, row) in plane.chunks_exact_mut(p.pitch).enumerate() {
            let y = p.low[0] + (residue[0] + (first_row + t) * p.step[0]) as isize;
            if y < 0 || y >= height as isize || begin == end {
                row.fill(0.0);
                continue;
            }
            row[..begin].iter_mut().for_each(|v| *v = 0.0);
            row[end..].iter_mut().for_each(|v| *v = 0.0);
            let x = (start + begin as isize * step) as usize;
            let from = &from[y as usize * width + x..(y as usize + 1) * width];
            let row = &mut row[begin..end];
            match p.step[1] {
                1 => row.copy_from_slice(&from[..row.len()]),
                2 => every_second::<L>(from[..2 * row.len() - 1].as_ptr(), row.as_mut_ptr(), row.len()),
                step => row.iter_mut().enumerate().for_each(|(i, o)| *o = from[i * step]),
            }
        }
    }
}

by_lanes! {
    /// Copies rows of `len` floats, each from the first to the second of its offsets.
    ///
    /// # Safety
    /// All rows exist on both sides.
    pub unsafe fn copy_rows<L>(from: *const f32, rows: &[(u32, u32)], len: usize, to: *mut f32) {
        for &(source, target) in rows {
            let (from, to) = (from.add(source as usize), to.add(target as usize));
            let mut i = 0;
            while i + L::N <= len {
                L::store(to.add(i), L::load(from.add(i)));
                i += L::N;
            }
            if i < len && len >= L::N {
                L::store(to.add(len - L::N), L::load(from.add(len - L::N)));
                continue;
            }
            while i < len {
                *to.add(i) = *from.add(i);
                i += 1;
            }
        }
    }
}

/// `to[i] = from[2 i]`
///
/// # Safety
/// `from` has `2 count − 1` floats, `to` has `count`.
#[inline(always)]
unsafe fn every_second<L: Lane>(from: *const f32, to: *mut f32, count: usize) {
    // SAFETY: guaranteed by the caller.
    unsafe {
        let mut i = 0;
        while i + L::N < count {
            L::store(to.add(i), L::load_pairs(from.add(2 * i)).0);
            i += L::N;
        }
        if i > 0 {
            // The float after the last one does not exist, so the last vector is loaded one float earlier and takes the odd floats.
            i = count - L::N;
            return L::store(to.add(i), L::load_pairs(from.add(2 * i - 1)).1);
        }
        for i in 0..count {
            *to.add(i) = *from.add(2 * i);
        }
    }
}

trait DivCeilBy {
    fn div_ceil_by(self, by: isize) -> usize;
}

impl DivCeilBy for isize {
    fn div_ceil_by(self, by: isize) -> usize {
        ((self + by - 1) / by) as usize
    }
}
