//! Compositing, comparison and both ways back in one kernel: one unit per ray.

use super::{color_error, depth_loss};
use cubecl::prelude::*;

/// Length of a sample as the distortion loss takes it.
#[cube]
fn length(t: f32, dt: f32, #[comptime] normalized: bool) -> f32 {
    let mut share = 1.0f32;
    if comptime!(normalized) {
        share = 0.25 * (1.0 + t) * (1.0 + t + dt);
    }
    dt / share
}

/// Middle of a sample as the distortion loss takes it, from the beginning of its ray's first sample on.
#[cube]
fn middle(t: f32, dt: f32, first: f32, #[comptime] normalized: bool) -> f32 {
    let mut share = 1.0f32;
    if comptime!(normalized) {
        share = 0.25 * (1.0 + t) * (1.0 + first);
    }
    (t - first) / share + 0.5 * length(t, dt, normalized)
}

/// What compositing a ray gives besides its color.
#[derive(CubeType)]
struct Blended {
    /// Share of light that passes all samples.
    light: f32,
    /// Sum of the weights.
    weight: f32,
    /// Sum of the weights times the middles of their samples.
    moment: f32,
}

/// Composites the samples from `first` on; weights `[S]` and color `[3]` are overwritten.
#[cube]
fn blend(
    t: &[f32],
    dt: &[f32],
    sigma: &[f32],
    rgb: &[f32],
    weights: &mut [f32],
    color: &mut Array<f32>,
    first: usize,
    count: usize,
    #[comptime] normalized: bool,
) -> Blended {
    let mut light = 1.0f32;
    let mut weight = 0.0f32;
    let mut moment = 0.0f32;
    #[unroll]
    for k in 0..3usize {
        color[k] = 0.0;
    }
    for j in 0..count {
        let i = first + j;
        let through = (-sigma[i] * dt[i]).exp();
        let w = light * (1.0 - through);
        light *= through;
        weight += w;
        // Middles relative to the first sample keep the distortion's differences exact in f32.
        moment += w * middle(t[i], dt[i], t[first], normalized);
        weights[i] = w;
        #[unroll]
        for k in 0..3usize {
            color[k] += w * rgb[i * 3 + k];
        }
    }
    Blended { light, weight, moment }
}

/// The color's part of a ray's loss.
#[derive(CubeType)]
struct Compared {
    value: f32,
    squared: f32,
    /// Gradient of the light that passes all samples.
    d_light: f32,
}

/// Compares a ray's color, which light from the background adds to; gradients of the color `[3]` and of the background are overwritten.
#[cube]
fn compare_color(
    r: usize,
    scale: f32,
    light: f32,
    color: &Array<f32>,
    rgba: &[f32],
    background: &[f32],
    huber: f32,
    relative: f32,
    d_color: &mut Array<f32>,
    d_background: &mut [f32],
) -> Compared {
    let a = rgba[r * 4 + 3];
    let mut value = 0.0f32;
    let mut squared = 0.0f32;
    let mut d_light = 0.0f32;
    #[unroll]
    for k in 0..3usize {
        let behind = background[r * 3 + k];
        let e = color_error(color[k] + light * behind, rgba[r * 4 + k] * a + behind * (1.0 - a), huber, relative);
        value += e.value / 3.0;
        squared += e.squared / 3.0;
        let d = scale * e.slope / 3.0;
        d_color[k] = d;
        d_background[r * 3 + k] = light * d;
        d_light += d * behind;
    }
    Compared { value, squared, d_light }
}

/// Takes the gradients of a ray's color `[3]` and of the light that passes it back to densities and colors, and adds those of
/// distortion and depth, whose part of the loss is the result. Weights are read from `d_sigma` `[S]` and replaced.
#[cube]
fn blend_backward(
    t: &[f32],
    dt: &[f32],
    rgb: &[f32],
    d_sigma: &mut [f32],
    d_rgb: &mut [f32],
    d_color: &Array<f32>,
    d_light: f32,
    blended: &Blended,
    surface: f32,
    first: usize,
    count: usize,
    scale: f32,
    distortion: f32,
    near: f32,
    depth: f32,
    #[comptime] normalized: bool,
) -> f32 {
    // From the back, where what is still behind is small.
    let mut after = blended.light;
    let mut behind = blended.light * d_light;
    let mut sum_w = blended.weight;
    let mut sum_m = blended.moment;
    let mut spread = 0.0f32;
    let mut astray = 0.0f32;
    for j in 0..count {
        let i = first + count - 1 - j;
        let w = d_sigma[i];
        // As in the distortion's own kernel, with the sums up to here.
        let mid = middle(t[i], dt[i], t[first], normalized);
        let length = length(t[i], dt[i], normalized);
        let pairs = mid * (2.0 * sum_w - blended.weight) - (2.0 * sum_m - blended.moment);
        sum_w -= w;
        sum_m -= w * mid;
        spread += w * (pairs + w * length / 3.0);
        let mut g = scale * distortion * (2.0 * pairs + w * length * 2.0 / 3.0);
        if surface > 0.0 {
            let away = depth * depth_loss::gpu::away(t[i] + 0.5 * dt[i], surface);
            astray += away * w;
            g += scale * away;
        }
        let mut kept = 1.0f32;
        if near > 0.0 {
            let share = min((t[i] + 0.5 * dt[i]) / near, 1.0);
            kept = share * share;
        }
        #[unroll]
        for k in 0..3usize {
            g += d_color[k] * rgb[i * 3 + k];
            d_rgb[i * 3 + k] = kept * w * d_color[k];
        }
        d_sigma[i] = kept * dt[i] * (after * g - behind);
        behind += w * g;
        after += w;
    }
    distortion * spread + astray
}

#[cube(launch_unchecked)]
pub(super) fn blend_and_compare(
    offsets: &[u32],
    t: &[f32],
    dt: &[f32],
    sigma: &[f32],
    rgb: &[f32],
    rgba: &[f32],
    background: &[f32],
    left_out: &[u32],
    surfaces: &[f32],
    d_sigma: &mut [f32],
    d_rgb: &mut [f32],
    d_background: &mut [f32],
    values: &mut [f32],
    errors: &mut [f32],
    rays: u32,
    per_ray: f32,
    huber: f32,
    relative: f32,
    alpha: f32,
    distortion: f32,
    near: f32,
    depth: f32,
    #[comptime] normalized: bool,
    #[comptime] by_depth: bool,
) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let first = offsets[r] as usize;
    let count = offsets[r + 1] as usize - first;
    let mut scale = per_ray;
    if left_out[r] != 0 {
        scale = 0.0f32;
    }
    let mut surface = 0.0f32;
    if comptime!(by_depth) {
        surface = surfaces[r];
    }
    let mut color = Array::<f32>::new(3usize);
    let mut d_color = Array::<f32>::new(3usize);
    // The weights stay where the gradients of the densities will be.
    let b = blend(t, dt, sigma, rgb, d_sigma, &mut color, first, count, normalized);
    let c = compare_color(r, scale, b.light, &color, rgba, background, huber, relative, &mut d_color, d_background);
    let off = 1.0 - b.light - rgba[r * 4 + 3];
    let d_light = c.d_light - scale * alpha * 2.0 * off;
    let more =
        blend_backward(t, dt, rgb, d_sigma, d_rgb, &d_color, d_light, &b, surface, first, count, scale, distortion, near, depth, normalized);
    let mut value = c.value + alpha * off * off + more;
    let mut error = c.squared;
    if scale == 0.0 {
        value = 0.0f32;
        error = 0.0f32;
    }
    values[r] = value;
    errors[r] = error;
}
