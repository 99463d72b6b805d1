//! Phases in f64, so that high bands keep their digits.

/// Position within the period of 2, and the scale of band `k`.
#[inline(always)]
fn phase(v: f32, k: usize) -> (f64, f64) {
    let scale = (1u64 << k) as f64;
    let p = v as f64 * scale + 0.5 * k as f64;
    (p - 2.0 * (p * 0.5).floor(), scale)
}

/// x `[N, dims]` to out `[N, dims · bands]`, all of it written.
pub fn forward(dims: usize, bands: usize, x: &[f32], out: &mut [f32]) {
    assert_eq!(out.len(), x.len() * bands, "triangle wave of {dims} dims: shapes");
    for (v, o) in x.iter().zip(out.chunks_exact_mut(bands.max(1))) {
        for (k, o) in o.iter_mut().enumerate() {
            *o = (2.0 * (phase(*v, k).0 - 1.0).abs() - 1.0) as f32;
        }
    }
}

/// Gradient of x, overwritten.
pub fn backward(dims: usize, bands: usize, x: &[f32], d: &[f32], g: &mut [f32]) {
    assert_eq!(d.len(), x.len() * bands, "triangle wave of {dims} dims: shapes");
    for ((v, d), g) in x.iter().zip(d.chunks_exact(bands.max(1))).zip(g) {
        *g = d
            .iter()
            .enumerate()
            .map(|(k, d)| {
                let (p, scale) = phase(*v, k);
                scale * if p >= 1.0 { 2.0 } else { -2.0 } * *d as f64
            })
            .sum::<f64>() as f32;
    }
}

/// Derivatives of the encoding along `v` `[N, dims]`, `[N, dims · bands]`, overwritten.
pub fn tangent(dims: usize, bands: usize, x: &[f32], v: &[f32], out: &mut [f32]) {
    assert_eq!(out.len(), x.len() * bands, "triangle wave of {dims} dims: shapes");
    for ((x, v), o) in x.iter().zip(v).zip(out.chunks_exact_mut(bands.max(1))) {
        for (k, o) in o.iter_mut().enumerate() {
            let (p, scale) = phase(*x, k);
            *o = (scale * if p >= 1.0 { 2.0 } else { -2.0 }) as f32 * v;
        }
    }
}
