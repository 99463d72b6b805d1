//! In place, parallel over chunks, compiled for each instruction set.

use super::{Rule, Step};
use crate::math::multiversion;
use rayon::prelude::*;

/// Weights per task; elements are independent, so that it changes no result.
const CHUNK: usize = 1 << 14;

/// Steps weights and their moments (empty where the rule has none).
///
/// # Shapes
/// p, g: `[N]`; m, v: `[N]` or empty, as [`Rule::moments`] says.
///
/// # Panics
/// When lengths differ.
pub fn step(s: &Step, p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &[f32]) {
    let moments = s.rule.moments();
    let has = |x: &[f32], wanted: bool| x.len() == if wanted { p.len() } else { 0 };
    assert!(p.len() == g.len() && has(m, moments >= 1) && has(v, moments >= 2), "weight step: lengths");
    let shared = p.par_chunks_mut(CHUNK).zip(g.par_chunks(CHUNK));
    match s.rule {
        Rule::Sgd { momentum, .. } if moments == 0 => {
            debug_assert_eq!(momentum, 0.0);
            shared.for_each(|(p, g)| plain(s, p, g));
        }
        Rule::Sgd { momentum, nesterov } => shared.zip(m.par_chunks_mut(CHUNK)).for_each(|((p, g), m)| {
            let look_ahead = if nesterov { (1.0, momentum) } else { (0.0, 1.0) };
            with_momentum(s, momentum, look_ahead, p, m, g);
        }),
        Rule::Adam { beta1, beta2, epsilon } | Rule::AdamW { beta1, beta2, epsilon } => {
            let decoupled = matches!(s.rule, Rule::AdamW { .. });
            let (b1, b2, t) = (beta1 as f64, beta2 as f64, s.t as f64);
            let f = Factors {
                beta1,
                beta2,
                epsilon,
                decay: if decoupled { 0.0 } else { s.weight_decay },
                shrink: if decoupled { 1.0 - s.rate * s.weight_decay } else { 1.0 },
                step: (s.rate as f64 / (1.0 - b1.powf(t))) as f32,
                root: (1.0 / (1.0 - b2.powf(t))).sqrt() as f32,
            };
            shared.zip(m.par_chunks_mut(CHUNK)).zip(v.par_chunks_mut(CHUNK)).for_each(|(((p, g), m), v)| adam(s, &f, p, m, v, g));
        }
    }
}

/// Factors that all elements of an Adam step share.
struct Factors {
    beta1: f32,
    beta2: f32,
    epsilon: f32,
    decay: f32,
    shrink: f32,
    step: f32,
    root: f32,
}

multiversion! {
    fn plain(s: &Step, p: &mut [f32], g: &[f32]) {
        for (p, g) in p.iter_mut().zip(g) {
            let g = (g * s.scale).clamp(-s.limit, s.limit) + s.weight_decay * *p;
            *p -= s.rate * g;
        }
    }
}

multiversion! {
    fn with_momentum(s: &Step, momentum: f32, look_ahead: (f32, f32), p: &mut [f32], m: &mut [f32], g: &[f32]) {
        for ((p, m), g) in p.iter_mut().zip(m).zip(g) {
            let g = (g * s.scale).clamp(-s.limit, s.limit) + s.weight_decay * *p;
            *m = momentum * *m + g;
            *p -= s.rate * (look_ahead.0 * g + look_ahead.1 * *m);
        }
    }
}

multiversion! {
    fn adam(s: &Step, f: &Factors, p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &[f32]) {
        for (((p, m), v), g) in p.iter_mut().zip(m).zip(v).zip(g) {
            let g = (g * s.scale).clamp(-s.limit, s.limit) + f.decay * *p;
            *m = f.beta1 * *m + (1.0 - f.beta1) * g;
            *v = f.beta2 * *v + (1.0 - f.beta2) * g * g;
            *p = *p * f.shrink - f.step * *m / (v.sqrt() * f.root + f.epsilon);
        }
    }
}
