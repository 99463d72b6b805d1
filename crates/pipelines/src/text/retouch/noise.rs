//! Noise of a photograph, and noise like it for what is drawn into it.

use super::shading::median;
use diorama_geom::Image;
use diorama_geom::rng::Rng;
use rayon::prelude::*;

/// A high-pass filter that is 0 on planes and on straight edges along an axis (Immerkær 1996).
const HIGH_PASS: [[f64; 3]; 3] = [[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]];
/// Standard deviation of its response to noise of deviation 1.
const RESPONSE: f64 = 6.0;
/// Standard deviation over the median absolute value of a normal distribution.
const DEVIATION_OF_MAD: f64 = 1.4826;

/// Standard deviation of the noise per channel, from the median response to a high-pass filter where no pixel of 3x3 is masked.
///
/// # Shapes
/// `image` `[H, W, C]`, `mask` `[H, W]`; the result `[C]`, 0 where no such pixel exists.
///
/// # Panics
/// When sizes differ.
pub fn noise_level(image: &Image, mask: &[bool]) -> Vec<f32> {
    let (width, height, channels) = (image.width, image.height, image.channels);
    assert_eq!(mask.len(), width * height, "the mask does not have the size of the image");
    let inner = |n: usize| 1..n.saturating_sub(1).max(1);
    let is_free = |x: usize, y: usize| (y - 1..y + 2).all(|y| !mask[y * width + x - 1..y * width + x + 2].contains(&true));
    let free: Vec<[usize; 2]> = inner(height).flat_map(|y| inner(width).filter(move |x| is_free(*x, y)).map(move |x| [x, y])).collect();
    let response = |[x, y]: [usize; 2], k: usize| {
        let tap = |i: usize| HIGH_PASS[i / 3][i % 3] * image.pixel(x + i % 3 - 1, y + i / 3 - 1)[k] as f64;
        (0..9).map(tap).sum::<f64>().abs()
    };
    let level = |k: usize| DEVIATION_OF_MAD / RESPONSE * median(free.iter().map(|at| response(*at, k)).collect());
    (0..channels).into_par_iter().map(|k| level(k) as f32).collect()
}

/// The image with independent normal noise of a standard deviation per channel; a seed gives the same noise each time.
///
/// # Shapes
/// `image` `[H, W, C]`, `levels` `[C]`.
///
/// # Panics
/// When the levels are not as many as the channels.
pub fn with_noise(image: &Image, levels: &[f32], seed: u64) -> Image {
    assert_eq!(levels.len(), image.channels, "one noise level per channel");
    let rng = Rng::new(seed, 0);
    let mut out = image.clone();
    let channels = image.channels;
    out.data.par_iter_mut().enumerate().for_each(|(i, value)| *value += levels[i % channels] * rng.normal(i as u64));
    out
}
