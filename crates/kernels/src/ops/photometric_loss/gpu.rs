//! The loss of a batch of rays: color, opacity, distortion and depth, each a mean over the rays.

mod blend;

use super::{ColorLoss, Measure, Terms};
use crate::gpu::{Buffer, Gpu, launch};
use crate::ops::composite::gpu::{GpuComposited, GpuGradients, GpuPacked};
use crate::ops::{depth_loss, distortion};
use blend::blend_and_compare;
use cubecl::prelude::*;

/// Sums that [`loss`] adds to: loss, mean squared error, trained samples, marched samples, rays that were not cut, steps.
pub const SUMS: usize = 6;

/// Most units that sum rays, the rays that each has at least, and the parts that a unit sums afterwards.
const MOST_PARTS: usize = 1 << 13;
const LEAST_RAYS: usize = 8;
const FOLD: usize = 32;
/// Sums of a part: loss, squared error, rays that count, rays that were not cut, samples of those.
const WIDTH: usize = 5;

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
    /// Offsets of all samples that were marched, had there been room for them, `[R + 1]`.
    pub marched: &'a Buffer<u32>,
    /// Rays that lost samples for want of room: not 0, `[R]`. Their samples are not counted as trained.
    pub cut: &'a Buffer<u32>,
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

/// Composites packed samples with densities `[S]` and colors `[S, 3]`, compares them, and computes the gradients of
/// both, all rays in one launch; adds the step's figures. Also gives the squared error of each ray `[R]`. Gradients
/// closer than `near_scaling` are scaled as by [`crate::ops::field_step::gpu::scale_near_gradients`].
pub fn composite_and_loss(
    gpu: &Gpu,
    (terms, measure): (Terms, Measure),
    p: &GpuPacked,
    (sigma, rgb): (&Buffer, &Buffer),
    target: Target,
    near_scaling: f32,
    figures: Figures,
) -> (GpuGradients, Buffer) {
    let (r, s) = (p.rays(), p.t.len());
    let (values, errors) = (gpu.empty(r), gpu.empty(r));
    let g = GpuGradients { sigma: gpu.empty(s), features: gpu.empty(s * 3), background: gpu.empty(r * 3) };
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
        measure.relative,
        terms.alpha,
        terms.distortion,
        near_scaling,
        terms.depth,
        measure.normalized,
        by_depth,
    );
    // The values hold the distortion already.
    add_up(gpu, p, target.left_out, [&values, &errors, &values], 0.0, figures);
    (g, errors)
}

/// Gradients of what compositing gave, and the squared error of each ray `[R]`; adds the step's figures.
pub fn loss(
    gpu: &Gpu,
    (terms, measure): (Terms, Measure),
    p: &GpuPacked,
    out: &GpuComposited,
    target: Target,
    figures: Figures,
) -> (GpuComposited, Buffer) {
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
        measure.relative,
        terms.alpha,
        terms.distortion,
    );
    let (spread, weights) = if measure.normalized {
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
    let r = p.rays();
    let mut n = r.div_ceil(LEAST_RAYS).clamp(1, MOST_PARTS);
    let mut parts = gpu.empty(n * WIDTH);
    launch!(
        gpu,
        gather,
        n,
        [
            left_out => r,
            figures.cut => r,
            p.offsets => r + 1,
            values => r,
            errors => r,
            spread => r,
            parts => n * WIDTH,
        ],
        r as u32,
        n as u32,
        distortion,
    );
    while n > FOLD {
        let (all, few) = (n, n.div_ceil(FOLD));
        let folded = gpu.empty(few * WIDTH);
        launch!(gpu, fold, few, [parts => all * WIDTH, folded => few * WIDTH], all as u32, few as u32);
        (n, parts) = (few, folded);
    }
    launch!(
        gpu,
        finish,
        ([1; 3], CubeDim::new_1d(1)),
        [parts => n * WIDTH, figures.marched => r + 1, figures.sums => SUMS],
        r as u32,
        n as u32,
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
fn gather(
    left_out: &[u32],
    cut: &[u32],
    offsets: &[u32],
    values: &[f32],
    errors: &[f32],
    spread: &[f32],
    parts: &mut [f32],
    rays: u32,
    n: u32,
    distortion: f32,
) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let mut value = 0.0f32;
    let mut error = 0.0f32;
    let mut count = 0.0f32;
    let mut whole = 0.0f32;
    let mut samples = 0u32;
    let mut r = unit;
    while r < rays as usize {
        if left_out[r] == 0 {
            value += values[r] + distortion * spread[r];
            error += errors[r];
            count += 1.0;
        }
        if cut[r] == 0 {
            whole += 1.0;
            samples += offsets[r + 1] - offsets[r];
        }
        r += n as usize;
    }
    parts[unit * WIDTH] = value;
    parts[unit * WIDTH + 1] = error;
    parts[unit * WIDTH + 2] = count;
    parts[unit * WIDTH + 3] = whole;
    parts[unit * WIDTH + 4] = f32::cast_from(samples);
}

/// Sums of every `to`-th of `n` parts.
#[cube(launch_unchecked)]
fn fold(parts: &[f32], out: &mut [f32], n: u32, to: u32) {
    let unit = ABSOLUTE_POS;
    if unit >= to as usize {
        terminate!();
    }
    let mut sums = Array::<f32>::new(WIDTH);
    #[unroll]
    for k in 0..WIDTH {
        sums[k] = 0.0;
    }
    let mut i = unit;
    while i < n as usize {
        #[unroll]
        for k in 0..WIDTH {
            sums[k] += parts[i * WIDTH + k];
        }
        i += to as usize;
    }
    #[unroll]
    for k in 0..WIDTH {
        out[unit * WIDTH + k] = sums[k];
    }
}

#[cube(launch_unchecked)]
fn finish(parts: &[f32], marched: &[u32], sums: &mut [f32], rays: u32, n: u32, #[comptime] is_main: bool) {
    let mut value = 0.0f32;
    let mut error = 0.0f32;
    let mut count = 0.0f32;
    let mut whole = 0.0f32;
    let mut samples = 0.0f32;
    for i in 0..n as usize {
        value += parts[i * WIDTH];
        error += parts[i * WIDTH + 1];
        count += parts[i * WIDTH + 2];
        whole += parts[i * WIDTH + 3];
        samples += parts[i * WIDTH + 4];
    }
    sums[0] += value / max(f32::cast_from(rays), 1.0f32);
    sums[2] += samples;
    sums[3] += f32::cast_from(marched[rays as usize]);
    if comptime!(is_main) {
        sums[1] += error / max(count, 1.0f32);
        sums[4] += whole;
        sums[5] += 1.0;
    }
}
