//! Plain loops in f64.

/// Where in the period of 2 band `k` is.
fn phase(x: f64, k: usize) -> f64 {
    (x * (1u64 << k) as f64 + 0.5 * k as f64).rem_euclid(2.0)
}

fn slope(x: f64, k: usize) -> f64 {
    (1u64 << k) as f64 * if phase(x, k) >= 1.0 { 2.0 } else { -2.0 }
}

/// `[N, dims]` to `[N, dims · bands]`.
pub fn forward(bands: usize, x: &[f64]) -> Vec<f64> {
    x.iter().flat_map(|v| (0..bands).map(move |k| 2.0 * (phase(*v, k) - 1.0).abs() - 1.0)).collect()
}

/// Gradient of x.
pub fn backward(bands: usize, x: &[f64], d: &[f64]) -> Vec<f64> {
    x.iter().enumerate().map(|(i, v)| (0..bands).map(|k| slope(*v, k) * d[i * bands + k]).sum()).collect()
}

/// Derivatives of the encoding along `v` `[N, dims]`.
pub fn tangent(bands: usize, x: &[f64], v: &[f64]) -> Vec<f64> {
    x.iter().zip(v).flat_map(|(x, v)| (0..bands).map(move |k| slope(*x, k) * v)).collect()
}
