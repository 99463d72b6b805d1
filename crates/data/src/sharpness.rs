//! Sharpness of photographs and frames of videos, and which of a sequence are sharp.

use crate::error::Result;
use crate::photo;
use std::path::Path;

/// Shorter side in pixels at which sharpness is measured; smaller pictures are measured as they are.
pub const SHORT_SIDE: usize = 512;
/// A picture is blurred if its sharpness is below this share of the median of its neighbors'.
const BLURRED: f32 = 0.35;
/// Neighbors on each side that the median is taken of, besides the picture itself.
const NEIGHBORS: usize = 5;

/// Variance of the Laplacian of a photograph in gray levels, at a shorter side of [`SHORT_SIDE`] pixels.
///
/// # Errors
/// If the photograph cannot be decoded.
pub fn of_photograph(file: &Path) -> Result<f32> {
    let image = photo::load(file)?;
    let by = (SHORT_SIDE as f64 / image.width.min(image.height) as f64).min(1.0);
    let side = |v: usize| ((v as f64 * by).round() as usize).max(1);
    let small = image.downsampled(side(image.width), side(image.height));
    let luma = |p: &[u8]| ((p[0] as u32 * 2 + p[1] as u32 * 5 + p[2] as u32) / 8) as u8;
    let gray: Vec<u8> = small.data.chunks_exact(small.channels).map(|p| if p.len() < 3 { p[0] } else { luma(p) }).collect();
    Ok(laplacian_variance(&gray, small.width))
}

/// Positions of the sharpest of each of `windows` equal parts of a sequence, in order, without those that are blurred: below 0.35 times the
/// median of the sharpest of their own and of five parts on each side.
pub fn sharp(sharpness: &[f32], windows: usize) -> Vec<usize> {
    let best = sharpest(sharpness, windows);
    let is_sharp = |k: usize| {
        let mut near: Vec<f32> =
            best[k.saturating_sub(NEIGHBORS)..best.len().min(k + NEIGHBORS + 1)].iter().map(|i| sharpness[*i]).collect();
        near.sort_by(f32::total_cmp);
        sharpness[best[k]] >= BLURRED * near[near.len() / 2]
    };
    (0..best.len()).filter(|k| is_sharp(*k)).map(|k| best[k]).collect()
}

/// Variance of the 4-neighbor Laplacian of a gray image that is `width` pixels wide.
pub fn laplacian_variance(gray: &[u8], width: usize) -> f32 {
    let height = gray.len() / width;
    let (mut sum, mut squares, mut n) = (0.0f64, 0.0f64, 0.0f64);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width - 1 {
            let i = y * width + x;
            let v = |i: usize| gray[i] as f64;
            let l = v(i - 1) + v(i + 1) + v(i - width) + v(i + width) - 4.0 * v(i);
            (sum, squares, n) = (sum + l, squares + l * l, n + 1.0);
        }
    }
    if n > 0.0 { (squares / n - (sum / n).powi(2)) as f32 } else { 0.0 }
}

/// The sharpest frame of each of `count` equal intervals.
pub(crate) fn sharpest(sharpness: &[f32], count: usize) -> Vec<usize> {
    let (n, count) = (sharpness.len(), count.clamp(1, sharpness.len().max(1)));
    (0..count)
        .filter_map(|i| (i * n / count..(i + 1) * n / count).max_by(|a, b| sharpness[*a].total_cmp(&sharpness[*b]).then(b.cmp(a))))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::ImageU8;

    #[test]
    fn blurred_ones_are_left_out_by_the_median_around_them() {
        // Windows of two; the fourth has two blurred ones. The second half of the sequence is less sharp as a whole.
        let all = [9.0, 10.0, 10.0, 8.0, 9.0, 10.0, 3.4, 3.3, 10.0, 9.0, 10.0, 1.0];
        assert_eq!(sharp(&all, 6), [1, 2, 5, 8, 10]);
        // A dark part of a film is measured by itself.
        let dim: Vec<f32> = [10.0; 20].into_iter().chain([3.0; 20]).collect();
        assert_eq!(sharp(&dim, 40).len(), 40);
        assert_eq!(sharp(&[5.0], 65), [0]);
        assert!(sharp(&[], 65).is_empty());
    }

    #[test]
    fn photographs_are_measured_at_one_size() {
        let dir = tempfile::tempdir().unwrap();
        let write = |name: &str, side: usize, square: usize| {
            let data = (0..side * side)
                .flat_map(|i| [if (i % side / square + i / side / square).is_multiple_of(2) { 200 } else { 50 }; 3])
                .collect();
            photo::save_png(&dir.path().join(name), &ImageU8 { width: side, height: side, channels: 3, data }).unwrap();
            of_photograph(&dir.path().join(name)).unwrap()
        };
        let (small, large, coarse) = (write("small.png", 512, 8), write("large.png", 1024, 16), write("coarse.png", 512, 64));
        assert!((small / large - 1.0).abs() < 0.02 && coarse < 0.2 * small, "{small} {large} {coarse}");
        assert!(of_photograph(&dir.path().join("none.png")).is_err());
    }

    #[test]
    fn the_sharpest_of_each_stretch_is_taken() {
        assert_eq!(sharpest(&[1.0, 5.0, 2.0, 9.0, 9.0, 1.0], 2), [1, 3]);
        assert_eq!(sharpest(&[1.0; 3], 9), [0, 1, 2]);
    }

    #[test]
    fn blur_lowers_the_variance() {
        let sharp: Vec<u8> = (0..64 * 64).map(|i| if (i / 64 / 4 + i % 64 / 4) % 2 == 0 { 255 } else { 0 }).collect();
        let at = |x: i32, y: i32| sharp[(y.clamp(0, 63) * 64 + x.clamp(0, 63)) as usize] as u32;
        let blurred: Vec<u8> =
            (0..64 * 64i32).map(|i| ((0..25).map(|k| at(i % 64 + k % 5 - 2, i / 64 + k / 5 - 2)).sum::<u32>() / 25) as u8).collect();
        assert!(laplacian_variance(&sharp, 64) > 10.0 * laplacian_variance(&blurred, 64));
        assert_eq!(laplacian_variance(&[7; 64], 8), 0.0);
    }
}
