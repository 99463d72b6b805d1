//! Views of one rectangle, stacked so that a pixel's colors in all views are adjacent, with the hole that they share and their pyramid.

use diorama_geom::Image;
use rayon::prelude::*;

/// Colors `[H, W, D]` of all views, where D = views × channels, and the hole `[H, W]` in them.
#[derive(Clone)]
pub(super) struct ViewStack {
    pub width: usize,
    pub height: usize,
    pub depth: usize,
    pub colors: Vec<f32>,
    pub hole: Vec<bool>,
}

impl ViewStack {
    /// Stacks views of equal size.
    pub fn new(views: &[Image], hole: &[bool]) -> ViewStack {
        let (width, height, channels) = (views[0].width, views[0].height, views[0].channels);
        let depth = channels * views.len();
        let mut colors = vec![0.0; width * height * depth];
        colors.par_chunks_mut(width * depth).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.chunks_mut(depth).enumerate() {
                for (color, view) in pixel.chunks_mut(channels).zip(views) {
                    color.copy_from_slice(view.pixel(x, y));
                }
            }
        });
        ViewStack { width, height, depth, colors, hole: hole.to_vec() }
    }

    /// Writes the colors of the hole into the views.
    pub fn copy_hole_into(&self, views: &mut [Image]) {
        views.par_iter_mut().enumerate().for_each(|(v, view)| {
            let channels = view.channels;
            for (i, color) in view.data.chunks_mut(channels).enumerate().filter(|(i, _)| self.hole[*i]) {
                color.copy_from_slice(&self.color(i)[v * channels..][..channels]);
            }
        });
    }

    /// Colors of a pixel, `[D]`.
    pub fn color(&self, pixel: usize) -> &[f32] {
        &self.colors[pixel * self.depth..][..self.depth]
    }

    /// Half the size: means of known pixels, and a hole where fewer than half of the pixels are known.
    pub fn halved(&self) -> ViewStack {
        let (width, height, depth) = (self.width.div_ceil(2), self.height.div_ceil(2), self.depth);
        let mut colors = vec![0.0; width * height * depth];
        let mut hole = vec![false; width * height];
        colors.par_chunks_mut(width * depth).zip(hole.par_chunks_mut(width)).enumerate().for_each(|(y, (row, holes))| {
            for (x, (mean, is_hole)) in row.chunks_mut(depth).zip(holes).enumerate() {
                let (mut known, mut all) = (0, 0);
                for i in self.children(x, y) {
                    all += 1;
                    if !self.hole[i] {
                        known += 1;
                        mean.iter_mut().zip(self.color(i)).for_each(|(m, c)| *m += c);
                    }
                }
                mean.iter_mut().for_each(|m| *m /= known.max(1) as f32);
                *is_hole = 2 * known < all;
            }
        });
        ViewStack { width, height, depth, colors, hole }
    }

    /// Pixels of this stack that a pixel of half the size covers.
    fn children(&self, x: usize, y: usize) -> impl Iterator<Item = usize> {
        let (width, height) = (self.width, self.height);
        let rows = (2 * y..2 * y + 2).filter(move |y| *y < height);
        rows.flat_map(move |y| (2 * x..2 * x + 2).filter(move |x| *x < width).map(move |x| y * width + x))
    }

    /// Fills the hole with the colors of the stack of half the size.
    pub fn fill_from_half(&mut self, half: &ViewStack) {
        for i in (0..self.hole.len()).filter(|i| self.hole[*i]) {
            let from = i / self.width / 2 * half.width + i % self.width / 2;
            self.colors[i * self.depth..][..self.depth].copy_from_slice(half.color(from));
        }
    }

    /// Fills the hole layer by layer from its rim, each pixel with the mean of the eight neighbors filled before its layer.
    pub fn fill_smoothly(&mut self) {
        let layers = rim_distances(&self.hole, self.width, self.height);
        let mut order: Vec<usize> = (0..layers.len()).filter(|i| self.hole[*i]).collect();
        order.sort_by_key(|i| (layers[*i], *i));
        for i in order {
            let mut sum = vec![0.0; self.depth];
            let mut n = 0;
            for j in neighbors(i, self.width, self.height).filter(|j| layers[*j] < layers[i]) {
                n += 1;
                sum.iter_mut().zip(self.color(j)).for_each(|(s, c)| *s += c);
            }
            let target = &mut self.colors[i * self.depth..][..self.depth];
            target.iter_mut().zip(&sum).for_each(|(t, s)| *t = s / n.max(1) as f32);
        }
    }
}

/// The pixels around one.
fn neighbors(i: usize, width: usize, height: usize) -> impl Iterator<Item = usize> {
    let (x, y) = (i % width, i / width);
    let rows = y.saturating_sub(1)..(y + 2).min(height);
    let all = rows.flat_map(move |y| (x.saturating_sub(1)..(x + 2).min(width)).map(move |x| y * width + x));
    all.filter(move |j| *j != i)
}

/// Chessboard distance of each pixel of a hole to the nearest pixel outside, and 0 outside; `u32::MAX` where there is no outside.
///
/// # Shapes
/// `hole` and the result are `[H, W]`.
pub(super) fn rim_distances(hole: &[bool], width: usize, height: usize) -> Vec<u32> {
    let mut distances: Vec<u32> = hole.iter().map(|h| if *h { u32::MAX } else { 0 }).collect();
    let mut front: Vec<usize> = (0..hole.len()).filter(|i| !hole[*i]).collect();
    let mut reached = 0;
    while !front.is_empty() {
        reached += 1;
        let mut next = Vec::new();
        for i in front {
            for j in neighbors(i, width, height) {
                if distances[j] == u32::MAX {
                    distances[j] = reached;
                    next.push(j);
                }
            }
        }
        front = next;
    }
    distances
}
