//! The texels that points read, found for a block of points at a time.

use super::{FACES, Filter, Kind, Texture, dot, face_of};
use crate::math::multiversion;

/// Points of a block.
pub(super) const BLOCK: usize = 256;
/// No texel is missing.
const NONE: u8 = 4;
/// A point at the edge of a cube's face, whose texels are still to be found.
const AT_EDGE: u8 = 5;
/// Levels at most, a power of two.
const LEVELS: usize = 16;

/// Points of a block, by coordinate.
pub(super) struct Points {
    pub len: usize,
    pub coordinates: [[f32; BLOCK]; 3],
    pub level: [f32; BLOCK],
    pub image: [u32; BLOCK],
}

/// Four texels around each point, in one level: (x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1).
pub(super) struct Taps {
    pub texel: [[u32; BLOCK]; 4],
    /// Places between the texels, in 0..1.
    pub between: [[f32; BLOCK]; 2],
    /// Texels per unit of s and t; 0 where these have no effect.
    pub slope: [[f32; BLOCK]; 2],
    /// Which of the texels is missing at a cube's corner.
    missing: [u8; BLOCK],
}

/// What a block reads: one level, or two and the second one's share.
pub(super) struct Lookup {
    pub taps: [Taps; 2],
    pub share: [f32; BLOCK],
    /// 1 where the level is between two, else 0.
    pub free: [f32; BLOCK],
    /// The finer one of the levels.
    first: [u32; BLOCK],
}

impl Points {
    pub const EMPTY: Points = Points { len: 0, coordinates: [[0.0; BLOCK]; 3], level: [0.0; BLOCK], image: [0; BLOCK] };

    /// Reads points, `BLOCK` at most, of `per_image` points for each image.
    #[inline(always)]
    pub fn read(&mut self, t: &Texture, coordinates: &[f32], level: &[f32], per_image: usize, points: impl Iterator<Item = usize>) {
        let n = t.coordinates();
        self.len = 0;
        for (i, p) in points.take(BLOCK).enumerate() {
            (0..n).for_each(|k| self.coordinates[k][i] = coordinates[n * p + k]);
            if t.filter == Filter::Trilinear {
                self.level[i] = level[p];
            }
            self.image[i] = if t.images == 1 { 0 } else { (p / per_image) as u32 };
            self.len = i + 1;
        }
    }
}

impl Taps {
    const EMPTY: Taps = Taps { texel: [[0; BLOCK]; 4], between: [[0.0; BLOCK]; 2], slope: [[0.0; BLOCK]; 2], missing: [NONE; BLOCK] };

    #[inline(always)]
    pub fn weights(&self, i: usize) -> [f32; 4] {
        let (x, y) = (self.between[0][i], self.between[1][i]);
        let mut weights = [(1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y];
        if self.missing[i] != NONE {
            let missing = std::mem::take(&mut weights[self.missing[i] as usize]);
            (0..4).filter(|k| *k != self.missing[i] as usize).for_each(|k| weights[k] += missing / 3.0);
        }
        weights
    }

    /// Puts the mean of the others in the place of a missing texel's value.
    #[inline(always)]
    pub fn complete(&self, i: usize, values: &mut [f32; 4]) {
        if self.missing[i] != NONE {
            let missing = self.missing[i] as usize;
            values[missing] = 0.0;
            values[missing] = values.iter().sum::<f32>() / 3.0;
        }
    }
}

impl Lookup {
    pub const EMPTY: Lookup = Lookup { taps: [Taps::EMPTY, Taps::EMPTY], share: [0.0; BLOCK], free: [0.0; BLOCK], first: [0; BLOCK] };

    /// The levels that are read.
    pub fn taps(&self, t: &Texture) -> &[Taps] {
        if t.filter == Filter::Trilinear { &self.taps } else { &self.taps[..1] }
    }

