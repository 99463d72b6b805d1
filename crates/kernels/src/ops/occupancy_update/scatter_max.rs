//! `out[i] ← max(out[i], v)` for scattered indices, from all threads at once.

use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering};

/// Pairs per task.
const TASK: usize = 1 << 12;

/// Raises `out[index]` to `value` for each pair; negative values are passed over, and a value of 0 counts as
/// the smallest number above it, so that it differs from an untouched 0. The order of pairs does not matter.
///
/// # Shapes
/// indices and values `[N]`, every index below the length of `out`, whose numbers are not negative.
///
/// # Panics
/// When an index is too high.
pub(super) fn scatter_max(indices: &[u32], values: &[f32], out: &mut [f32]) {
    // SAFETY: f32 and AtomicU32 have the same size and alignment, any bits are valid for both, and the
    // exclusive borrow outlives the slice.
    let out: &[AtomicU32] = unsafe { std::slice::from_raw_parts(out.as_mut_ptr().cast(), out.len()) };
    indices.par_chunks(TASK).zip(values.par_chunks(TASK)).for_each(|(indices, values)| {
        for (&i, &v) in indices.iter().zip(values) {
            // The bits of numbers that are not negative are in the order of the numbers.
            let bits = v.max(f32::MIN_POSITIVE).to_bits();
            let cell = &out[i as usize];
            if v >= 0.0 && cell.load(Ordering::Relaxed) < bits {
                cell.fetch_max(bits, Ordering::Relaxed);
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_testkit::random;

    #[test]
    fn it_matches_a_plain_loop() {
        let values = random(50_000, 1);
        let indices: Vec<u32> = random(50_000, 2).iter().map(|u| ((u + 1.0) * 50.0) as u32 % 100).collect();
        let mut out = vec![0.0; 101];
        scatter_max(&indices, &values, &mut out);
        let mut want = vec![0.0f32; 101];
        for (&i, &v) in indices.iter().zip(&values) {
            want[i as usize] = want[i as usize].max(v);
        }
        assert_eq!(out, want);
        scatter_max(&[100], &[0.0], &mut out);
        assert!(out[100] > 0.0, "a zero leaves its trace");
    }
}
