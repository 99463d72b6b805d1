//! The correspondence field of exemplar inpainting: for every patch that touches the hole, the most similar patch outside of it, found by
//! propagation and random search (Barnes et al. 2009).

use super::view_stack::ViewStack;
use diorama_geom::rng::Rng;
use rayon::prelude::*;

/// Pixels along the side of a patch.
pub(super) const SIDE: usize = 7;
/// Rows of patches that one task searches in scan order; fixed, so that the result does not depend on the number of threads.
const STRIPE: usize = 16;
/// Random numbers reserved for one patch and sweep.
const DRAWS: u64 = 64;

/// The best source found for a target patch: the index of its corner, and the summed squared difference.
#[derive(Clone, Copy)]
pub(super) struct Match {
    pub source: u32,
    pub distance: f32,
}

/// How one sweep over the field searches.
#[derive(Clone, Copy)]
pub(super) struct Sweep {
    /// In scan order, or against it.
    pub forward: bool,
    /// Largest distance of random sources from the best one.
    pub reach: usize,
    pub rng: Rng,
}

/// Patches of a stack, addressed by their top left corners on a grid.
pub(super) struct Patches {
    pub width: usize,
    pub height: usize,
    /// Patches that touch the hole.
    pub targets: Vec<bool>,
    /// Corners of all patches that do not.
    pub sources: Vec<u32>,
}

impl Patches {
    /// `None` where no patch lies outside of the hole.
    pub fn of(stack: &ViewStack) -> Option<Patches> {
        if stack.width < SIDE || stack.height < SIDE {
            return None;
        }
        let (width, height) = (stack.width + 1 - SIDE, stack.height + 1 - SIDE);
        let in_row = |y: usize, x: usize| stack.hole[y * stack.width + x..][..SIDE].contains(&true);
        let rows: Vec<bool> = (0..stack.height * width).map(|i| in_row(i / width, i % width)).collect();
        let targets: Vec<bool> = (0..height * width).map(|i| (0..SIDE).any(|k| rows[i + k * width])).collect();
        let sources: Vec<u32> = (0..targets.len() as u32).filter(|i| !targets[*i as usize]).collect();
        (!sources.is_empty()).then_some(Patches { width, height, targets, sources })
    }

    /// Corner and offset as a grid index, if that patch is a source.
    fn source_at(&self, x: isize, y: isize) -> Option<u32> {
        let inside = x >= 0 && y >= 0 && x < self.width as isize && y < self.height as isize;
        let i = (y.max(0) as usize) * self.width + x.max(0) as usize;
        (inside && !self.targets[i]).then_some(i as u32)
    }

    fn corner(&self, i: u32) -> [usize; 2] {
        [i as usize % self.width, i as usize / self.width]
    }

    /// Random matches, whose distances are unknown.
    pub fn random_field(&self, rng: Rng) -> Vec<Match> {
        let pick = |i: usize| self.sources[rng.below(i as u64, self.sources.len() as u64) as usize];
        (0..self.targets.len()).map(|i| Match { source: pick(i), distance: f32::INFINITY }).collect()
    }

    /// The matches of half the size at twice the offsets, and random ones where those lead into the hole.
    pub fn doubled_field(&self, half: &Patches, field: &[Match], rng: Rng) -> Vec<Match> {
        let mut out = self.random_field(rng);
        for i in (0..out.len()).filter(|i| self.targets[*i]) {
            let (x, y) = (i % self.width, i / self.width);
            let (hx, hy) = ((x / 2).min(half.width - 1), (y / 2).min(half.height - 1));
            let j = hy * half.width + hx;
            if half.targets[j] {
                let [sx, sy] = half.corner(field[j].source);
                let (u, v) = ((2 * sx + x - 2 * hx).min(self.width - 1), (2 * sy + y - 2 * hy).min(self.height - 1));
                out[i].source = self.source_at(u as isize, v as isize).unwrap_or(out[i].source);
            }
        }
        out
    }

