//! The loss of a batch of rays: color, opacity, distortion and depth, each a mean over the rays.

use super::ColorLoss;
use crate::gpu::{Buffer, Gpu, launch};
use crate::ops::composite::gpu::{GpuComposited, GpuGradients, GpuPacked};
use crate::ops::{depth_loss, distortion};
use cubecl::prelude::*;

/// Sums that [`loss`] adds to: loss, mean squared error, trained samples, marched samples, steps.
pub const SUMS: usize = 5;

/// Parts in which rays are summed.
const PARTS: usize = 256;

/// What counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Terms {
    pub color: ColorLoss,
    /// For linear light: what is added to a prediction that its difference is divided by; 0: differences count as they are.
    pub relative: f32,
    /// Weight of the distortion loss.
    pub distortion: f32,
    /// Whether the distortion loss is taken in normalized distance ([`distortion::normalized_distance`]).
    pub normalized: bool,
    /// Weight of the squared difference between opacity and the photograph's alpha.
    pub alpha: f32,
    /// Weight of the light that ends away from surfaces of known distance ([`depth_loss`]).
    pub depth: f32,
}

impl ColorLoss {
    /// Width of the quadratic part as kernels take it; 0: all of it.
    fn width(self) -> f32 {
        match self {
            ColorLoss::Mse => 0.0,
            ColorLoss::Huber(width) => width,
        }
    }
}

/// Where a step's figures are added.
#[derive(Clone, Copy)]
pub struct Figures<'a> {
    /// `[SUMS]`
    pub sums: &'a Buffer,
    /// Offsets of all samples that were marched, `[R + 1]`.
    pub marched: &'a Buffer<u32>,
    /// Whether this is what the step is judged by; else only loss and samples are added.
    pub is_main: bool,
}

/// What rays are to match.
#[derive(Clone, Copy)]
pub struct Target<'a> {
    /// Straight RGBA `[R, 4]`.
    pub rgba: &'a Buffer,
    /// What transparent pixels are composited on, `[R, 3]`.
    pub background: &'a Buffer,
    /// Rays that do not count: not 0, `[R]`.
    pub left_out: &'a Buffer<u32>,
    /// Distance of the surface along the ray, 0 where it is not known, `[R]`; not read without [`Terms::depth`].
    pub distance: &'a Buffer,
}

/// Composites packed samples with densities `[S]` and colours `[S, 3]`, compares them, and takes the gradients back to
/// both, all rays in one launch; adds the step's figures. Also gives the squared error of each ray `[R]`. Gradients
/// closer than `near_scaling` are scaled as by [`crate::ops::field_step::gpu::scale_near_gradients`].
pub fn composite_and_loss(
    gpu: &Gpu,
    terms: Terms,
    p: &GpuPacked,
    (sigma, rgb): (&Buffer, &Buffer),
    target: Target,
    near_scaling: f32,
    figures: Figures,
) -> (GpuGradients, Buffer) {
    let (r, s) = (p.rays(), p.t.len());
    let (values, errors) = (gpu.empty(r), gpu.empty(r));
    let g = GpuGradients { sigma: gpu.empty(s), features: gpu.empty(s * 3), background: gpu.empty(r * 3) };
    if r == 0 {
        return (g, errors);
    }
    let by_depth = terms.depth > 0.0;
    launch!(
        gpu,
        blend_and_compare,
        r,
        [
            p.offsets => r + 1,
            p.t => s,
            p.dt => s,
            sigma => s,
            rgb => s * 3,
            target.rgba => r * 4,
            target.background => r * 3,
            target.left_out => r,
            target.distance => if by_depth { r } else { 0 },
            g.sigma => s,
            g.features => s * 3,
            g.background => r * 3,
            values => r,
            errors => r,
        ],
        r as u32,
        1.0 / r as f32,
        terms.color.width(),
        terms.relative,
        terms.alpha,
        terms.distortion,
        near_scaling,
        terms.depth,
        terms.normalized,
        by_depth,
    );
    // The values hold the distortion already.
    add_up(gpu, p, target.left_out, [&values, &errors, &values], 0.0, figures);
    (g, errors)
}

