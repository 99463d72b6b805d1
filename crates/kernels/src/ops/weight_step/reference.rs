//! The step in f64, one weight at a time.

use super::{Rule, Step};

/// Steps `p` and its moments `m`, `v` (empty where the rule has none).
///
/// # Shapes
/// All `[N]`.
pub fn step(s: &Step, p: &mut [f64], m: &mut [f64], v: &mut [f64], g: &[f64]) {
    let (rate, decay) = (s.rate as f64, s.weight_decay as f64);
    for i in 0..p.len() {
        let mut g = (g[i] * s.scale as f64).clamp(-s.limit as f64, s.limit as f64);
        match s.rule {
            Rule::Sgd { momentum, nesterov } => {
                let momentum = momentum as f64;
                g += decay * p[i];
                let direction = if momentum == 0.0 {
                    g
                } else {
                    m[i] = momentum * m[i] + g;
                    if nesterov { g + momentum * m[i] } else { m[i] }
                };
                p[i] -= rate * direction;
            }
            Rule::Adam { beta1, beta2, epsilon } | Rule::AdamW { beta1, beta2, epsilon } => {
                let (b1, b2) = (beta1 as f64, beta2 as f64);
                if matches!(s.rule, Rule::Adam { .. }) {
                    g += decay * p[i];
                } else {
                    p[i] *= 1.0 - rate * decay;
                }
                m[i] = b1 * m[i] + (1.0 - b1) * g;
                v[i] = b2 * v[i] + (1.0 - b2) * g * g;
                let (mean, square) = (m[i] / (1.0 - b1.powf(s.t as f64)), v[i] / (1.0 - b2.powf(s.t as f64)));
                p[i] -= rate * mean / (square.sqrt() + epsilon as f64);
            }
        }
    }
}