    /// Measures the distances of all matches again, after colors changed.
    pub fn measure(&self, stack: &ViewStack, field: &mut [Match]) {
        field.par_iter_mut().enumerate().filter(|(i, _)| self.targets[*i]).for_each(|(i, m)| {
            m.distance = self.distance(stack, i as u32, m.source, f32::INFINITY);
        });
    }

    /// Summed squared difference of two patches over all views, or infinity as soon as it reaches `bound`.
    fn distance(&self, stack: &ViewStack, a: u32, b: u32, bound: f32) -> f32 {
        let corner = |i: u32| self.corner(i)[1] * stack.width + self.corner(i)[0];
        let (a, b) = (corner(a), corner(b));
        let mut sum = 0.0;
        for row in 0..SIDE {
            let pixels = |at: usize| &stack.colors[(at + row * stack.width) * stack.depth..][..SIDE * stack.depth];
            sum += squared_difference(pixels(a), pixels(b));
            if sum >= bound {
                return f32::INFINITY;
            }
        }
        sum
    }

    /// Improves all matches once.
    pub fn sweep(&self, stack: &ViewStack, field: &mut [Match], sweep: Sweep) {
        let before = field.to_vec();
        field.par_chunks_mut(STRIPE * self.width).enumerate().for_each(|(stripe, matches)| {
            let first = stripe * STRIPE * self.width;
            for step in 0..matches.len() {
                let k = if sweep.forward { step } else { matches.len() - 1 - step };
                if self.targets[first + k] {
                    let found = |i: usize| if i >= first { matches.get(i - first).copied().unwrap_or(before[i]) } else { before[i] };
                    matches[k] = self.improved(stack, first + k, found, sweep);
                }
            }
        });
    }

    /// The best of a patch's match, its neighbors' matches moved along, and random patches at shrinking distances.
    fn improved(&self, stack: &ViewStack, i: usize, found: impl Fn(usize) -> Match, sweep: Sweep) -> Match {
        let mut best = found(i);
        let consider = |best: &mut Match, x: isize, y: isize| {
            if let Some(source) = self.source_at(x, y).filter(|s| *s != best.source) {
                let distance = self.distance(stack, i as u32, source, best.distance);
                if distance < best.distance {
                    *best = Match { source, distance };
                }
            }
        };
        let (x, y) = ((i % self.width) as isize, (i / self.width) as isize);
        let step = if sweep.forward { 1 } else { -1 };
        for (dx, dy) in [(step, 0), (0, step)] {
            let (nx, ny) = (x - dx, y - dy);
            if nx < 0 || ny < 0 || nx >= self.width as isize || ny >= self.height as isize {
                continue;
            }
            let j = ny as usize * self.width + nx as usize;
            if self.targets[j] {
                let [sx, sy] = self.corner(found(j).source);
                consider(&mut best, sx as isize + dx, sy as isize + dy);
            }
        }
        let mut reach = sweep.reach.min(self.width.max(self.height)) as isize;
        let mut draw = i as u64 * DRAWS;
        while reach >= 1 {
            let bits = sweep.rng.bits(draw);
            let [bx, by] = self.corner(best.source);
            let offset = |bits: u64| ((bits as u32 as u64 * (2 * reach as u64 + 1)) >> 32) as isize - reach;
            consider(&mut best, bx as isize + offset(bits), by as isize + offset(bits >> 32));
            (draw, reach) = (draw + 1, reach / 2);
        }
        best
    }
}

/// `Σ (a − b)²`, in eight sums that run side by side.
fn squared_difference(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; 8];
    let (a8, b8) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f32 = a8.remainder().iter().zip(b8.remainder()).map(|(x, y)| (x - y) * (x - y)).sum();
    for (x, y) in a8.zip(b8) {
        for k in 0..8 {
            sums[k] += (x[k] - y[k]) * (x[k] - y[k]);
        }
    }
    sums.iter().sum::<f32>() + rest
}
