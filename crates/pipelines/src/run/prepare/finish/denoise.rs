//! Non-local means: each pixel becomes the mean of nearby pixels, weighted by the similarity of the patches around them (Buades, Coll and
//! Morel, "Non-local means denoising", Image Processing On Line, 2011).

use diorama_geom::ImageU8;
use rayon::prelude::*;

/// Radius in pixels of the compared patches, and of the search window.
const PATCH: usize = 1;
const WINDOW: i32 = 7;
/// Filter strength h over the noise's standard deviation, for small color patches.
const STRENGTH: f32 = 0.55;
/// Rows per parallel task.
const ROWS: usize = 64;

/// Estimates the standard deviation of the noise in 8-bit steps from the response to a Laplacian-difference mask (Immerkær, "Fast noise
/// variance estimation", 1996); the median in place of the mean makes it robust against edges.
pub fn noise(im: &ImageU8) -> f32 {
    if im.width < 3 || im.height < 3 {
        return 0.0;
    }
    const MASK: [[i32; 3]; 3] = [[1, -2, 1], [-2, 4, -2], [1, -2, 1]];
    let gray = |x: usize, y: usize| im.pixel(x, y)[im.channels.min(3) / 2] as i32;
    // Subsampled to about a million responses; the mask's squared norm is 36, hence σ = median / 0.6745 / 6.
    let step = ((im.width * im.height) as f64 / 1e6).sqrt().ceil().max(1.0) as usize;
    let mut counts = vec![0usize; 8 * 255 + 1];
    for y in (1..im.height - 1).step_by(step) {
        for x in (1..im.width - 1).step_by(step) {
            let r: i32 = (0..9).map(|k| MASK[k / 3][k % 3] * gray(x + k % 3 - 1, y + k / 3 - 1)).sum();
            counts[r.unsigned_abs() as usize] += 1;
        }
    }
    let half = counts.iter().sum::<usize>() / 2;
    let mut below = 0;
    let at = counts.iter().position(|c| {
        below += c;
        below > half
    });
    // Interpolate the median within its bin, so that weak noise does not round to 0.
    let at = at.unwrap_or(0);
    let within = 1.0 - (below - half) as f32 / counts[at].max(1) as f32;
    let median = (at as f32 - 0.5 + within).max(0.0);
    median / 0.6745 / 6.0
}

/// Removes noise of standard deviation `sigma` (in 8-bit steps); alpha is unchanged.
pub fn denoise(im: &ImageU8, sigma: f32) -> ImageU8 {
    if sigma < 0.5 || im.channels < 3 {
        return im.clone();
    }
    let bands: Vec<Vec<u8>> =
        (0..im.height.div_ceil(ROWS)).into_par_iter().map(|b| band(im, b * ROWS, ((b + 1) * ROWS).min(im.height), sigma)).collect();
    ImageU8 { data: bands.concat(), ..*im }
}

