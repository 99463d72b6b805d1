//! Plain loops in f64; weights from their definition as a product of all earlier transmittances.

use super::{Composited, Packed};

/// `T_i` for every sample and `T_out` for the ray.
fn transmittance(p: &Packed, sigma: &[f64], r: usize) -> (Vec<f64>, f64) {
    let mut depth = 0.0f64;
    let before = p
        .range(r)
        .map(|i| {
            let t = (-depth).exp();
            depth += sigma[i] * p.dt[i] as f64;
            t
        })
        .collect();
    (before, (-depth).exp())
}

/// Forward, for any number of channels `c`.
pub fn forward(p: &Packed, sigma: &[f64], features: &[f64], c: usize, background: &[f64]) -> Composited<f64> {
    let mut out = Composited { weights: vec![0.0; p.samples()], ..Default::default() };
    for r in 0..p.rays() {
        let (before, t_out) = transmittance(p, sigma, r);
        let mut color: Vec<f64> = (0..c).map(|k| t_out * background[r * c + k]).collect();
        let mut depth = 0.0;
        for (i, t) in p.range(r).zip(&before) {
            let w = t * (1.0 - (-sigma[i] * p.dt[i] as f64).exp());
            out.weights[i] = w;
            depth += w * (p.t[i] as f64 + 0.5 * p.dt[i] as f64);
            for k in 0..c {
                color[k] += w * features[i * c + k];
            }
        }
        out.color.extend(color);
        out.depth.push(depth);
        out.opacity.push(1.0 - t_out);
    }
    out
}

/// Gradients of sigma, features and background by the full double sum
/// `∂w_j/∂σ_i = −δ_i w_j` for `j > i`, `δ_i T_{i+1}` for `j = i`.
#[allow(clippy::too_many_arguments)]
pub fn backward(
    p: &Packed,
    sigma: &[f64],
    features: &[f64],
    c: usize,
    background: &[f64],
    d: &Composited<f64>,
) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let (mut ds, mut df, mut db) = (vec![0.0; sigma.len()], vec![0.0; features.len()], vec![0.0; background.len()]);
    let out = forward(p, sigma, features, c, background);
    for r in 0..p.rays() {
        let (before, t_out) = transmittance(p, sigma, r);
        let mut g_out = -d.opacity[r];
        for k in 0..c {
            db[r * c + k] = t_out * d.color[r * c + k];
            g_out += d.color[r * c + k] * background[r * c + k];
        }
        let g = |j: usize| {
            let color: f64 = (0..c).map(|k| d.color[r * c + k] * features[j * c + k]).sum();
            color + d.depth[r] * (p.t[j] as f64 + 0.5 * p.dt[j] as f64) + d.weights[j]
        };
        for (i, t) in p.range(r).zip(&before) {
            let dt = p.dt[i] as f64;
            ds[i] = dt * t * (-sigma[i] * dt).exp() * g(i) - dt * t_out * g_out;
            for j in i + 1..p.offsets[r + 1] as usize {
                ds[i] -= dt * out.weights[j] * g(j);
            }
            for k in 0..c {
                df[i * c + k] = out.weights[i] * d.color[r * c + k];
            }
        }
    }
    (ds, df, db)
}

/// Transmittance at distance `t_query` `[R]` along each ray.
pub fn transmittance_at(p: &Packed, sigma: &[f64], t_query: &[f64]) -> Vec<f64> {
    (0..p.rays())
        .map(|r| {
            let depth: f64 = p.range(r).map(|i| sigma[i] * (t_query[r] - p.t[i] as f64).clamp(0.0, p.dt[i] as f64)).sum();
            (-depth).exp()
        })
        .collect()
}

/// Splits each ray at `t_split`: front color, transmittance there, and the color behind it as if
/// nothing stood in front (without background). Samples belong to the side of their midpoint.
pub fn split(p: &Packed, sigma: &[f64], features: &[f64], c: usize, t_split: &[f64]) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let (mut front, mut back, mut between) = (vec![0.0; p.rays() * c], vec![0.0; p.rays() * c], vec![1.0; p.rays()]);
    for r in 0..p.rays() {
        let mut t_back = 1.0;
        for i in p.range(r) {
            let e = (-sigma[i] * p.dt[i] as f64).exp();
            let is_front = (p.t[i] as f64 + 0.5 * p.dt[i] as f64) < t_split[r];
            let (side, t) = if is_front { (&mut front, &mut between[r]) } else { (&mut back, &mut t_back) };
            for k in 0..c {
                side[r * c + k] += *t * (1.0 - e) * features[i * c + k];
            }
            *t *= e;
        }
    }
    (front, between, back)
}
