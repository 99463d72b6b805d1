//! Plain loops in f64.

use super::Frequency;

fn angle_scale(f: &Frequency, k: usize) -> f64 {
    (1u64 << k) as f64 * if f.pi { std::f64::consts::PI } else { 1.0 }
}

/// `[N, dims]` to `[N, output_dims]`.
pub fn forward(f: &Frequency, x: &[f64]) -> Vec<f64> {
    let mut out = Vec::new();
    for row in x.chunks_exact(f.dims) {
        if f.include_input {
            out.extend_from_slice(row);
        }
        for k in 0..f.bands {
            let (s, w) = (angle_scale(f, k), f.band_weight(k));
            out.extend(row.iter().map(|v| w * (s * v).sin()));
            out.extend(row.iter().map(|v| w * (s * v).cos()));
        }
    }
    out
}

/// Gradient of the input.
pub fn backward(f: &Frequency, x: &[f64], d_out: &[f64]) -> Vec<f64> {
    let mut dx = vec![0.0; x.len()];
    for (n, row) in x.chunks_exact(f.dims).enumerate() {
        let d = &d_out[n * f.output_dims()..(n + 1) * f.output_dims()];
        for (i, v) in row.iter().enumerate() {
            let mut g = if f.include_input { d[i] } else { 0.0 };
            for k in 0..f.bands {
                let (s, w) = (angle_scale(f, k), f.band_weight(k));
                let at = f.dims * (f.include_input as usize + 2 * k) + i;
                g += w * s * (d[at] * (s * v).cos() - d[at + f.dims] * (s * v).sin());
            }
            dx[n * f.dims + i] = g;
        }
    }
    dx
}

/// Derivatives of the encoding along `v` `[N, dims]`.
pub fn tangent(f: &Frequency, x: &[f64], v: &[f64]) -> Vec<f64> {
    let mut out = Vec::new();
    for (row, v) in x.chunks_exact(f.dims).zip(v.chunks_exact(f.dims)) {
        if f.include_input {
            out.extend_from_slice(v);
        }
        for k in 0..f.bands {
            let (s, w) = (angle_scale(f, k), f.band_weight(k));
            out.extend(row.iter().zip(v).map(|(x, v)| w * s * (s * x).cos() * v));
            out.extend(row.iter().zip(v).map(|(x, v)| -w * s * (s * x).sin() * v));
        }
    }
    out
}
