//! Blocks of points: texels are found first, a few instructions for many points, and then read.

use super::taps::{BLOCK, Lookup, Points, Table, Taps, find};
use super::{FACES, Filter, Kind, Texture, dot, face_of};
use crate::tasks::{self, Parts};
use crate::vector::{fma, vectorized};

pub use super::scatter::backward_texels;

/// Blocks per task.
const BLOCKS: usize = 8;
/// Channels at a time, at most.
const WIDTH: usize = 4;

#[inline(always)]
fn blend<const F: bool, const C: usize>(taps: &Taps, texels: &[f32], n: usize, first: usize, out: &mut [f32]) {
    for (i, out) in out.chunks_exact_mut(n).enumerate().take(BLOCK) {
        let weights = taps.weights(i);
        let mut sum = [0.0f32; C];
        for (taps, weight) in taps.texel.iter().zip(weights) {
            // SAFETY: `find` names texels of the levels alone, whose size `check` compared.
            let texel = unsafe { texels.get_unchecked(taps[i] as usize * n + first..taps[i] as usize * n + first + C) };
            (0..C).for_each(|c| sum[c] = fma::<F>(weight, texel[c], sum[c]));
        }
        out[first..first + C].copy_from_slice(&sum);
    }
}

/// Adds `d · texel` of each of the four texels to `dots`.
#[inline(always)]
fn correlate<const F: bool, const C: usize>(taps: &Taps, texels: &[f32], n: usize, first: usize, d: &[f32], dots: &mut [[f32; 4]; BLOCK]) {
    for ((i, d), dots) in d.chunks_exact(n).enumerate().zip(dots) {
        let d = &d[first..first + C];
        for k in 0..4 {
            let at = taps.texel[k][i] as usize * n + first;
            // SAFETY: as in `blend`.
            let texel = unsafe { texels.get_unchecked(at..at + C) };
            (0..C).for_each(|c| dots[k] = fma::<F>(d[c], texel[c], dots[k]));
        }
    }
}

/// Calls a function that is generic over the number of channels for all of them.
macro_rules! by_width {
    ($n:ident, $first:ident, $f:ident($($arg:expr),*)) => {
        let mut $first = 0;
        while $first < $n {
            let width = ($n - $first).min(WIDTH);
            match width {
                1 => $f::<F, 1>($($arg),*),
                2 => $f::<F, 2>($($arg),*),
                3 => $f::<F, 3>($($arg),*),
                _ => $f::<F, 4>($($arg),*),
            }
            $first += width;
        }
    };
}

vectorized! {
    fn blend_all<const F>(taps: &Taps, texels: &[f32], n: usize, out: &mut [f32]) {
        by_width!(n, first, blend(taps, texels, n, first, out));
    }
}

vectorized! {
    fn correlate_all<const F>(taps: &Taps, texels: &[f32], n: usize, d: &[f32], dots: &mut [[f32; 4]; BLOCK]) {
        by_width!(n, first, correlate(taps, texels, n, first, d, dots));
    }
}

/// Calls `work(range of points, what they read)` for blocks of points, in parallel.
fn by_points(t: &Texture, coordinates: &[f32], level: &[f32], work: impl Fn(std::ops::Range<usize>, &Points, &Lookup) + Sync) {
    let (table, total) = (Table::new(t), coordinates.len() / t.coordinates());
    let per_task = BLOCK * BLOCKS;
    tasks::run(total.div_ceil(per_task), total * t.channels * 8, |task| {
        let (mut points, mut found) = (Points::EMPTY, Lookup::EMPTY);
        for first in (task * per_task..((task + 1) * per_task).min(total)).step_by(BLOCK) {
            let range = first..(first + BLOCK).min(total);
            points.read(t, coordinates, level, total / t.images.max(1), range.clone());
            find(t, &table, &points, &mut found);
            work(range, &points, &found);
        }
    });
}

