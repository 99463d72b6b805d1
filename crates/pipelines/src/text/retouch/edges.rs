//! Sharpness of edges: how far a photograph blurs them, and the blur that makes drawn ones alike.

use super::shading::median;
use diorama_geom::Image;
use rayon::prelude::*;

/// Blur before gradients are measured, against noise, in px.
const MEASURING_SIGMA: f32 = 1.0;
/// Variance of that blur and of the central difference, whose two pixels act as a box.
const MEASURING_VARIANCE: f64 = (MEASURING_SIGMA * MEASURING_SIGMA) as f64 + 1.0 / 3.0;
/// Pixels from the mask's outline within which edges are looked for.
const REACH: usize = 3;
/// Share of the strongest edges' gradient below which an edge is noise.
const LEAST_STRENGTH: f32 = 0.3;
/// Radius of the blur's kernel over its sigma.
const KERNEL_RADIUS: f32 = 4.0;

/// Blur of the edges along a mask's outline as the sigma of a Gaussian in px; `None` where there are no edges.
///
/// A blurred step has the gradient `g(x) ∝ exp(−x² cos²θ / 2σ²)` along an axis at the angle θ to its normal, so the second difference of
/// `ln g` is `−cos²θ / σ²` wherever the peak lies between pixels. The result is the median over all peaks.
///
/// # Shapes
/// `image` `[H, W, C]`, `mask` `[H, W]`.
///
/// # Panics
/// When sizes differ.
pub fn edge_width(image: &Image, mask: &[bool]) -> Option<f32> {
    let (width, height) = (image.width, image.height);
    assert_eq!(mask.len(), width * height, "the mask does not have the size of the image");
    let gray: Vec<f32> = image.data.chunks(image.channels).map(|c| c.iter().sum::<f32>() / image.channels as f32).collect();
    let smooth = blur(&Image { width, height, channels: 1, data: gray }, MEASURING_SIGMA).data;
    let slope = |i: usize| [0.5 * (smooth[i + 1] - smooth[i - 1]), 0.5 * (smooth[i + width] - smooth[i - width])];
    let near: Vec<usize> = near_outline(mask, width, height);
    let mut strengths: Vec<f32> = near.iter().map(|i| slope(*i)[0].hypot(slope(*i)[1])).collect();
    let k = strengths.len().checked_sub(1)? * 9 / 10;
    let strong = (LEAST_STRENGTH * *strengths.select_nth_unstable_by(k, f32::total_cmp).1).max(1e-5);
    let variance = |i: usize| {
        let g = slope(i);
        let size = g[0].hypot(g[1]);
        let axis = if g[0].abs() >= g[1].abs() { 0 } else { 1 };
        let stride = [1, width][axis];
        let normal = [g[0] / size, g[1] / size];
        // The edge's own gradient beside the peak.
        let across = |j: usize| (slope(j)[0] * normal[0] + slope(j)[1] * normal[1]) as f64;
        let (before, peak, after) = (across(i - stride), across(i), across(i + stride));
        let is_peak = size >= strong && peak >= before && peak > after && before > 0.1 * peak && after > 0.1 * peak;
        let curvature = 2.0 * peak.ln() - before.ln() - after.ln();
        is_peak.then(|| (normal[axis] as f64).powi(2) / curvature.max(1e-6) - MEASURING_VARIANCE)
    };
    let variances: Vec<f64> = near.into_iter().filter_map(variance).collect();
    (!variances.is_empty()).then(|| median(variances).max(0.0).sqrt() as f32)
}

/// Pixels near a change in the mask, far enough from the border for gradients beside them.
fn near_outline(mask: &[bool], width: usize, height: usize) -> Vec<usize> {
    let is_near = |x: usize, y: usize| {
        let rows = y.saturating_sub(REACH)..(y + REACH + 1).min(height);
        let columns = x.saturating_sub(REACH)..(x + REACH + 1).min(width);
        rows.flat_map(|y| &mask[y * width..][columns.clone()]).any(|m| *m != mask[y * width + x])
    };
    let inner = |n: usize| 2..n.saturating_sub(2).max(2);
    inner(height).flat_map(|y| inner(width).filter(move |x| is_near(*x, y)).map(move |x| y * width + x)).collect()
}

/// The image blurred by a Gaussian of a sigma in px; border pixels repeat outward.
pub fn blur(image: &Image, sigma_px: f32) -> Image {
    if sigma_px < 1e-3 || image.data.is_empty() {
        return image.clone();
    }
    let radius = (KERNEL_RADIUS * sigma_px).ceil().max(1.0) as isize;
    let weights: Vec<f32> = (-radius..=radius).map(|d| (-0.5 * (d as f32 / sigma_px).powi(2)).exp()).collect();
    let total: f32 = weights.iter().sum();
    let taps: Vec<(isize, f32)> = (-radius..=radius).zip(weights.iter().map(|w| w / total)).collect();
    let (width, height, channels) = (image.width, image.height, image.channels);
    let clamped = |k: isize, n: usize| k.clamp(0, n as isize - 1) as usize;
    let mut across = Image::zeros(width, height, channels);
    across.data.par_chunks_mut(width * channels).enumerate().for_each(|(y, row)| {
        // With the border repeated, every tap adds one run of values.
        let wide: Vec<f32> = (-radius..width as isize + radius).flat_map(|x| image.pixel(clamped(x, width), y)).copied().collect();
        for (d, w) in &taps {
            let from = &wide[(d + radius) as usize * channels..][..width * channels];
            row.iter_mut().zip(from).for_each(|(o, c)| *o += w * c);
        }
    });
    let mut out = Image::zeros(width, height, channels);
    out.data.par_chunks_mut(width * channels).enumerate().for_each(|(y, row)| {
        for (d, w) in &taps {
            let from = &across.data[clamped(y as isize + d, height) * width * channels..][..width * channels];
            row.iter_mut().zip(from).for_each(|(o, c)| *o += w * c);
        }
    });
    out
}
