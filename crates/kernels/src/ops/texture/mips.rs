//! Coarser levels as means of finer ones.

use super::Texture;
use crate::tasks::{self, Parts};

/// Rows per task.
const ROWS: usize = 16;

/// A level and the next coarser one: `work(finer row, other finer row, coarser row, columns that one texel covers)` for each coarser row.
fn each_row(t: &Texture, texels: &mut [f32], level: usize, work: impl Fn(&mut [f32], &mut [f32], usize) + Sync) {
    let levels = t.levels();
    let (finer, coarser) = (levels[level], levels[level + 1]);
    let (head, tail) = texels.split_at_mut(coarser.first * t.channels);
    let [across, down] = [finer.size[1] / coarser.size[1], finer.size[0] / coarser.size[0]];
    let (row, rows) = (coarser.size[1] * t.channels, t.images * t.faces() * coarser.size[0]);
    let (from, to) = (Parts::new(&mut head[finer.first * t.channels..]), Parts::new(&mut tail[..rows * row]));
    tasks::run(rows.div_ceil(ROWS), rows * row * 4, |task| {
        for y in task * ROWS..((task + 1) * ROWS).min(rows) {
            // SAFETY: each row of the coarser level, and the rows that it covers, belong to one task.
            let (from, to) = unsafe { (from.chunk(y, down * across * row), to.chunk(y, row)) };
            work(from, to, across);
        }
    });
}

/// Fills all levels but the finest, in place.
///
/// # Shapes
/// texels: all levels.
///
/// # Panics
/// When the length is not that of all levels.
pub fn forward(t: &Texture, texels: &mut [f32]) {
    assert_eq!(texels.len(), t.numbers(), "texture: texels of all levels");
    let c = t.channels;
    for level in 0..t.levels().len() - 1 {
        each_row(t, texels, level, |from, to, across| {
            let (down, wide) = (from.len() / (to.len() * across).max(1), to.len() * across);
            let share = 1.0 / (across * down) as f32;
            for (x, to) in to.chunks_exact_mut(c).enumerate() {
                for (k, to) in to.iter_mut().enumerate() {
                    let covered = (0..down).flat_map(|y| (0..across).map(move |i| y * wide + (x * across + i) * c + k));
                    *to = share * covered.map(|at| from[at]).sum::<f32>();
                }
            }
        });
    }
}

/// Adds the gradients of all levels to that of the finest, in place; those of the others are left as sums of coarser ones.
///
/// # Shapes
/// d_texels: all levels.
///
/// # Panics
/// As [`forward`].
pub fn backward(t: &Texture, d_texels: &mut [f32]) {
    assert_eq!(d_texels.len(), t.numbers(), "texture: texels of all levels");
    let c = t.channels;
    for level in (0..t.levels().len() - 1).rev() {
        each_row(t, d_texels, level, |to, from, across| {
            let (down, wide) = (to.len() / (from.len() * across).max(1), from.len() * across);
            let share = 1.0 / (across * down) as f32;
            for (y, x) in (0..down).flat_map(|y| (0..wide / c).map(move |x| (y, x))) {
                for k in 0..c {
                    to[y * wide + x * c + k] += share * from[x / across * c + k];
                }
            }
        });
    }
}
