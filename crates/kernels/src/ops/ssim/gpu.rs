//! One unit per window and channel for the factors, one per pixel for the gradient.

use super::{C1, C2, WINDOW, gaussian};
use crate::gpu::{Buffer, Gpu, Rows, launch};
use crate::ops::linear::gpu as linear;
use cubecl::prelude::*;

/// Images `[h, w, c]` that are compared.
#[derive(Clone, Copy)]
pub struct Pair<'a> {
    /// Width, height and channels.
    pub size: (usize, usize, usize),
    pub x: &'a Buffer,
    pub y: &'a Buffer,
}

impl Pair<'_> {
    fn len(&self) -> usize {
        self.size.0 * self.size.1 * self.size.2
    }

    /// Windows that fit, times channels.
    fn windows(&self) -> usize {
        let (w, h, c) = self.size;
        (w + 1).saturating_sub(WINDOW) * (h + 1).saturating_sub(WINDOW) * c
    }
}

/// What the gradient takes besides the images: three factors per window and channel `[windows, C, 3]`, and the window.
pub type Kept = [Buffer; 2];

/// SSIM of every window `[windows, C]` and, of its slope `α + β x + γ y`, the three factors `[windows, C, 3]`.
fn windows(gpu: &Gpu, p: Pair) -> (Buffer, Kept) {
    let ((w, _, c), len, n) = (p.size, p.len(), p.windows());
    let (values, slopes) = (gpu.empty(n), gpu.empty(n * 3));
    let g = gpu.upload(&gaussian().map(|v| v as f32));
    launch!(
        gpu,
        compare_windows,
        n,
        [p.x => len, p.y => len, g => WINDOW, values => n, slopes => n * 3],
        n as u32,
        w as u32,
        c as u32,
        C1 as f32,
        C2 as f32,
    );
    (values, [slopes, g])
}

/// SSIM of every window and channel; the image's is their mean.
pub fn forward(gpu: &Gpu, p: Pair) -> Buffer {
    windows(gpu, p).0
}

/// Gradient of the mean with respect to x, `[h, w, c]`.
pub fn backward(gpu: &Gpu, p: Pair) -> Buffer {
    gathered(gpu, p, &windows(gpu, p).1)
}

/// The image's SSIM `[1]`, and what [`mean_backward`] takes besides the images.
pub fn mean(gpu: &Gpu, p: Pair) -> (Buffer, Kept) {
    let (values, kept) = windows(gpu, p);
    let sum = gpu.empty(1);
    linear::sum_rows_part(gpu, &Rows::all(gpu, values.len()), 1, &values, (&sum).into());
    (times(gpu, &sum, &gpu.upload(&[1.0 / values.len() as f32])), kept)
}

/// Gradient with respect to x, `[h, w, c]`, given that of [`mean`].
pub fn mean_backward(gpu: &Gpu, p: Pair, kept: &Kept, d_mean: &Buffer) -> Buffer {
    times(gpu, &gathered(gpu, p, kept), d_mean)
}

/// The gradient from the windows' factors.
fn gathered(gpu: &Gpu, p: Pair, [slopes, g]: &Kept) -> Buffer {
    let ((w, h, c), n, windows) = (p.size, p.len(), p.windows());
    if windows == 0 {
        return gpu.zeros(n);
    }
    let out = gpu.empty(n);
    launch!(
        gpu,
        gather,
        n,
        [p.x => n, p.y => n, g => WINDOW, slopes => windows * 3, out => n],
        n as u32,
        w as u32,
        h as u32,
        c as u32,
        1.0 / windows as f32,
    );
    out
}

/// `x · factor[0]`.
fn times(gpu: &Gpu, x: &Buffer, factor: &Buffer) -> Buffer {
    let n = x.len();
    let out = gpu.empty(n);
    launch!(gpu, scale, n, [x => n, factor => 1, out => n], n as u32);
    out
}

#[cube(launch_unchecked)]
fn scale(x: &[f32], factor: &[f32], out: &mut [f32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        out[ABSOLUTE_POS] = x[ABSOLUTE_POS] * factor[0];
    }
}

#[cube(launch_unchecked)]
fn compare_windows(
    x: &[f32],
    y: &[f32],
    g: &[f32],
    values: &mut [f32],
    slopes: &mut [f32],
    n: u32,
    width: u32,
    channels: u32,
    c1: f32,
    c2: f32,
) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let w = width as usize;
    let c = channels as usize;
    let k = unit % c;
    let across = w - 10;
    let ox = unit / c % across;
    let oy = unit / c / across;
    let mut mx = 0.0f32;
    let mut my = 0.0f32;
    for j in 0..11usize {
        for i in 0..11usize {
            let p = ((oy + j) * w + ox + i) * c + k;
            let weight = g[i] * g[j];
            mx += weight * x[p];
            my += weight * y[p];
        }
    }
    let mut vx = 0.0f32;
    let mut vy = 0.0f32;
    let mut xy = 0.0f32;
    for j in 0..11usize {
        for i in 0..11usize {
            let p = ((oy + j) * w + ox + i) * c + k;
            let weight = g[i] * g[j];
            let dx = x[p] - mx;
            let dy = y[p] - my;
            vx += weight * dx * dx;
            vy += weight * dy * dy;
            xy += weight * dx * dy;
        }
    }
    let a1 = 2.0 * mx * my + c1;
    let a2 = 2.0 * xy + c2;
    let b1 = mx * mx + my * my + c1;
    let b2 = vx + vy + c2;
    let s = a1 * a2 / (b1 * b2);
    values[unit] = s;
    // Slope of a pixel: weight · (α + β x + γ y).
    let beta = -(2.0 * s / b2);
    let gamma = 2.0 * s / a2;
    slopes[unit * 3] = s * (2.0 * my / a1 - 2.0 * mx / b1) - beta * mx - gamma * my;
    slopes[unit * 3 + 1] = beta;
    slopes[unit * 3 + 2] = gamma;
}

#[cube(launch_unchecked)]
fn gather(x: &[f32], y: &[f32], g: &[f32], slopes: &[f32], out: &mut [f32], n: u32, width: u32, height: u32, channels: u32, scale: f32) {
    let unit = ABSOLUTE_POS;
    if unit >= n as usize {
        terminate!();
    }
    let w = width as usize;
    let h = height as usize;
    let c = channels as usize;
    let k = unit % c;
    let px = unit / c % w;
    let py = unit / c / w;
    let mut sum = 0.0f32;
    for j in 0..11usize {
        for i in 0..11usize {
            if px >= i && py >= j && px - i < w - 10 && py - j < h - 10 {
                let at = (((py - j) * (w - 10) + px - i) * c + k) * 3;
                sum += g[i] * g[j] * (slopes[at] + slopes[at + 1] * x[unit] + slopes[at + 2] * y[unit]);
            }
        }
    }
    out[unit] = sum * scale;
}
