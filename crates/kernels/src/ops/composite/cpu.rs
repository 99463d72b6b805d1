//! One forward pass and one backward pass with a running suffix sum; parallel over rays.

use super::{Composited, Packed};
use crate::math;
use rayon::prelude::*;

/// Rays per task.
const RAYS: usize = 64;

/// Gradients of the results; `None` stands for zeros.
#[derive(Clone, Copy, Debug, Default)]
pub struct Upstream<'a> {
    pub color: Option<&'a [f32]>,
    pub depth: Option<&'a [f32]>,
    pub opacity: Option<&'a [f32]>,
    pub weights: Option<&'a [f32]>,
}

/// Gradients of the inputs.
#[derive(Clone, Debug, Default)]
pub struct Gradients {
    pub sigma: Vec<f32>,
    pub features: Vec<f32>,
    pub background: Vec<f32>,
}

/// Weights of one ray's samples; returns `T_out`.
#[inline]
pub fn ray_weights(sigma: &[f32], dt: &[f32], weights: &mut [f32]) -> f32 {
    let mut t = 1.0f32;
    math::alphas(sigma, dt, weights);
    for w in weights {
        let alpha = *w;
        *w = t * alpha;
        t *= 1.0 - alpha;
    }
    t
}

/// Gradient of one ray's densities: `g` holds `∂L/∂w_i`, `g_out` is `∂L/∂T_out`.
#[inline]
pub fn ray_sigma_gradient(sigma: &[f32], dt: &[f32], weights: &[f32], t_out: f32, g: &[f32], g_out: f32, d_sigma: &mut [f32]) {
    // Behind sample i: Σ_{j>i} w_j g_j + T_out g_out, summed from the last sample on, where terms are small.
    let mut behind = t_out * g_out;
    let mut after = t_out;
    for i in (0..sigma.len()).rev() {
        d_sigma[i] = dt[i] * (after * g[i] - behind);
        behind += weights[i] * g[i];
        after += weights[i];
    }
}

/// Forward for any number of channels.
///
/// # Shapes
/// sigma `[S]`, features `[S, c]`, background `[R, c]`.
pub fn forward(p: &Packed, sigma: &[f32], features: &[f32], c: usize, background: &[f32]) -> Composited<f32> {
    let (r, s) = (p.rays(), p.samples());
    assert!(sigma.len() == s && features.len() == s * c && background.len() == r * c, "composite: shapes");
    let mut out = Composited { color: vec![0.0; r * c], depth: vec![0.0; r], opacity: vec![0.0; r], weights: vec![0.0; s] };
    let tasks = split_rays(p, &mut out.weights, 1);
    let colors = out.color.chunks_mut((RAYS * c).max(1));
    let scalars = out.depth.chunks_mut(RAYS).zip(out.opacity.chunks_mut(RAYS));
    let jobs: Vec<_> = tasks.into_iter().zip(colors).zip(scalars).collect();
    jobs.into_par_iter().for_each(|(((first, weights), color), (depth, opacity))| {
        let base = p.offsets[first] as usize;
        for q in 0..depth.len() {
            let span = p.range(first + q);
            let w = &mut weights[span.start - base..span.end - base];
            let t_out = ray_weights(&sigma[span.clone()], &p.dt[span.clone()], w);
            let o = &mut color[q * c..(q + 1) * c];
            for (o, b) in o.iter_mut().zip(&background[(first + q) * c..]) {
                *o = t_out * b;
            }
            for (i, w) in span.zip(w.iter()) {
                depth[q] += w * (p.t[i] + 0.5 * p.dt[i]);
                for (o, f) in o.iter_mut().zip(&features[i * c..]) {
                    *o += w * f;
                }
            }
            opacity[q] = 1.0 - t_out;
        }
    });
    out
}

