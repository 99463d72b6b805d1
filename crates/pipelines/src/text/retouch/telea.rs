//! Inpainting by fast marching (Telea 2004): from its rim inward, each pixel of a hole continues the colors and gradients of known pixels
//! around it, weighted by direction × distance × level.

use super::CannotFill;
use diorama_geom::Image;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Radius of the neighborhood that a pixel is computed from.
pub const RADIUS_PX: f32 = 5.0;
/// Samples of the surroundings on each side of a pixel.
const RANGE_SAMPLES: f32 = 10.0;
/// Least factor of the direction, for neighbors across the front's normal.
const LEAST_DIRECTION: f32 = 1e-6;

/// The image with the pixels of the mask filled; others keep their values.
///
/// `I(p) = Σ w (I(q) + ∇I(q)·(p − q)) / Σ w` over known `q` within a radius, `w = |r̂·∇T(p)| · 1/|r|² · 1/(1 + |T(p) − T(q)|)`, with
/// `r = p − q` and the distance `T` from the hole's rim. Gradients count as
/// far as neighbors agree on them and fade with the depth in the hole, and results stay within the range of known pixels about as far away as
/// the rim: else texture at the rim would be continued to colors that are nowhere.
///
/// # Shapes
/// `image` `[H, W, C]`, `mask` `[H, W]`.
///
/// # Errors
/// When sizes differ, or the mask covers everything.
pub fn fill(image: &Image, mask: &[bool], radius_px: f32) -> Result<Image, CannotFill> {
    let (width, height) = (image.width, image.height);
    if mask.len() != width * height {
        return Err(CannotFill::Sizes { mask: mask.len(), width, height });
    }
    if !mask.contains(&false) {
        return Err(CannotFill::NothingKnown);
    }
    let times = signed_distances(mask, width, height, radius_px);
    let mut order: Vec<usize> = (0..mask.len()).filter(|i| mask[*i]).collect();
    order.sort_by(|a, b| times[*a].total_cmp(&times[*b]).then(a.cmp(b)));
    let known = mask.iter().map(|m| !m).collect();
    let mut front = Front { image: image.clone(), known, times };
    for i in order {
        let color = front.continued(i % width, i / width, radius_px);
        front.image.data[i * image.channels..][..image.channels].copy_from_slice(&color);
        front.known[i] = true;
    }
    Ok(front.image)
}

/// An image as far as the front has filled it.
struct Front {
    image: Image,
    known: Vec<bool>,
    times: Vec<f32>,
}

impl Front {
    /// The color at a pixel, continued from the known ones around it.
    fn continued(&self, x: usize, y: usize, radius_px: f32) -> Vec<f32> {
        let (width, height) = (self.image.width, self.image.height);
        let reach = radius_px.ceil().max(1.0) as usize;
        let i = y * width + x;
        let toward = self.gradient(x, y, |_| true, |j| self.times[j]);
        let (mut sums, mut total) = (vec![Continued::default(); self.image.channels], 0.0);
        for qy in y.saturating_sub(reach)..(y + reach + 1).min(height) {
            for qx in x.saturating_sub(reach)..(x + reach + 1).min(width) {
                let q = qy * width + qx;
                let r = [x as f32 - qx as f32, y as f32 - qy as f32];
                let length2 = r[0] * r[0] + r[1] * r[1];
                if !self.known[q] || length2 > (radius_px * radius_px).max(2.0) {
                    continue;
                }
                let direction = ((r[0] * toward[0] + r[1] * toward[1]) / length2.sqrt()).abs().max(LEAST_DIRECTION);
                let w = direction / length2 / (1.0 + (self.times[i] - self.times[q]).abs());
                total += w;
                for (k, sum) in sums.iter_mut().enumerate() {
                    let value = |j: usize| self.image.data[j * self.image.channels + k];
                    sum.add(w, value(q), self.gradient(qx, qy, |j| self.known[j], value), r);
                }
            }
        }
        let fading = 1.0 / (1.0 + (self.times[i] / radius_px).powi(2));
        let range = self.known_range(x, y, self.times[i] + radius_px);
        sums.iter().zip(range).map(|(s, r)| s.color(total, fading).max(r[0]).min(r[1])).collect()
    }

    /// Least and largest value per channel of pixels outside of the hole, in a square around a pixel, of which large ones are sampled.
    fn known_range(&self, x: usize, y: usize, reach: f32) -> Vec<[f32; 2]> {
        let (width, height, channels) = (self.image.width, self.image.height, self.image.channels);
        let step = (reach / RANGE_SAMPLES).ceil().max(1.0) as usize;
        let near = |k: usize, n: usize| (k.saturating_sub(reach as usize)..(k + reach as usize + 1).min(n)).step_by(step);
        let mut range = vec![[f32::INFINITY, f32::NEG_INFINITY]; channels];
        for i in near(y, height).flat_map(|y| near(x, width).map(move |x| y * width + x)).filter(|i| self.times[*i] <= 0.0) {
            let color = &self.image.data[i * channels..][..channels];
            range.iter_mut().zip(color).for_each(|(r, c)| *r = [r[0].min(*c), r[1].max(*c)]);
        }
        // Samples may miss all known pixels.
        range.into_iter().map(|r| if r[0] <= r[1] { r } else { [f32::NEG_INFINITY, f32::INFINITY] }).collect()
    }

