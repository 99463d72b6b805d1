//! Plain loops in f64.

/// `offsets[r] = Σ_{q<r} counts[q]`, `[R + 1]`.
pub fn exclusive(counts: &[u32]) -> Vec<u32> {
    (0..=counts.len()).map(|r| counts[..r].iter().sum()).collect()
}

/// `out[i] = Σ_{j≤i, same ray} x[j]`.
pub fn inclusive(offsets: &[u32], x: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; x.len()];
    for w in offsets.windows(2) {
        for i in w[0] as usize..w[1] as usize {
            out[i] = x[w[0] as usize..=i].iter().sum();
        }
    }
    out
}

/// `g[j] = Σ_{i≥j, same ray} d[i]`.
pub fn inclusive_backward(offsets: &[u32], d: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; d.len()];
    for w in offsets.windows(2) {
        for j in w[0] as usize..w[1] as usize {
            out[j] = d[j..w[1] as usize].iter().sum();
        }
    }
    out
}