/// Gradients of densities, features and background.
pub fn backward(p: &Packed, sigma: &[f32], features: &[f32], c: usize, background: &[f32], d: &Upstream) -> Gradients {
    let (r, s) = (p.rays(), p.samples());
    let mut out = Gradients { sigma: vec![0.0; s], features: vec![0.0; s * c], background: vec![0.0; r * c] };
    let tasks = split_rays(p, &mut out.sigma, 1);
    let feats = split_rays(p, &mut out.features, c);
    let backs = out.background.chunks_mut((RAYS * c).max(1));
    let jobs: Vec<_> = tasks.into_iter().zip(feats).zip(backs).collect();
    jobs.into_par_iter().for_each(|(((first, d_sigma), (_, d_features)), d_back)| {
        let base = p.offsets[first] as usize;
        let (mut w, mut g) = (Vec::new(), Vec::new());
        for q in first..(first + RAYS).min(r) {
            let span = p.range(q);
            w.resize(span.len(), 0.0);
            g.resize(span.len(), 0.0);
            let t_out = ray_weights(&sigma[span.clone()], &p.dt[span.clone()], &mut w);
            let mut g_out = -d.opacity.map_or(0.0, |d| d[q]);
            let dc = d.color.map(|d| &d[q * c..(q + 1) * c]);
            if let Some(dc) = dc {
                for k in 0..c {
                    d_back[(q - first) * c + k] = t_out * dc[k];
                    g_out += dc[k] * background[q * c + k];
                }
            }
            for (j, i) in span.clone().enumerate() {
                g[j] = d.weights.map_or(0.0, |d| d[i]) + d.depth.map_or(0.0, |d| d[q]) * (p.t[i] + 0.5 * p.dt[i]);
                if let Some(dc) = dc {
                    g[j] += dc.iter().zip(&features[i * c..]).map(|(a, b)| a * b).sum::<f32>();
                    for k in 0..c {
                        d_features[(i - base) * c + k] = w[j] * dc[k];
                    }
                }
            }
            let own = span.start - base..span.end - base;
            ray_sigma_gradient(&sigma[span.clone()], &p.dt[span], &w, t_out, &g, g_out, &mut d_sigma[own]);
        }
    });
    out
}

/// Cuts a per-sample buffer into pieces of [`RAYS`] rays: (first ray, piece).
fn split_rays<'a>(p: &Packed, mut rest: &'a mut [f32], c: usize) -> Vec<(usize, &'a mut [f32])> {
    let mut out = Vec::with_capacity(p.rays() / RAYS + 1);
    for first in (0..p.rays()).step_by(RAYS) {
        let last = (first + RAYS).min(p.rays());
        let n = (p.offsets[last] - p.offsets[first]) as usize * c;
        let (own, tail) = rest.split_at_mut(n);
        rest = tail;
        out.push((first, own));
    }
    out
}

/// Transmittance at distance `t_query` `[R]` along each ray.
pub fn transmittance_at(p: &Packed, sigma: &[f32], t_query: &[f32]) -> Vec<f32> {
    (0..p.rays())
        .into_par_iter()
        .map(|r| {
            let depth: f32 = p.range(r).map(|i| sigma[i] * (t_query[r] - p.t[i]).clamp(0.0, p.dt[i])).sum();
            (-depth).exp()
        })
        .collect()
}

/// Front color `[R, c]`, transmittance at the split `[R]`, color behind it `[R, c]`.
pub fn split(p: &Packed, sigma: &[f32], features: &[f32], c: usize, t_split: &[f32]) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let (mut front, mut back, mut between) = (vec![0.0; p.rays() * c], vec![0.0; p.rays() * c], vec![1.0; p.rays()]);
    let colors = front.par_chunks_mut(c.max(1)).zip(back.par_chunks_mut(c.max(1)));
    colors.zip(between.par_iter_mut()).enumerate().for_each(|(r, ((front, back), between))| {
        let mut t_back = 1.0f32;
        for i in p.range(r) {
            let alpha = -(-sigma[i] * p.dt[i]).exp_m1();
            let is_front = p.t[i] + 0.5 * p.dt[i] < t_split[r];
            let (side, t) = if is_front { (&mut *front, &mut *between) } else { (&mut *back, &mut t_back) };
            let w = *t * alpha;
            side.iter_mut().zip(&features[i * c..]).for_each(|(o, f)| *o += w * f);
            *t *= 1.0 - alpha;
        }
    });
    (front, between, back)
}