    /// Central differences, one-sided where only one neighbor counts, else 0.
    fn gradient(&self, x: usize, y: usize, counts: impl Fn(usize) -> bool, value: impl Fn(usize) -> f32) -> [f32; 2] {
        let (width, height) = (self.image.width, self.image.height);
        let i = y * width + x;
        let along = |before: Option<usize>, after: Option<usize>| {
            let (before, after) = (before.filter(|j| counts(*j)), after.filter(|j| counts(*j)));
            let steps = before.is_some() as u8 + after.is_some() as u8;
            if steps == 0 { 0.0 } else { (value(after.unwrap_or(i)) - value(before.unwrap_or(i))) / steps as f32 }
        };
        [
            along((x > 0).then(|| i - 1), (x + 1 < width).then(|| i + 1)),
            along((y > 0).then(|| i - width), (y + 1 < height).then(|| i + width)),
        ]
    }
}

/// Weighted sums over the neighbors of a pixel, for one channel.
#[derive(Clone, Copy, Default)]
struct Continued {
    values: f32,
    steps: f32,
    slopes: [f32; 2],
    squares: f32,
}

impl Continued {
    fn add(&mut self, w: f32, value: f32, slope: [f32; 2], r: [f32; 2]) {
        self.values += w * value;
        self.steps += w * (slope[0] * r[0] + slope[1] * r[1]);
        (0..2).for_each(|a| self.slopes[a] += w * slope[a]);
        self.squares += w * (slope[0] * slope[0] + slope[1] * slope[1]);
    }

    /// The continued value; gradients count as far as they agree, `|Σ w g|² / (Σ w · Σ w |g|²)`: 1 on a slope, near 0 on texture.
    fn color(&self, total: f32, fading: f32) -> f32 {
        let agreement = (self.slopes[0].powi(2) + self.slopes[1].powi(2)) / (total * self.squares).max(1e-20);
        (self.values + fading * agreement * self.steps) / total
    }
}

/// Distance to the nearest pixels beside the hole, at most 0 outside, where it is known down to a limit.
fn signed_distances(mask: &[bool], width: usize, height: usize, limit: f32) -> Vec<f32> {
    let inside = distances(mask, width, height, f32::INFINITY);
    let outside = distances(&mask.iter().map(|m| !m).collect::<Vec<_>>(), width, height, limit);
    (0..mask.len()).map(|i| if mask[i] { inside[i] } else { 1.0 - outside[i].min(limit) }).collect()
}

/// Solves `|∇T| = 1` in a region by fast marching (Sethian 1996), from T = 0 at pixels beside it; infinite beyond a limit.
fn distances(region: &[bool], width: usize, height: usize, limit: f32) -> Vec<f32> {
    let mut times: Vec<f32> = region.iter().map(|r| if *r { f32::INFINITY } else { 0.0 }).collect();
    let mut done: Vec<bool> = region.iter().map(|r| !r).collect();
    let beside = |i: usize| {
        let (x, y) = (i % width, i / width);
        let all = [(x > 0).then(|| i - 1), (x + 1 < width).then(|| i + 1), (y > 0).then(|| i - width), (y + 1 < height).then(|| i + width)];
        all.into_iter().flatten()
    };
    // Times are not negative, so their bits are in their order.
    let mut queue: BinaryHeap<Reverse<(u32, usize)>> =
        (0..region.len()).filter(|i| !region[*i] && beside(*i).any(|j| region[j])).map(|i| Reverse((0, i))).collect();
    while let Some(Reverse((bits, i))) = queue.pop() {
        let is_stale = region[i] && (done[i] || bits != times[i].to_bits());
        if is_stale || times[i] > limit {
            continue;
        }
        done[i] = true;
        for j in beside(i).filter(|j| !done[*j]) {
            let (x, y) = (j % width, j / width);
            let time = |k: Option<usize>| k.filter(|k| done[*k]).map_or(f32::INFINITY, |k| times[k]);
            let across = time((x > 0).then(|| j - 1)).min(time((x + 1 < width).then(|| j + 1)));
            let down = time((y > 0).then(|| j - width)).min(time((y + 1 < height).then(|| j + width)));
            let arrival = arrival(across, down);
            if arrival < times[j] {
                times[j] = arrival;
                queue.push(Reverse((arrival.to_bits(), j)));
            }
        }
    }
    times
}

/// The time at which a front of speed 1 arrives, from the times of the neighbors across and down.
fn arrival(across: f32, down: f32) -> f32 {
    let gap = across - down;
    if gap.abs() < 1.0 { 0.5 * (across + down + (2.0 - gap * gap).sqrt()) } else { across.min(down) + 1.0 }
}
