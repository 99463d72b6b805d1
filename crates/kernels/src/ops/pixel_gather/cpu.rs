//! One multiplication per byte.

/// Writes one pixel's four bytes as floats.
#[inline]
pub fn convert(rgba: [u8; 4]) -> [f32; 4] {
    rgba.map(|v| v as f32 * (1.0 / 255.0))
}

/// Fills `out` `[R, 4]` from the pixels at byte offsets `at` `[R]`.
pub fn gather(bytes: &[u8], at: &[usize], out: &mut [f32]) {
    for (&i, o) in at.iter().zip(out.chunks_exact_mut(4)) {
        o.copy_from_slice(&convert([bytes[i], bytes[i + 1], bytes[i + 2], bytes[i + 3]]));
    }
}
