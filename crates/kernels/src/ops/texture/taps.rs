//! The texels that points read, found for a block of points at a time.

use super::{FACES, Filter, Kind, Level, Texture, dot, face_of};
use crate::math::multiversion;

/// Points of a block.
pub(super) const BLOCK: usize = 256;
/// No texel is missing.
const NONE: u8 = 4;

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
    pub const EMPTY: Lookup = Lookup { taps: [Taps::EMPTY, Taps::EMPTY], share: [0.0; BLOCK], free: [0.0; BLOCK] };

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

#[inline(always)]
fn flat(repeat: bool, nearest: bool, level: &Level, points: &Points, i: usize, taps: &mut Taps) {
    let [h, w] = level.size;
    let (x0, x1, x, slope_x) = along(repeat, nearest, w as f32, points.coordinates[0][i]);
    let (y0, y1, y, slope_y) = along(repeat, nearest, h as f32, points.coordinates[1][i]);
    let first = level.first as u32 + points.image[i] * (h * w) as u32;
    let (upper, lower) = (first + y0 * w as u32, first + y1 * w as u32);
    taps.texel[0][i] = upper + x0;
    taps.texel[1][i] = upper + x1;
    taps.texel[2][i] = lower + x0;
    taps.texel[3][i] = lower + x1;
    (taps.between[0][i], taps.between[1][i]) = (x, y);
    (taps.slope[0][i], taps.slope[1][i]) = (slope_x, slope_y);
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

fn cube(nearest: bool, level: &Level, points: &Points, i: usize, taps: &mut Taps) {
    let d = std::array::from_fn(|k| points.coordinates[k][i]);
    let (face, n) = (face_of(d), level.size[0] as i32);
    let [major, s, t] = FACES[face];
    // A direction that is no number, or has no length, reads some texel.
    let place = |axis| within((dot(d, axis) / dot(d, major) + 1.0) * 0.5, 1.0) * n as f32 - 0.5;
    let (x, y) = (place(s), place(t));
    let first = level.first + points.image[i] as usize * 6 * (n * n) as usize;
    taps.missing[i] = NONE;
    if nearest {
        let at = |v: f32| ((v + 0.5) as i32).min(n - 1);
        let texel = first + ((face as i32 * n + at(y)) * n + at(x)) as usize;
        (0..4).for_each(|k| taps.texel[k][i] = texel as u32);
        (0..2).for_each(|k| (taps.between[k][i], taps.slope[k][i]) = (0.0, 0.0));
        return;
    }
    let (x0, y0) = (x.floor(), y.floor());
    for k in 0..4 {
        let texel = around(face, x0 as i32 + (k & 1), y0 as i32 + (k >> 1), n);
        if texel.is_none() {
            taps.missing[i] = k as u8;
        }
        taps.texel[k as usize][i] = (first + texel.unwrap_or(0)) as u32;
    }
    (taps.between[0][i], taps.between[1][i]) = (x - x0, y - y0);
    (0..2).for_each(|k| taps.slope[k][i] = n as f32);
}

multiversion! {
    /// Texels of flat textures in one level.
    fn find_flat(repeat: bool, nearest: bool, level: &Level, points: &Points, taps: &mut Taps) {
        // A loop of its own for every mode.
        match (repeat, nearest) {
            (true, true) => (0..points.len.min(BLOCK)).for_each(|i| flat(true, true, level, points, i, taps)),
            (true, false) => (0..points.len.min(BLOCK)).for_each(|i| flat(true, false, level, points, i, taps)),
            (false, true) => (0..points.len.min(BLOCK)).for_each(|i| flat(false, true, level, points, i, taps)),
            (false, false) => (0..points.len.min(BLOCK)).for_each(|i| flat(false, false, level, points, i, taps)),
        }
    }
}

multiversion! {
    /// Texels of flat textures in the two levels around that of each point.
    fn find_levels(repeat: bool, levels: &[Level], points: &Points, found: &mut Lookup) {
        let most = levels.len() - 1;
        for i in 0..points.len.min(BLOCK) {
            let low = found.share[i];
            // SAFETY: `find` leaves a level's number there.
            let first = (unsafe { integer(low.floor()) } as usize).min(most);
            flat(repeat, false, &levels[first], points, i, &mut found.taps[0]);
            flat(repeat, false, &levels[(first + 1).min(most)], points, i, &mut found.taps[1]);
            found.share[i] = low - first as f32;
        }
    }
}

/// Finds what points read.
pub(super) fn find(t: &Texture, levels: &[Level], points: &Points, found: &mut Lookup) {
    let (nearest, repeat) = (t.filter == Filter::Nearest, t.kind == Kind::Repeat);
    if t.filter == Filter::Trilinear {
        let most = (levels.len() - 1) as f32;
        for i in 0..points.len {
            let level = points.level[i];
            found.share[i] = within(level, most);
            found.free[i] = if level > 0.0 && level < most { 1.0 } else { 0.0 };
        }
    }
    match (t.kind, t.filter) {
        (Kind::Cube, Filter::Trilinear) => {
            for i in 0..points.len {
                let first = found.share[i] as usize;
                cube(false, &levels[first], points, i, &mut found.taps[0]);
                cube(false, &levels[(first + 1).min(levels.len() - 1)], points, i, &mut found.taps[1]);
                found.share[i] -= first as f32;
            }
        }
        (Kind::Cube, _) => (0..points.len).for_each(|i| cube(nearest, &levels[0], points, i, &mut found.taps[0])),
        (_, Filter::Trilinear) => find_levels(repeat, levels, points, found),
        _ => find_flat(repeat, nearest, &levels[0], points, &mut found.taps[0]),
    }
}
