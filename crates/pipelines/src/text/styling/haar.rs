//! The orthonormal Haar transform of color images in three levels (Haar 1910), with an exact inverse for any size.

use diorama_geom::Image;
use rayon::prelude::*;

/// Levels of detail.
pub const LEVELS: usize = 3;
/// Bands of detail per level: differences across, down, and both.
pub const BANDS: usize = 3;
/// Sizes are extended to a multiple of this.
const BLOCK: usize = 1 << LEVELS;
/// Factor of a mean of colors in the low band.
pub const LOW_GAIN: f64 = BLOCK as f64;

/// Coefficients of a color image: the low band, and the details of each level from fine to coarse.
#[derive(Clone, Debug, PartialEq)]
pub struct Haar {
    /// Size of the image that was transformed.
    width: usize,
    height: usize,
    /// `[H/8, W/8, 3]`.
    pub low: Image,
    /// `[H/2ˡ, W/2ˡ, 3 bands × 3 colors]` for levels l from 1.
    pub details: [Image; LEVELS],
}

impl Haar {
    /// Transforms an image; sizes that are no multiple of 8 are extended by reflection.
    ///
    /// # Shapes
    /// `image` `[H, W, 3]`, not empty.
    ///
    /// # Panics
    /// When it has other than three channels.
    pub fn of(image: &Image) -> Haar {
        assert_eq!(image.channels, 3, "the transform is of three channels");
        let mut low = extended(image);
        let details = std::array::from_fn(|_| {
            let (half, details) = split(&low);
            low = half;
            details
        });
        Haar { width: image.width, height: image.height, low, details }
    }

    /// The image with these coefficients.
    pub fn inverse(&self) -> Image {
        let mut image = self.low.clone();
        for details in self.details.iter().rev() {
            image = joined(&image, details);
        }
        let row = |y: usize| &image.data[y * image.width * 3..][..self.width * 3];
        let data = (0..self.height).flat_map(|y| row(y).iter().copied()).collect();
        Image { width: self.width, height: self.height, channels: 3, data }
    }
}

/// The image reflected at its right and lower border up to multiples of the block size.
fn extended(image: &Image) -> Image {
    let (width, height) = (image.width.next_multiple_of(BLOCK), image.height.next_multiple_of(BLOCK));
    // A reflection of period 2n, which images smaller than the extension need more than once.
    let reflected = |k: usize, n: usize| if k % (2 * n) < n { k % (2 * n) } else { 2 * n - 1 - k % (2 * n) };
    let columns: Vec<usize> = (0..width).map(|x| reflected(x, image.width)).collect();
    let mut out = Image::zeros(width, height, 3);
    for (y, row) in out.data.chunks_mut(3 * width).enumerate() {
        let y = reflected(y, image.height);
        row.chunks_mut(3).zip(&columns).for_each(|(c, x)| c.copy_from_slice(image.pixel(*x, y)));
    }
    out
}

/// Means (times 2) and details of blocks of 2x2 pixels.
fn split(image: &Image) -> (Image, Image) {
    let (width, height) = (image.width / 2, image.height / 2);
    let mut low = Image::zeros(width, height, 3);
    let mut details = Image::zeros(width, height, 3 * BANDS);
    let rows = low.data.par_chunks_mut(3 * width).zip(details.data.par_chunks_mut(3 * BANDS * width));
    rows.enumerate().for_each(|(y, (low, details))| {
        let line = |k: usize| &image.data[(2 * y + k) * 6 * width..][..6 * width];
        let blocks = line(0).chunks_exact(6).zip(line(1).chunks_exact(6));
        for ((low, details), (top, bottom)) in low.chunks_exact_mut(3).zip(details.chunks_exact_mut(9)).zip(blocks) {
            for k in 0..3 {
                let [a, b, c, d] = [top[k], top[k + 3], bottom[k], bottom[k + 3]];
                low[k] = 0.5 * (a + b + c + d);
                details[k] = 0.5 * (a - b + c - d);
                details[k + 3] = 0.5 * (a + b - c - d);
                details[k + 6] = 0.5 * (a - b - c + d);
            }
        }
    });
    (low, details)
}

/// What [`split`] undoes.
fn joined(low: &Image, details: &Image) -> Image {
    let (width, height) = (2 * low.width, 2 * low.height);
    let mut out = Image::zeros(width, height, 3);
    out.data.par_chunks_mut(2 * 3 * width).enumerate().for_each(|(y, rows)| {
        let (top, bottom) = rows.split_at_mut(3 * width);
        let blocks = top.chunks_exact_mut(6).zip(bottom.chunks_exact_mut(6));
        let low = low.data[y * 3 * low.width..].chunks_exact(3);
        let details = details.data[y * 9 * details.width..].chunks_exact(9);
        for ((top, bottom), (low, details)) in blocks.zip(low.zip(details)) {
            for k in 0..3 {
                let [mean, across, down, both] = [low[k], details[k], details[k + 3], details[k + 6]];
                top[k] = 0.5 * (mean + across + down + both);
                top[k + 3] = 0.5 * (mean - across + down - both);
                bottom[k] = 0.5 * (mean + across - down - both);
                bottom[k + 3] = 0.5 * (mean - across - down + both);
            }
        }
    });
    out
}
