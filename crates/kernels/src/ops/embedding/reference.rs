//! Row by row in f64.

/// Rows of the table, `[N, d]`.
pub fn forward(d: usize, table: &[f64], indices: &[i64]) -> Vec<f64> {
    indices.iter().flat_map(|i| table[*i as usize * d..][..d].iter().copied()).collect()
}

/// Gradient of a table of `rows` rows, `[V, d]`.
pub fn backward(rows: usize, d: usize, indices: &[i64], d_out: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; rows * d];
    for (n, i) in indices.iter().enumerate() {
        for k in 0..d {
            out[*i as usize * d + k] += d_out[n * d + k];
        }
    }
    out
}