/// Values of a texture at points.
///
/// # Shapes
/// texels: all levels that the filter reads ([`Texture::levels`]); coordinates `[P, 2]`, or directions `[P, 3]` for cube maps; level `[P]` for
/// [`Filter::Trilinear`], clamped to those there are, else empty; out `[P, C]`.
///
/// # Panics
/// When shapes disagree.
pub fn forward(t: &Texture, texels: &[f32], coordinates: &[f32], level: &[f32], out: &mut [f32]) {
    t.check(texels.len(), coordinates.len() / t.coordinates(), level.len(), out.len());
    let (n, parts) = (t.channels, Parts::new(out));
    if n == 0 {
        return;
    }
    by_points(t, coordinates, level, |range, _, found| {
        // SAFETY: each task has points of its own.
        let out = unsafe { parts.range(range.start * n..range.end * n) };
        blend_all(&found.taps[0], texels, n, out);
        if t.filter == Filter::Trilinear {
            tasks::with_buffer(out.len(), |coarser| {
                blend_all(&found.taps[1], texels, n, coarser);
                for ((i, out), coarser) in out.chunks_exact_mut(n).enumerate().zip(coarser.chunks_exact(n)) {
                    out.iter_mut().zip(coarser).for_each(|(o, c)| *o += found.share[i] * (c - *o));
                }
            });
        }
    });
}

/// Gradient of a direction from those of s and t.
fn turn(d: [f32; 3], d_s: f32, d_t: f32) -> [f32; 3] {
    let [major, s, t] = FACES[face_of(d)];
    let depth = dot(d, major);
    if depth == 0.0 {
        return [0.0; 3];
    }
    let scale = 0.5 / depth;
    let (along_s, along_t) = (d_s * scale, d_t * scale);
    let back = along_s * dot(d, s) / depth + along_t * dot(d, t) / depth;
    std::array::from_fn(|k| along_s * s[k] + along_t * t[k] - back * major[k])
}

/// Gradients of coordinates and of levels, overwritten.
///
/// # Shapes
/// As [`forward`]; d `[P, C]`, d_coordinates and d_level as coordinates and level.
///
/// # Panics
/// When shapes disagree.
pub fn backward_coordinates(
    t: &Texture,
    texels: &[f32],
    coordinates: &[f32],
    level: &[f32],
    d: &[f32],
    d_coordinates: &mut [f32],
    d_level: &mut [f32],
) {
    t.check(texels.len(), coordinates.len() / t.coordinates(), level.len(), d.len());
    assert!(d_coordinates.len() == coordinates.len() && d_level.len() == level.len(), "texture: gradients");
    let (n, width) = (t.channels, t.coordinates());
    let (to_coordinates, to_level) = (Parts::new(d_coordinates), Parts::new(d_level));
    by_points(t, coordinates, level, |range, points, found| {
        let mut d_place = [[0.0f32; BLOCK]; 2];
        let mut values = [[0.0f32; BLOCK]; 2];
        for (l, taps) in found.taps(t).iter().enumerate() {
            let mut dots = [[0.0; 4]; BLOCK];
            if n > 0 {
                correlate_all(taps, texels, n, &d[range.start * n..range.end * n], &mut dots);
            }
            for (i, dots) in dots.iter_mut().enumerate().take(range.len()) {
                taps.complete(i, dots);
                let (x, y) = (taps.between[0][i], taps.between[1][i]);
                let (across, down) = ([dots[1] - dots[0], dots[3] - dots[2]], [dots[2] - dots[0], dots[3] - dots[1]]);
                let share = found.share(l, i);
                d_place[0][i] += share * taps.slope[0][i] * (across[0] + y * (across[1] - across[0]));
                d_place[1][i] += share * taps.slope[1][i] * (down[0] + x * (down[1] - down[0]));
                let (upper, lower) = (dots[0] + x * across[0], dots[2] + x * across[1]);
                values[l][i] = upper + y * (lower - upper);
            }
        }
        // SAFETY: each task has points of its own.
        let out = unsafe { to_coordinates.range(range.start * width..range.end * width) };
        for (i, out) in out.chunks_exact_mut(width).enumerate() {
            let (d_s, d_t) = (d_place[0][i], d_place[1][i]);
            match t.kind {
                Kind::Cube => out.copy_from_slice(&turn(std::array::from_fn(|k| points.coordinates[k][i]), d_s, d_t)),
                _ => out.copy_from_slice(&[d_s, d_t]),
            }
        }
        if t.filter == Filter::Trilinear {
            // SAFETY: as above.
            let out = unsafe { to_level.range(range) };
            out.iter_mut().enumerate().for_each(|(i, out)| *out = found.free[i] * (values[1][i] - values[0][i]));
        }
    });
}