/// Gradients of what compositing gave, and the squared error of each ray `[R]`; adds the step's figures.
pub fn loss(gpu: &Gpu, terms: Terms, p: &GpuPacked, out: &GpuComposited, target: Target, figures: Figures) -> (GpuComposited, Buffer) {
    let r = p.rays();
    let d = GpuComposited { color: gpu.empty(r * 3), depth: gpu.zeros(r), opacity: gpu.empty(r), weights: gpu.empty(0) };
    let (values, errors, d_spread) = (gpu.empty(r), gpu.empty(r), gpu.empty(r));
    launch!(
        gpu,
        compare,
        r,
        [
            out.color => r * 3,
            out.opacity => r,
            target.rgba => r * 4,
            target.background => r * 3,
            target.left_out => r,
            d.color => r * 3,
            d.opacity => r,
            d_spread => r,
            values => r,
            errors => r,
        ],
        r as u32,
        1.0 / r as f32,
        terms.color.width(),
        terms.relative,
        terms.alpha,
        terms.distortion,
    );
    let (spread, weights) = if terms.normalized {
        distortion::gpu::both(gpu, &distortion::gpu::normalized(gpu, p), &out.weights, &d_spread)
    } else {
        distortion::gpu::both(gpu, p, &out.weights, &d_spread)
    };
    if terms.depth > 0.0 {
        let scale = 1.0 / r.max(1) as f32;
        depth_loss::gpu::add(gpu, p, &out.weights, target.distance, target.left_out, (terms.depth, scale), (&values, &weights));
    }
    add_up(gpu, p, target.left_out, [&values, &errors, &spread], terms.distortion, figures);
    (GpuComposited { weights, ..d }, errors)
}

/// Adds a step's figures to `sums`.
fn add_up(gpu: &Gpu, p: &GpuPacked, left_out: &Buffer<u32>, [values, errors, spread]: [&Buffer; 3], distortion: f32, figures: Figures) {
    let (r, parts) = (p.rays(), gpu.empty(PARTS * 3));
    launch!(
        gpu,
        gather,
        PARTS,
        [left_out => r, values => r, errors => r, spread => r, parts => PARTS * 3],
        r as u32,
        PARTS as u32,
        distortion,
    );
    launch!(
        gpu,
        finish,
        ([1; 3], CubeDim::new_1d(1)),
        [parts => PARTS * 3, p.offsets => r + 1, figures.marched => r + 1, figures.sums => SUMS],
        r as u32,
        PARTS as u32,
        figures.is_main,
    );
}

/// A channel's error.
#[derive(CubeType)]
struct Error {
    value: f32,
    slope: f32,
    squared: f32,
}

/// A linear value as it is shown: within white, along the sRGB curve.
#[cube]
fn shown(linear: f32) -> f32 {
    let v = min(max(linear, 0.0), 1.0);
    let mut out = v * 12.92;
    if v > 0.0031308 {
        out = 1.055 * v.powf(1.0 / 2.4) - 0.055;
    }
    out
}

#[cube]
fn color_error(got: f32, wanted: f32, huber: f32, relative: f32) -> Error {
    let mut by = 1.0f32;
    let mut off = got - wanted;
    if relative > 0.0 {
        by = 1.0 / (max(got, 0.0) + relative);
        off = shown(got) - shown(wanted);
    }
    let d = by * (got - wanted);
    let mut value = d * d;
    let mut slope = 2.0 * d;
    if huber > 0.0 {
        if d.abs() <= huber {
            value /= 2.0 * huber;
            slope = d / huber;
        } else {
            value = d.abs() - 0.5 * huber;
            slope = 1.0f32;
            if d < 0.0 {
                slope = -1.0f32;
            }
        }
    }
    Error { value, slope: by * slope, squared: off * off }
}

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

