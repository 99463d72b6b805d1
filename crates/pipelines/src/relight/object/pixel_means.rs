//! Pixels as means of the samples in them: pictures are drawn finer than photographs and compared at the photographs' size.

use rayon::prelude::*;

/// Means `[H, W, 4]` of `samples`² pixels each, `size` being height and width.
pub fn means(fine: &[f32], [h, w]: [usize; 2], samples: usize) -> Vec<f32> {
    let share = 1.0 / (samples * samples) as f32;
    let mut out = vec![0.0; 4 * h * w];
    out.par_chunks_mut(4 * w).enumerate().for_each(|(y, row)| {
        for fine in fine[4 * y * samples * samples * w..][..4 * samples * samples * w].chunks_exact(4 * samples * w) {
            for (to, from) in row.as_chunks_mut::<4>().0.iter_mut().zip(fine.chunks_exact(4 * samples)) {
                from.as_chunks::<4>().0.iter().for_each(|p| (0..4).for_each(|k| to[k] += share * p[k]));
            }
        }
    });
    out
}

/// `scale` times the gradient of what [`means`] are of.
pub fn means_backward(d: &[f32], [h, w]: [usize; 2], samples: usize, scale: f32) -> Vec<f32> {
    let share = scale / (samples * samples) as f32;
    let fine = samples * w;
    let mut out = vec![0.0; 4 * h * w * samples * samples];
    out.par_chunks_mut(4 * fine).enumerate().for_each(|(y, row)| {
        for (x, to) in row.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            let from = &d[4 * (y / samples * w + x / samples)..][..4];
            (0..4).for_each(|k| to[k] = share * from[k]);
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_testkit::random;

    #[test]
    fn means_are_of_the_samples_of_a_pixel_and_gradients_their_transpose() {
        let ([h, w], samples) = ([3, 5], 2);
        let (fine, d) = (random(4 * h * w * samples * samples, 1), random(4 * h * w, 2));
        let out = means(&fine, [h, w], samples);
        let at = |x: usize, y: usize| fine[4 * (y * samples * w + x) + 1];
        let want = 0.25 * (at(6, 2) + at(7, 2) + at(6, 3) + at(7, 3));
        assert!((out[4 * (w + 3) + 1] - want).abs() < 1e-6);
        let back = means_backward(&d, [h, w], samples, 2.0);
        let product = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a * b) as f64).sum::<f64>();
        assert!((2.0 * product(&out, &d) - product(&fine, &back)).abs() < 1e-4);
        assert_eq!(means(&fine, [h * samples, w * samples], 1), fine);
    }
}