    /// Share of a level, of 2 or 1.
    #[inline(always)]
    pub fn share(&self, level: usize, i: usize) -> f32 {
        if level == 0 { 1.0 - self.share[i] } else { self.share[i] }
    }
}

/// `x` in `0..=most`, and 0 for what is no number.
#[inline(always)]
fn within(x: f32, most: f32) -> f32 {
    let x = if x > 0.0 { x } else { 0.0 };
    if x < most { x } else { most }
}

/// `x` as an integer.
///
/// # Safety
/// It must be one that 31 bits hold.
#[inline(always)]
unsafe fn integer(x: f32) -> u32 {
    // SAFETY: the caller's promise.
    unsafe { x.to_int_unchecked::<i32>() as u32 }
}

/// The two texels around a coordinate along an axis of `n`, the place between them, and the slope of that.
#[inline(always)]
fn along(repeat: bool, nearest: bool, n: f32, c: f32) -> (u32, u32, f32, f32) {
    let c = if repeat { within(c - c.floor(), 1.0) } else { c };
    let x = c * n - 0.5;
    let (low, high, between, slope) = if nearest {
        let x = within((x + 0.5).floor(), n - 1.0);
        (x, x, 0.0, 0.0)
    } else if repeat {
        let low = x.floor();
        let high = if low + 1.0 >= n { 0.0 } else { low + 1.0 };
        (if low < 0.0 { n - 1.0 } else { low }, high, x - low, n)
    } else {
        let inside = within(x, n - 1.0);
        let low = inside.floor();
        (low, if low + 1.0 < n { low + 1.0 } else { low }, inside - low, if inside == x { n } else { 0.0 })
    };
    // SAFETY: within 0..n for sizes up to 2¹⁵, also for what is no number.
    unsafe { (integer(low), integer(high), between, slope) }
}

/// Sizes of levels and the texels before them, by level.
pub(super) struct Table {
    width: [f32; LEVELS],
    height: [f32; LEVELS],
    first: [u32; LEVELS],
    len: usize,
}

impl Table {
    pub fn new(t: &Texture) -> Table {
        let mut table = Table { width: [0.0; LEVELS], height: [0.0; LEVELS], first: [0; LEVELS], len: 0 };
        for (l, level) in t.levels().iter().enumerate() {
            (table.height[l], table.width[l]) = (level.size[0] as f32, level.size[1] as f32);
            (table.first[l], table.len) = (level.first as u32, l + 1);
        }
        table
    }
}

#[inline(always)]
fn flat(repeat: bool, nearest: bool, table: &Table, l: usize, points: &Points, i: usize, taps: &mut Taps) {
    let (w, h) = (table.width[l % LEVELS], table.height[l % LEVELS]);
    let (x0, x1, x, slope_x) = along(repeat, nearest, w, points.coordinates[0][i]);
    let (y0, y1, y, slope_y) = along(repeat, nearest, h, points.coordinates[1][i]);
    // SAFETY: sizes of levels.
    let (width, height) = unsafe { (integer(w), integer(h)) };
    let first = table.first[l % LEVELS].wrapping_add(points.image[i].wrapping_mul(width.wrapping_mul(height)));
    let (upper, lower) = (first.wrapping_add(y0.wrapping_mul(width)), first.wrapping_add(y1.wrapping_mul(width)));
    taps.texel[0][i] = upper.wrapping_add(x0);
    taps.texel[1][i] = upper.wrapping_add(x1);
    taps.texel[2][i] = lower.wrapping_add(x0);
    taps.texel[3][i] = lower.wrapping_add(x1);
    (taps.between[0][i], taps.between[1][i]) = (x, y);
    (taps.slope[0][i], taps.slope[1][i]) = (slope_x, slope_y);
}

/// Face of a direction, and its place there in 0..=1 along s and t; the first face's center for a direction without length.
#[inline(always)]
fn on_face(d: [f32; 3]) -> (u32, f32, f32) {
    let size = d.map(f32::abs);
    let is_x = (size[0] >= size[1]) & (size[0] >= size[2]);
    let is_y = !is_x & (size[1] >= size[2]);
    let major = if is_x {
        d[0]
    } else if is_y {
        d[1]
    } else {
        d[2]
    };
    let sign = if major < 0.0 { -1.0 } else { 1.0 };
    let s = if is_x {
        -sign * d[2]
    } else if is_y {
        d[0]
    } else {
        sign * d[0]
    };
    let t = if is_y { sign * d[2] } else { -d[1] };
    let inverse = if major.abs() > 0.0 { 0.5 / major.abs() } else { 0.0 };
    let axis = if is_x {
        0
    } else if is_y {
        2
    } else {
        4
    };
    (axis + (major < 0.0) as u32, within(s * inverse + 0.5, 1.0), within(t * inverse + 0.5, 1.0))
}

/// Finds the texels of a point within a face; those of a point at its edge are wrong, and marked.
#[inline(always)]
fn cube(nearest: bool, table: &Table, l: usize, points: &Points, i: usize, taps: &mut Taps) {
    let (face, s, t) = on_face([points.coordinates[0][i], points.coordinates[1][i], points.coordinates[2][i]]);
    let n = table.width[l % LEVELS];
    let (x, y) = (s * n - 0.5, t * n - 0.5);
    let half = if nearest { 0.5 } else { 0.0 };
    let (x0, y0) = ((x + half).floor(), (y + half).floor());
    let is_within = (x0 >= 0.0) & (y0 >= 0.0) & (x0 + 1.0 < n) & (y0 + 1.0 < n);
    // SAFETY: within 0..n.
    let (column, row, width) = unsafe { (integer(within(x0, n - 1.0)), integer(within(y0, n - 1.0)), integer(n)) };
    let faces = points.image[i].wrapping_mul(6).wrapping_add(face).wrapping_mul(width.wrapping_mul(width));
    let texel = table.first[l % LEVELS].wrapping_add(faces).wrapping_add(row.wrapping_mul(width)).wrapping_add(column);
    let (right, below) = if nearest { (0, 0) } else { (1, width) };
    taps.texel[0][i] = texel;
    taps.texel[1][i] = texel.wrapping_add(right);
    taps.texel[2][i] = texel.wrapping_add(below);
    taps.texel[3][i] = texel.wrapping_add(below).wrapping_add(right);
    let kept = if nearest { 0.0 } else { 1.0 };
    (taps.between[0][i], taps.between[1][i]) = ((x - x0) * kept, (y - y0) * kept);
    (taps.slope[0][i], taps.slope[1][i]) = (n * kept, n * kept);
    taps.missing[i] = if is_within | nearest { NONE } else { AT_EDGE };
}

/// Finds the texels of the points that are marked, whose levels `of` tells.
fn find_edges(table: &Table, points: &Points, taps: &mut Taps, of: impl Fn(usize) -> usize) {
    for i in 0..points.len {
        if taps.missing[i] != AT_EDGE {
            continue;
        }
        let (face, s, t) = on_face(std::array::from_fn(|k| points.coordinates[k][i]));
        let (l, size) = (of(i), table.width[of(i)]);
        let (n, [x0, y0]) = (size as i32, [s, t].map(|v| (v * size - 0.5).floor() as i32));
        let first = table.first[l] as usize + (points.image[i] as usize * 6) * (n * n) as usize;
        taps.missing[i] = NONE;
        for k in 0..4 {
            let texel = around(face as usize, x0 + (k & 1), y0 + (k >> 1), n);
            if texel.is_none() {
                taps.missing[i] = k as u8;
            }
            taps.texel[k as usize][i] = (first + texel.unwrap_or(0)) as u32;
        }
    }
}

/// Texel of a face, or of the face next to it where x or y is just outside; `None` where both are.
fn around(face: usize, x: i32, y: i32, n: i32) -> Option<usize> {
    let inside = |v: i32| (0..n).contains(&v);
    let (face, x, y) = match (inside(x), inside(y)) {
        (true, true) => (face, x, y),
        (false, false) => return None,
        _ => {
            let center = |v: i32| (2 * v + 1) as f32 / n as f32 - 1.0;
            let [major, s, t] = FACES[face];
            let d = std::array::from_fn(|k| major[k] + center(x) * s[k] + center(y) * t[k]);
            let next = face_of(d);
            let [major, s, t] = FACES[next];
            let place = |axis: [f32; 3]| (((dot(d, axis) / dot(d, major) + 1.0) * 0.5 * n as f32) as i32).clamp(0, n - 1);
            (next, place(s), place(t))
        }
    };
    Some(((face as i32 * n + y) * n + x) as usize)
}

multiversion! {
    /// Texels in the finest level; those at edges of a cube's faces are marked.
    fn find_finest(is_cube: bool, repeat: bool, nearest: bool, table: &Table, points: &Points, taps: &mut Taps) {
        let n = points.len.min(BLOCK);
        // A loop of its own for every mode, not a closure's: that would be compiled without the instruction set.
        match (is_cube, repeat, nearest) {
            (true, _, true) => {
                for i in 0..n {
                    cube(true, table, 0, points, i, taps);
                }
            }
            (true, _, false) => {
                for i in 0..n {
                    cube(false, table, 0, points, i, taps);
                }
            }
            (_, true, true) => {
                for i in 0..n {
                    flat(true, true, table, 0, points, i, taps);
                }
            }
            (_, true, false) => {
                for i in 0..n {
                    flat(true, false, table, 0, points, i, taps);
                }
            }
            (_, false, true) => {
                for i in 0..n {
                    flat(false, true, table, 0, points, i, taps);
                }
            }
            (_, false, false) => {
                for i in 0..n {
                    flat(false, false, table, 0, points, i, taps);
                }
            }
        }
    }
}

multiversion! {
    /// Texels in the two levels around that of each point; those at edges of a cube's faces are marked.
    fn find_levels(is_cube: bool, repeat: bool, table: &Table, points: &Points, found: &mut Lookup) {
        let most = (table.len - 1) as u32;
        let [finer, coarser] = &mut found.taps;
        for i in 0..points.len.min(BLOCK) {
            let level = points.level[i];
            let low = within(level, most as f32);
            found.free[i] = if (level > 0.0) & (level < most as f32) { 1.0 } else { 0.0 };
            found.share[i] = low - low.floor();
            // SAFETY: one of the levels.
            found.first[i] = unsafe { integer(low.floor()) };
        }
        let (n, first) = (points.len.min(BLOCK), &found.first);
        let next = |i: usize| (first[i] + 1).min(most) as usize;
        match (is_cube, repeat) {
            (true, _) => {
                for i in 0..n {
                    cube(false, table, first[i] as usize, points, i, finer);
                }
                for i in 0..n {
                    cube(false, table, next(i), points, i, coarser);
                }
            }
            (false, true) => {
                for i in 0..n {
                    flat(true, false, table, first[i] as usize, points, i, finer);
                }
                for i in 0..n {
                    flat(true, false, table, next(i), points, i, coarser);
                }
            }
            (false, false) => {
                for i in 0..n {
                    flat(false, false, table, first[i] as usize, points, i, finer);
                }
                for i in 0..n {
                    flat(false, false, table, next(i), points, i, coarser);
                }
            }
        }
    }
}

/// Finds what points read.
pub(super) fn find(t: &Texture, table: &Table, points: &Points, found: &mut Lookup) {
    let (is_cube, repeat, nearest) = (t.kind == Kind::Cube, t.kind == Kind::Repeat, t.filter == Filter::Nearest);
    if t.filter == Filter::Trilinear {
        find_levels(is_cube, repeat, table, points, found);
    } else {
        find_finest(is_cube, repeat, nearest, table, points, &mut found.taps[0]);
    }
    if is_cube {
        let Lookup { taps: [finer, coarser], first, .. } = found;
        find_edges(table, points, finer, |i| first[i] as usize);
        if t.filter == Filter::Trilinear {
            find_edges(table, points, coarser, |i| (first[i] as usize + 1).min(table.len - 1));
        }
    }
}
