//! Comparators, gradient checks and random inputs for tests.
//!
//! ```
//! use diorama_testkit::{assert_close, assert_gradient};
//!
//! assert_close("a third", &[0.333_333_3], &[1.0 / 3.0], 1e-6);
//! // f(x, y) = x² + 3 y has the gradient (2 x, 3).
//! assert_gradient("f", &[4.0, 3.0], &[2.0, 1.0], 1e-6, |x| x[0] * x[0] + 3.0 * x[1]);
//! ```

use diorama_geom::rng::Rng;

/// `n` numbers in [-1, 1), the same for the same seed.
pub fn random(n: usize, seed: u64) -> Vec<f32> {
    let rng = Rng::new(seed, 0x7e57);
    (0..n as u64).map(|i| rng.uniform(i) * 2.0 - 1.0).collect()
}

/// `n` numbers in [0, 1).
pub fn random_unit(n: usize, seed: u64) -> Vec<f32> {
    random(n, seed).into_iter().map(|v| (v * 0.5 + 0.5).min(0.999_999)).collect()
}

/// Compares with the criterion `|a − b| ≤ tolerance · (|b| + rms b)`. Returns the largest error relative to `|b| + rms b`.
///
/// # Errors
/// A message with the first element that violates the criterion, or with the lengths if they differ.
pub fn compare(a: &[f32], b: &[f64], tolerance: f64) -> Result<f64, String> {
    if a.len() != b.len() {
        return Err(format!("lengths differ: {} and {}", a.len(), b.len()));
    }
    let rms = (b.iter().map(|v| v * v).sum::<f64>() / b.len().max(1) as f64).sqrt();
    let mut worst = 0.0f64;
    for (i, (&x, &y)) in a.iter().zip(b).enumerate() {
        let error = (x as f64 - y).abs();
        let scale = y.abs() + rms;
        // Written so that NaN on either side fails.
        if !(error <= tolerance * scale || error == 0.0) {
            return Err(format!("element {i}: {x} is not {y} (error {error:.3e}, allowed {:.3e})", tolerance * scale));
        }
        worst = worst.max(if scale > 0.0 { error / scale } else { 0.0 });
    }
    Ok(worst)
}

/// [`compare`], which must also refuse the same numbers with one of them wrong: off by twice what is allowed, or NaN. So every comparison
/// of every op shows that it could have failed.
pub fn compare_proven(a: &[f32], b: &[f64], tolerance: f64) -> Result<f64, String> {
    let worst = compare(a, b, tolerance)?;
    let rms = (b.iter().map(|v| v * v).sum::<f64>() / b.len().max(1) as f64).sqrt();
    let Some(largest) = (0..b.len()).max_by(|i, j| b[*i].abs().total_cmp(&b[*j].abs())) else { return Ok(worst) };
    let mut spoiled = a.to_vec();
    for i in [0, b.len() / 2, b.len() - 1, largest] {
        let allowed = tolerance * (b[i].abs() + rms);
        let mut off = (b[i] + 2.0 * allowed) as f32;
        if (off as f64 - b[i]).abs() <= allowed {
            off = off.next_up();
        }
        for wrong in [off, f32::NAN] {
            let right = std::mem::replace(&mut spoiled[i], wrong);
            if compare(&spoiled, b, tolerance).is_ok() {
                return Err(format!("the comparison does not notice {wrong} in place of {right} (element {i})"));
            }
            spoiled[i] = right;
        }
    }
    Ok(worst)
}

/// Panics with `what` unless [`compare_proven`] succeeds.
#[track_caller]
pub fn assert_close(what: &str, a: &[f32], b: &[f64], tolerance: f64) {
    if let Err(e) = compare_proven(a, b, tolerance) {
        panic!("{what}: {e}");
    }
}

/// Gradient of `f` at `x` by central differences: one parameter at a time, with step `h`.
pub fn central_differences(x: &[f64], h: f64, mut f: impl FnMut(&[f64]) -> f64) -> Vec<f64> {
    let mut x = x.to_vec();
    (0..x.len())
        .map(|i| {
            let keep = x[i];
            x[i] = keep + h;
            let up = f(&x);
            x[i] = keep - h;
            let down = f(&x);
            x[i] = keep;
            (up - down) / (2.0 * h)
        })
        .collect()
}

/// Panics unless `gradient` equals the central differences of `f` within `tolerance`.
#[track_caller]
pub fn assert_gradient(what: &str, gradient: &[f64], x: &[f64], tolerance: f64, f: impl FnMut(&[f64]) -> f64) {
    let numeric = central_differences(x, 1e-5, f);
    let gradient: Vec<f32> = gradient.iter().map(|&v| v as f32).collect();
    assert_close(what, &gradient, &numeric, tolerance);
}

/// Converts to f64, for reference implementations.
pub fn wide(x: &[f32]) -> Vec<f64> {
    x.iter().map(|&v| v as f64).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_passes() {
        assert_eq!(compare(&[1.0, -2.0], &[1.0, -2.0], 1e-6), Ok(0.0));
        assert_eq!(compare(&[0.0], &[0.0], 0.0), Ok(0.0));
    }

    #[test]
    fn one_wrong_element_fails() {
        assert!(compare(&[1.0, 2.0, 3.0], &[1.0, 2.0, 3.001], 1e-4).is_err());
    }

    #[test]
    fn nan_and_infinity_fail() {
        assert!(compare(&[f32::NAN], &[1.0], 1.0).is_err());
        assert!(compare(&[1.0], &[f64::NAN], 1.0).is_err());
        assert!(compare(&[f32::INFINITY], &[1.0], 1.0).is_err());
    }

    #[test]
    fn a_comparison_that_notices_nothing_fails() {
        assert_eq!(compare_proven(&[1.0, 0.0, -3.0], &[1.0, 0.0, -3.0], 1e-6), Ok(0.0));
        assert_eq!(compare_proven(&[0.0], &[0.0], 0.0), Ok(0.0));
        assert_eq!(compare_proven(&[], &[], 1e-6), Ok(0.0));
        assert!(compare_proven(&[1.0, 2.0], &[1.0, 2.1], 1e-3).is_err());
        let blind = compare_proven(&[1.0, 2.0], &[1.0, 2.0], f64::INFINITY);
        assert!(blind.unwrap_err().contains("does not notice"));
    }

    #[test]
    fn a_missing_element_fails() {
        assert!(compare(&[1.0], &[1.0, 1.0], 1.0).is_err());
    }

    #[test]
    fn a_wrong_gradient_fails() {
        let f = |x: &[f64]| x[0] * x[0] + 3.0 * x[1];
        assert_gradient("right", &[4.0, 3.0], &[2.0, 1.0], 1e-6, f);
        let caught = std::panic::catch_unwind(|| assert_gradient("wrong", &[4.0, -3.0], &[2.0, 1.0], 1e-6, f));
        assert!(caught.is_err());
    }
}