/// Rows `first..last` of the result.
fn band(im: &ImageU8, first: usize, last: usize, sigma: f32) -> Vec<u8> {
    let (w, rows, c) = (im.width, last - first, im.channels);
    let clamp = |v: i64, n: usize| v.clamp(0, n as i64 - 1) as usize;
    // Squared pixel differences are summed over patches: first along rows, then along columns.
    let (margin, side) = (PATCH as i64, 2 * PATCH + 1);
    let scale = 1.0 / (3 * side * side) as f32;
    let fall = 1.0 / (STRENGTH * sigma).powi(2);
    let mut sums = vec![[0.0f32; 4]; w * rows];
    let mut squares = vec![0.0f32; (w + 2 * PATCH) * (rows + 2 * PATCH)];
    let mut along = vec![0.0f32; w * (rows + 2 * PATCH)];
    for dy in -WINDOW..=WINDOW {
        for dx in -WINDOW..=WINDOW {
            for y in 0..rows + 2 * PATCH {
                let (ya, yb) = (first as i64 + y as i64 - margin, first as i64 + y as i64 - margin + dy as i64);
                let (ya, yb) = (clamp(ya, im.height) * w, clamp(yb, im.height) * w);
                for x in 0..w + 2 * PATCH {
                    let xa = x as i64 - margin;
                    let (a, b) = (&im.data[(ya + clamp(xa, w)) * c..][..3], &im.data[(yb + clamp(xa + dx as i64, w)) * c..][..3]);
                    let d: [i32; 3] = std::array::from_fn(|k| a[k] as i32 - b[k] as i32);
                    squares[y * (w + 2 * PATCH) + x] = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) as f32;
                }
            }
            for (out, row) in along.chunks_exact_mut(w).zip(squares.chunks_exact(w + 2 * PATCH)) {
                for (o, s) in out.iter_mut().zip(row.windows(side)) {
                    *o = s.iter().sum();
                }
            }
            for y in 0..rows {
                let from = clamp((first + y) as i64 + dy as i64, im.height) * w;
                for x in 0..w {
                    let d: f32 = (0..side).map(|k| along[(y + k) * w + x]).sum::<f32>() * scale;
                    let excess = (d - 2.0 * sigma * sigma).max(0.0) * fall;
                    if excess < 12.0 {
                        let weight = (-excess).exp();
                        let q = &im.data[(from + clamp(x as i64 + dx as i64, w)) * c..][..3];
                        let s = &mut sums[y * w + x];
                        (0..3).for_each(|k| s[k] += weight * q[k] as f32);
                        s[3] += weight;
                    }
                }
            }
        }
    }
    let mut out = im.data[first * w * c..last * w * c].to_vec();
    for (o, s) in out.chunks_exact_mut(c).zip(&sums) {
        (0..3).for_each(|k| o[k] = (s[k] / s[3] + 0.5) as u8);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::rng::Rng;

    /// An image of flat regions, ramps and fine stripes.
    fn picture() -> ImageU8 {
        let (w, h) = (160, 120);
        let at = |i: usize| {
            let (x, y) = (i % w, i / w);
            let stripes = if x > 80 && y > 60 && x / 3 % 2 == 0 { 90 } else { 0 };
            [(60 + x / 2 + stripes) as u8, if y < 40 { 200 } else { 80 }, (40 + y) as u8]
        };
        ImageU8 { width: w, height: h, channels: 3, data: (0..w * h).flat_map(at).collect() }
    }

    fn with_noise(im: &ImageU8, sigma: f32) -> ImageU8 {
        let rng = Rng::new(5, 0);
        let noisy = |(i, v): (usize, &u8)| (*v as f32 + sigma * rng.normal(i as u64)).round().clamp(0.0, 255.0) as u8;
        ImageU8 { data: im.data.iter().enumerate().map(noisy).collect(), ..*im }
    }

    fn psnr(a: &ImageU8, b: &ImageU8) -> f64 {
        let mse = a.data.iter().zip(&b.data).map(|(x, y)| (*x as f64 - *y as f64).powi(2)).sum::<f64>() / a.data.len() as f64;
        10.0 * (255.0f64.powi(2) / mse.max(1e-9)).log10()
    }

    #[test]
    fn noise_is_measured_and_removed() {
        let clean = picture();
        for sigma in [4.0, 10.0, 20.0] {
            let noisy = with_noise(&clean, sigma);
            let found = noise(&noisy);
            assert!((found / sigma - 1.0).abs() < 0.2, "{found} for {sigma}");
            let gain = psnr(&denoise(&noisy, found), &clean) - psnr(&noisy, &clean);
            assert!(gain > 4.0, "{gain} dB at {sigma}");
        }
    }

    #[test]
    fn a_clean_picture_stays() {
        let clean = picture();
        assert!(noise(&clean) < 0.5);
        assert_eq!(denoise(&clean, noise(&clean)), clean);
    }
}
