//! Plain loop.

/// `[R, 4]` for the pixels at byte offsets `at` `[R]`.
pub fn gather(bytes: &[u8], at: &[usize]) -> Vec<f64> {
    at.iter().flat_map(|&i| (0..4).map(move |k| bytes[i + k] as f64 / 255.0)).collect()
}