#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube(launch_unchecked)]
fn blend_and_compare(
    offsets: &[u32],
    t: &[f32],
    dt: &[f32],
    sigma: &[f32],
    rgb: &[f32],
    rgba: &[f32],
    background: &[f32],
    left_out: &[u32],
    surface: &[f32],
    d_sigma: &mut [f32],
    d_rgb: &mut [f32],
    d_background: &mut [f32],
    values: &mut [f32],
    errors: &mut [f32],
    rays: u32,
    scale: f32,
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
    let mut light = 1.0f32;
    let mut all_w = 0.0f32;
    let mut all_m = 0.0f32;
    let mut color = Array::<f32>::new(3usize);
    #[unroll]
    for k in 0..3usize {
        color[k] = 0.0;
    }
    for j in 0..count {
        let i = first + j;
        let through = (-sigma[i] * dt[i]).exp();
        let w = light * (1.0 - through);
        light *= through;
        all_w += w;
        // Midpoints relative to the first keep the distortion's differences exact in f32.
        all_m += w * middle(t[i], dt[i], t[first], normalized);
        // Kept where the gradient will be.
        d_sigma[i] = w;
        #[unroll]
        for k in 0..3usize {
            color[k] += w * rgb[i * 3 + k];
        }
    }
    let mut counts = scale;
    if left_out[r] != 0 {
        counts = 0.0f32;
    }
    let a = rgba[r * 4 + 3];
    let off = 1.0 - light - a;
    let mut value = alpha * off * off;
    let mut error = 0.0f32;
    let d_opacity = counts * alpha * 2.0 * off;
    let mut out = -d_opacity;
    let mut d_color = Array::<f32>::new(3usize);
    #[unroll]
    for k in 0..3usize {
        let behind = background[r * 3 + k];
        let e = color_error(color[k] + light * behind, rgba[r * 4 + k] * a + behind * (1.0 - a), huber, relative);
        value += e.value / 3.0;
        error += e.squared / 3.0;
        let d = counts * e.slope / 3.0;
        d_color[k] = d;
        d_background[r * 3 + k] = light * d;
        out += d * behind;
    }
    // From the back, where what is still behind is small.
    let mut after = light;
    let mut behind = light * out;
    let mut sum_w = all_w;
    let mut sum_m = all_m;
    let mut spread = 0.0f32;
    for j in 0..count {
        let i = first + count - 1 - j;
        let w = d_sigma[i];
        // As in the distortion's own kernel, with the sums up to here.
        let mid = middle(t[i], dt[i], t[first], normalized);
        let length = length(t[i], dt[i], normalized);
        let pairs = mid * (2.0 * sum_w - all_w) - (2.0 * sum_m - all_m);
        sum_w -= w;
        sum_m -= w * mid;
        spread += w * (pairs + w * length / 3.0);
        let mut kept = 1.0f32;
        if near > 0.0 {
            let share = min((t[i] + 0.5 * dt[i]) / near, 1.0);
            kept = share * share;
        }
        let mut g = counts * distortion * (2.0 * pairs + w * length * 2.0 / 3.0);
        if comptime!(by_depth) {
            if surface[r] > 0.0 {
                let away = depth * depth_loss::gpu::away(t[i] + 0.5 * dt[i], surface[r]);
                value += away * w;
                g += counts * away;
            }
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
    value += distortion * spread;
    if counts == 0.0 {
        value = 0.0f32;
        error = 0.0f32;
    }
    values[r] = value;
    errors[r] = error;
}

#[cube(launch_unchecked)]
fn compare(
    color: &[f32],
    opacity: &[f32],
    rgba: &[f32],
    background: &[f32],
    left_out: &[u32],
    d_color: &mut [f32],
    d_opacity: &mut [f32],
    d_spread: &mut [f32],
    values: &mut [f32],
    errors: &mut [f32],
    rays: u32,
    scale: f32,
    huber: f32,
    relative: f32,
    alpha: f32,
    distortion: f32,
) {
    let r = ABSOLUTE_POS;
    if r >= rays as usize {
        terminate!();
    }
    let mut counts = 1.0f32;
    if left_out[r] != 0 {
        counts = 0.0f32;
    }
    let a = rgba[r * 4 + 3];
    let mut value = 0.0f32;
    let mut error = 0.0f32;
    #[unroll]
    for k in 0..3usize {
        let wanted = rgba[r * 4 + k] * a + background[r * 3 + k] * (1.0 - a);
        let e = color_error(color[r * 3 + k], wanted, huber, relative);
        error += e.squared;
        value += e.value / 3.0;
        d_color[r * 3 + k] = counts * e.slope * scale / 3.0;
    }
    let d = opacity[r] - a;
    value += alpha * d * d;
    d_opacity[r] = counts * alpha * 2.0 * d * scale;
    d_spread[r] = counts * distortion * scale;
    values[r] = counts * value;
    errors[r] = counts * error / 3.0;
}

#[cube(launch_unchecked)]
fn gather(left_out: &[u32], values: &[f32], errors: &[f32], spread: &[f32], parts: &mut [f32], rays: u32, n: u32, distortion: f32) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let mut value = 0.0f32;
    let mut error = 0.0f32;
    let mut count = 0.0f32;
    let mut r = unit;
    while r < rays as usize {
        if left_out[r] == 0 {
            value += values[r] + distortion * spread[r];
            error += errors[r];
            count += 1.0;
        }
        r += n as usize;
    }
    parts[unit * 3] = value;
    parts[unit * 3 + 1] = error;
    parts[unit * 3 + 2] = count;
}

#[cube(launch_unchecked)]
fn finish(parts: &[f32], offsets: &[u32], marched: &[u32], sums: &mut [f32], rays: u32, n: u32, #[comptime] is_main: bool) {
    let mut value = 0.0f32;
    let mut error = 0.0f32;
    let mut count = 0.0f32;
    for i in 0..n as usize {
        value += parts[i * 3];
        error += parts[i * 3 + 1];
        count += parts[i * 3 + 2];
    }
    sums[0] += value / f32::cast_from(rays);
    sums[2] += f32::cast_from(offsets[rays as usize]);
    sums[3] += f32::cast_from(marched[rays as usize]);
    if comptime!(is_main) {
        sums[1] += error / max(count, 1.0f32);
        sums[4] += 1.0;
    }
}
