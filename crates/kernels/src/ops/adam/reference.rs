//! Plain loop in f64.

use super::Adam;

/// One step `t ≥ 1`; `sparse` skips elements without gradient.
pub fn step(a: &Adam, t: u32, sparse: bool, p: &mut [f64], m: &mut [f64], v: &mut [f64], g: &[f64]) {
    let (b1, b2) = (a.beta1 as f64, a.beta2 as f64);
    for i in 0..p.len() {
        if sparse && g[i] == 0.0 {
            continue;
        }
        let g = g[i] + a.weight_decay as f64 * p[i];
        m[i] = b1 * m[i] + (1.0 - b1) * g;
        v[i] = b2 * v[i] + (1.0 - b2) * g * g;
        let (mh, vh) = (m[i] / (1.0 - b1.powi(t as i32)), v[i] / (1.0 - b2.powi(t as i32)));
        p[i] -= a.rate as f64 * mh / (vh.sqrt() + a.epsilon as f64);
    }
}
