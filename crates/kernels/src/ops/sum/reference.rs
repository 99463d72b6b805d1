//! The sum and its gradient in f64.

/// `y = a + b`, at least 0 where `relu` says so.
pub fn forward(a: &[f64], b: &[f64], relu: bool) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| if relu { (a + b).max(0.0) } else { a + b }).collect()
}

/// The gradient of both terms.
pub fn backward(a: &[f64], b: &[f64], relu: bool, d: &[f64]) -> Vec<f64> {
    a.iter().zip(b).zip(d).map(|((a, b), d)| if relu && a + b <= 0.0 { 0.0 } else { *d }).collect()
}
