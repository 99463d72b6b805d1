//! One unit per window and channel for the factors, one per pixel for the gradient.

use super::{C1, C2, WINDOW, gaussian};
use crate::gpu::Rows;
use crate::gpu::{Buffer, CUBE, Gpu, units};
use crate::ops::linear::gpu as linear;
use cubecl::prelude::*;

/// SSIM of every window `[windows, C]` and, of its slope `α + β x + γ y`, the three factors `[windows, C, 3]`.
fn windows(gpu: &Gpu, (w, h, c): (usize, usize, usize), x: &Buffer, y: &Buffer) -> (Buffer, Buffer, Buffer) {
    let n = (w + 1).saturating_sub(WINDOW) * (h + 1).saturating_sub(WINDOW) * c;
    let (values, slopes) = (gpu.empty(n), gpu.empty(n * 3));
    let g = gpu.upload(&gaussian().map(|v| v as f32));
    if n > 0 {
        // SAFETY: units past `n` stop; windows lie within the image.
        unsafe {
            judge::launch_unchecked(
                &gpu.client,
                units(n),
                CubeDim::new_1d(CUBE),
                x.arg(),
                y.arg(),
                g.arg(),
                values.arg(),
                slopes.arg(),
                n as u32,
                w as u32,
                c as u32,
                C1 as f32,
                C2 as f32,
            );
        }
    }
    (values, slopes, g)
}

/// SSIM of every window and channel; the image's is their mean.
pub fn forward(gpu: &Gpu, size: (usize, usize, usize), x: &Buffer, y: &Buffer) -> Buffer {
    windows(gpu, size, x, y).0
}

/// Gradient of the mean with respect to x, `[h, w, c]`.
pub fn backward(gpu: &Gpu, size: (usize, usize, usize), x: &Buffer, y: &Buffer) -> Buffer {
    let (_, slopes, g) = windows(gpu, size, x, y);
    gathered(gpu, size, x, y, &slopes, &g)
}

/// The image's SSIM `[1]`, and what [`mean_backward`] takes besides the images.
pub fn mean(gpu: &Gpu, size: (usize, usize, usize), x: &Buffer, y: &Buffer) -> (Buffer, [Buffer; 2]) {
    let (values, slopes, g) = windows(gpu, size, x, y);
    let sum = gpu.empty(1);
    linear::sum_rows_part(gpu, &Rows::all(gpu, values.len()), 1, &values, (&sum).into());
    (times(gpu, &sum, &gpu.upload(&[1.0 / values.len() as f32])), [slopes, g])
}

/// Gradient with respect to x, `[h, w, c]`, given that of [`mean`].
pub fn mean_backward(gpu: &Gpu, size: (usize, usize, usize), x: &Buffer, y: &Buffer, kept: [&Buffer; 2], d_mean: &Buffer) -> Buffer {
    times(gpu, &gathered(gpu, size, x, y, kept[0], kept[1]), d_mean)
}

/// The gradient from the windows' factors.
fn gathered(gpu: &Gpu, (w, h, c): (usize, usize, usize), x: &Buffer, y: &Buffer, slopes: &Buffer, g: &Buffer) -> Buffer {
    if slopes.is_empty() {
        return gpu.zeros(x.len());
    }
    let out = gpu.empty(x.len());
    // SAFETY: units past the pixels stop; windows are clamped to those that exist.
    unsafe {
        gather::launch_unchecked(
            &gpu.client,
            units(x.len()),
            CubeDim::new_1d(CUBE),
            x.arg(),
            y.arg(),
            g.arg(),
            slopes.arg(),
            out.arg(),
            x.len() as u32,
            w as u32,
            h as u32,
            c as u32,
            3.0 / slopes.len() as f32,
        );
    }
    out
}

/// `x · factor[0]`.
fn times(gpu: &Gpu, x: &Buffer, factor: &Buffer) -> Buffer {
    let out = gpu.empty(x.len());
    // SAFETY: units past the length stop.
    unsafe {
        scale::launch_unchecked(&gpu.client, units(x.len()), CubeDim::new_1d(CUBE), x.arg(), factor.arg(), out.arg(), x.len() as u32);
    }
    out
}

#[cube(launch_unchecked)]
fn scale(x: &[f32], factor: &[f32], out: &mut [f32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        out[ABSOLUTE_POS] = x[ABSOLUTE_POS] * factor[0];
    }
}

#[cube(launch_unchecked)]
fn judge(x: &[f32], y: &[f32], g: &[f32], values: &mut [f32], slopes: &mut [f32], n: u32, width: u32, channels: u32, c1: f32, c2: f32) {
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
