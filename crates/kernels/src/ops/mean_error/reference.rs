//! Mean errors in f64.

use super::Error;

/// The mean; 0 of nothing.
pub fn forward(kind: Error, x: &[f64], y: &[f64]) -> f64 {
    let each = |e: f64| match kind {
        Error::Squared => e * e,
        Error::Absolute => e.abs(),
        Error::Huber(d) if e.abs() <= d as f64 => 0.5 * e * e,
        Error::Huber(d) => d as f64 * (e.abs() - 0.5 * d as f64),
    };
    x.iter().zip(y).map(|(x, y)| each(x - y)).sum::<f64>() / x.len().max(1) as f64
}

/// The gradient of x, given that of the mean.
pub fn backward(kind: Error, x: &[f64], y: &[f64], d: f64) -> Vec<f64> {
    let scale = d / x.len().max(1) as f64;
    let slope = |e: f64| match kind {
        Error::Squared => 2.0 * e,
        Error::Absolute => {
            if e == 0.0 {
                0.0
            } else {
                e.signum()
            }
        }
        Error::Huber(d) => e.clamp(-d as f64, d as f64),
    };
    x.iter().zip(y).map(|(x, y)| scale * slope(x - y)).collect()
}
