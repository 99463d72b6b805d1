//! Rows are tasks.

use super::{ALBEDO, DARK, DEPTH, NOISE, NORMAL, OPACITY, PASSES, SPLINE};
use crate::ops::path_trace::{Film, Pixel};
use crate::tasks::{self, Parts};

type Texel = super::Texel<f32>;

fn luminance(c: [f32; 3]) -> f32 {
    0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]
}

/// Replaces the colors of a film by filtered ones, and in the same way the light of its backdrop.
pub fn run(film: &mut Film) {
    let all = filtered(film, |p| p.color);
    let backdrop =
        film.pixels.iter().any(|p| p.backdrop[3] > 0.0).then(|| filtered(film, |p| [p.backdrop[0], p.backdrop[1], p.backdrop[2]]));
    for (i, p) in film.pixels.iter_mut().enumerate() {
        p.color = all[i];
        if let Some(backdrop) = &backdrop {
            p.backdrop[..3].copy_from_slice(&backdrop[i]);
        }
    }
}

/// Filtered colors `[H, W]`.
fn filtered(film: &Film, color: impl Fn(&Pixel) -> [f32; 3]) -> Vec<[f32; 3]> {
    let (w, h) = (film.width, film.height);
    let albedo = |p: &Pixel| p.albedo.map(|a| a + DARK + 1.0 - p.opacity);
    let mut now: Vec<Texel> = film
        .pixels
        .iter()
        .map(|p| {
            let (a, c) = (albedo(p), color(p));
            let l = luminance(p.color);
            let variance = (p.square - l * l).max(0.0) / film.samples.max(1) as f32 / luminance(a).powi(2);
            Texel {
                normal: p.normal,
                albedo: p.albedo,
                opacity: p.opacity,
                depth: p.depth,
                light: std::array::from_fn(|k| c[k] / a[k]),
                variance,
            }
        })
        .collect();
    let mut next = now.clone();
    for pass in 0..PASSES {
        let parts = Parts::new(&mut next);
        tasks::run(h, w * h, |y| {
            // SAFETY: each task has a row of its own.
            for (x, out) in unsafe { parts.chunk(y, w) }.iter_mut().enumerate() {
                (out.light, out.variance) = tap_sum(&now, (w, h), (x, y), 1 << pass);
            }
        });
        std::mem::swap(&mut now, &mut next);
    }
    now.iter().zip(&film.pixels).map(|(t, p)| std::array::from_fn(|k| t.light[k] * albedo(p)[k])).collect()
}

/// Light and variance of a pixel after a pass.
fn tap_sum(texels: &[Texel], (w, h): (usize, usize), (x, y): (usize, usize), step: isize) -> ([f32; 3], f32) {
    let center = &texels[y * w + x];
    let noise = smooth_variance(texels, (w, h), (x, y)).sqrt() * NOISE + 1e-4;
    let lum = luminance(center.light);
    let (mut light, mut variance, mut total) = ([0.0; 3], 0.0, 0.0);
    for dy in -2..=2isize {
        for dx in -2..=2isize {
            let (i, j) = (x as isize + dx * step, y as isize + dy * step);
            if i < 0 || j < 0 || i >= w as isize || j >= h as isize {
                continue;
            }
            let t = &texels[j as usize * w + i as usize];
            let squared = |a: [f32; 3], b: [f32; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>();
            let far = ((dx * dx + dy * dy) as f32).sqrt() * step as f32;
            let exponent = squared(t.normal, center.normal) / (NORMAL * NORMAL)
                + squared(t.albedo, center.albedo) / (ALBEDO * ALBEDO)
                + ((t.opacity - center.opacity) / OPACITY).powi(2)
                + (t.depth - center.depth).abs() / (DEPTH * center.depth * far + 1e-6)
                + (luminance(t.light) - lum).abs() / noise;
            let weight = SPLINE[dx.unsigned_abs()] * SPLINE[dy.unsigned_abs()] * (-exponent).exp();
            (0..3).for_each(|k| light[k] += weight * t.light[k]);
            variance += weight * weight * t.variance;
            total += weight;
        }
    }
    (light.map(|l| l / total), variance / (total * total))
}

/// Variance averaged over 3 × 3 pixels, weighted 1 2 1: single estimates are noisy themselves.
fn smooth_variance(texels: &[Texel], (w, h): (usize, usize), (x, y): (usize, usize)) -> f32 {
    let (mut sum, mut total) = (0.0, 0.0);
    for j in y.saturating_sub(1)..=(y + 1).min(h - 1) {
        for i in x.saturating_sub(1)..=(x + 1).min(w - 1) {
            let weight = if i == x { 2.0 } else { 1.0 } * if j == y { 2.0 } else { 1.0 };
            sum += weight * texels[j * w + i].variance;
            total += weight;
        }
    }
    sum / total
}
