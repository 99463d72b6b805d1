//! Image quality: MSE, PSNR, SSIM and LPIPS.

pub mod lpips;

use diorama_geom::Image;
use diorama_kernels::ops::ssim;

/// Scores of one image against its photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageScores {
    pub mse: f64,
    /// `−10 log₁₀ mse`, dB.
    pub psnr: f64,
    pub ssim: f64,
    /// PSNR after the best affine map per channel, for captures of varying exposure.
    pub psnr_affine: f64,
}

/// Decibels of a mean squared error of values in [0, 1]; what is not a number stays so.
pub fn psnr(mse: f64) -> f64 {
    -10.0 * if mse < 1e-12 { 1e-12 } else { mse }.log10()
}

/// Compares images of equal size, 3 channels, over the pixels that `counts` admits; SSIM over the windows around them, of which
/// the pixels that do not count are no part. Not numbers where no pixel counts.
///
/// # Panics
/// When sizes differ.
pub fn compare(rendered: &Image, photo: &Image, counts: impl Fn(usize, usize) -> bool) -> ImageScores {
    assert_eq!((rendered.width, rendered.height, rendered.channels), (photo.width, photo.height, photo.channels), "scores");
    let pixels: Vec<usize> = (0..photo.width * photo.height).filter(|i| counts(i % photo.width, i / photo.width)).collect();
    let c = photo.channels;
    let error = |f: &dyn Fn(usize, f64) -> f64| {
        let sum: f64 = pixels
            .iter()
            .flat_map(|i| (0..c).map(move |k| i * c + k))
            .map(|e| (f(e % c, rendered.data[e] as f64) - photo.data[e] as f64).powi(2))
            .sum();
        sum / (pixels.len() * c) as f64
    };
    let mse = error(&|_, v| v);
    let fits: Vec<(f64, f64)> =
        (0..c).map(|k| affine_fit(pixels.iter().map(|i| (rendered.data[i * c + k] as f64, photo.data[i * c + k] as f64)))).collect();
    let affine = error(&|k, v| fits[k].0 * v + fits[k].1);
    let ssim = if pixels.len() == photo.width * photo.height {
        ssim::cpu::ssim(photo.width, photo.height, c, &rendered.data, &photo.data)
    } else {
        let mut admitted = vec![false; photo.width * photo.height];
        pixels.iter().for_each(|i| admitted[*i] = true);
        ssim::cpu::ssim_where(photo.width, photo.height, c, &rendered.data, &photo.data, &admitted)
    };
    ImageScores { mse, psnr: psnr(mse), ssim, psnr_affine: psnr(affine) }
}

/// Least-squares `y ≈ a x + b`.
fn affine_fit(points: impl Iterator<Item = (f64, f64)>) -> (f64, f64) {
    let (mut n, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (x, y) in points {
        n += 1.0;
        sx += x;
        sy += y;
        sxx += x * x;
        sxy += x * y;
    }
    let d = n * sxx - sx * sx;
    if d.abs() < 1e-12 {
        return (0.0, if n > 0.0 { sy / n } else { 0.0 });
    }
    let a = (n * sxy - sx * sy) / d;
    (a, (sy - a * sx) / n)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_that_is_no_number_is_no_perfect_score() {
        assert!(psnr(f64::NAN).is_nan() && (psnr(0.01) - 20.0).abs() < 1e-9);
    }

    #[test]
    fn affine_scores_forgive_exposure_and_nothing_else() {
        let photo = Image { width: 16, height: 16, channels: 3, data: (0..768).map(|i| (i * 37 % 256) as f32 / 255.0).collect() };
        let mut dim = photo.clone();
        dim.data.iter_mut().for_each(|v| *v = *v * 0.5 + 0.1);
        let s = compare(&dim, &photo, |_, _| true);
        assert!(s.psnr < 20.0 && s.psnr_affine > 80.0, "{s:?}");
        let same = compare(&photo, &photo, |_, _| true);
        assert!(same.psnr > 100.0 && (same.ssim - 1.0).abs() < 1e-9);
    }

    #[test]
    fn masked_pixels_do_not_count() {
        let photo = Image::zeros(16, 16, 3);
        let mut wrong = photo.clone();
        wrong.data[0] = 1.0;
        assert!(compare(&wrong, &photo, |_, _| true).psnr < 40.0);
        assert!(compare(&wrong, &photo, |x, y| x + y > 0).psnr > 100.0);
        assert!(compare(&wrong, &photo, |_, _| false).psnr.is_nan());
    }

    #[test]
    fn ssim_looks_at_the_pixels_that_count() {
        let texture = |i: usize| (i * 37 % 97) as f32 / 97.0;
        let photo = Image { width: 48, height: 32, channels: 3, data: (0..48 * 32 * 3).map(texture).collect() };
        let mut half = photo.clone();
        (0..half.data.len()).filter(|i| i / 3 % 48 >= 24).for_each(|i| half.data[i] = texture(i + 29));
        let all = compare(&half, &photo, |_, _| true).ssim;
        let left = compare(&half, &photo, |x, _| x < 24).ssim;
        let right = compare(&half, &photo, |x, _| x >= 24).ssim;
        assert!((left - 1.0).abs() < 1e-9 && right < 0.8 && (right..left).contains(&all), "{left} {all} {right}");
        // With all but one pixel in the corner, hardly anything changes.
        let nearly = compare(&half, &photo, |x, y| x + y > 0).ssim;
        assert!((nearly - all).abs() < 1e-3, "{nearly} {all}");
    }

    #[test]
    fn known_decibels() {
        assert!((psnr(0.01) - 20.0).abs() < 1e-9 && (psnr(0.0) - 120.0).abs() < 1e-9 && psnr(f64::NAN).is_nan());
        assert!((psnr(0.0033) - 24.81).abs() < 0.01);
    }
}
