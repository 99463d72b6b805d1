//! Plain loops in f64.

fn wave(v: f64) -> f64 {
    2.0 * ((v + 0.5).rem_euclid(2.0) - 1.0).abs() - 1.0
}

/// `[N, dims]` to `[N, dims · bands]`.
pub fn forward(bands: usize, x: &[f64]) -> Vec<f64> {
    x.iter().flat_map(|v| (0..bands).map(move |k| wave(v * (1u64 << k) as f64))).collect()
}

/// Gradient of x.
pub fn backward(bands: usize, x: &[f64], d: &[f64]) -> Vec<f64> {
    let slope = |v: f64| if (v + 0.5).rem_euclid(2.0) >= 1.0 { 2.0 } else { -2.0 };
    x.iter()
        .enumerate()
        .map(|(i, v)| (0..bands).map(|k| (1u64 << k) as f64 * slope(v * (1u64 << k) as f64) * d[i * bands + k]).sum())
        .collect()
}

/// Derivatives of the encoding along `v` `[N, dims]`.
pub fn tangent(bands: usize, x: &[f64], v: &[f64]) -> Vec<f64> {
    let slopes = backward(
        1,
        &x.iter().flat_map(|x| (0..bands).map(move |k| x * (1u64 << k) as f64)).collect::<Vec<_>>(),
        &vec![1.0; x.len() * bands],
    );
    slopes.iter().enumerate().map(|(i, s)| s * (1u64 << (i % bands)) as f64 * v[i / bands]).collect()
}
