//! Element by element in f64.

use super::Dropout;

/// `x` where it is kept, scaled; the gradient of `x` from that of the output, too.
pub fn apply(dropout: &Dropout, x: &[f64]) -> Vec<f64> {
    let kept = |i: usize| dropout.rng.uniform(dropout.first.wrapping_add(i as u64)) >= dropout.p;
    x.iter().enumerate().map(|(i, x)| if kept(i) { x / (1.0 - dropout.p as f64) } else { 0.0 }).collect()
}
