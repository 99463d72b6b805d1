//! Transfer of moments between images: whitening by the content's covariance and coloring by the style's (Li et al. 2017), in the bands of a
//! Haar transform, and a plain linear transfer of colors.
//!
//! Of all linear maps that turn one covariance into the other, the symmetric one moves colors least (Pitié and Kokaram 2007):
//! `A = Σc^(−½) (Σc^½ Σs Σc^½)^½ Σc^(−½)`.

use super::haar::{BANDS, Haar, LEVELS, LOW_GAIN};
use diorama_geom::Image;
use nalgebra::{DMatrix, SMatrix, SVector, SymmetricEigen};
use rayon::prelude::*;

/// Values of the details at a place: bands × colors.
pub const DETAIL: usize = 3 * BANDS;
/// Share of the transferred details in the result; the rest are recolored ones.
const STRENGTH: f64 = 0.5;
/// Least standard deviation along an axis, of colors from 0 to 1 and of details: what is flatter is noise.
const FLAT: f64 = 2e-3;
/// Least and largest factor along an axis: where a scene has little color of its own, larger ones make noise and edges garish.
const GAINS: [f64; 2] = [0.2, 2.2];

/// Second moments of an image's Haar bands, colors sRGB-encoded from 0 to 1.
#[derive(Clone, Debug, PartialEq)]
pub struct Moments {
    /// Mean and covariance of the low band, in units of colors.
    pub mean: SVector<f64, 3>,
    pub low: SMatrix<f64, 3, 3>,
    /// Mean products of the details of each level, fine to coarse.
    pub details: [SMatrix<f64, DETAIL, DETAIL>; LEVELS],
}

/// Sums that moments are means of.
#[derive(Clone)]
struct Sums {
    places: [f64; LEVELS],
    mean: SVector<f64, 3>,
    low: SMatrix<f64, 3, 3>,
    details: [SMatrix<f64, DETAIL, DETAIL>; LEVELS],
}

impl Moments {
    /// Moments of the pixels of all images together; `None` where there is no pixel.
    ///
    /// # Shapes
    /// Each image `[H, W, 3]`, sRGB-encoded.
    pub fn of(images: &[Image]) -> Option<Moments> {
        let each: Vec<Sums> = images.par_iter().filter(|i| !i.data.is_empty()).map(|i| Sums::of(&Haar::of(i))).collect();
        // One after the other, so that rounding does not depend on the threads.
        let all = each.into_iter().reduce(Sums::plus)?;
        let n = all.places[LEVELS - 1];
        let mean = all.mean / n;
        let low = all.low / n - mean * mean.transpose();
        Some(Moments { mean, low, details: std::array::from_fn(|l| all.details[l] / all.places[l]) })
    }

    /// Covariance of pixels, which the bands add up to (Parseval).
    pub fn colors(&self) -> SMatrix<f64, 3, 3> {
        let mut sum = self.low;
        for (level, details) in self.details.iter().enumerate() {
            let pixels_per_place = 4f64.powi(level as i32 + 1);
            for band in 0..BANDS {
                sum += details.fixed_view::<3, 3>(3 * band, 3 * band) / pixels_per_place;
            }
        }
        sum
    }
}

impl Sums {
    fn of(haar: &Haar) -> Sums {
        let (mut mean, mut low) = (SVector::zeros(), SMatrix::zeros());
        for color in haar.low.data.chunks_exact(3) {
            let color = SVector::from([0, 1, 2].map(|k| color[k] as f64 / LOW_GAIN));
            mean += color;
            low += color * color.transpose();
        }
        let places = [0, 1, 2].map(|l| (haar.details[l].width * haar.details[l].height) as f64);
        Sums { places, mean, low, details: [0, 1, 2].map(|l| products(&haar.details[l])) }
    }

    fn plus(mut self, other: Sums) -> Sums {
        self.mean += other.mean;
        self.low += other.low;
        (0..LEVELS).for_each(|l| self.places[l] += other.places[l]);
        (0..LEVELS).for_each(|l| self.details[l] += other.details[l]);
        self
    }
}

/// Sum of `d dᵀ` over all places, in single precision along a row and in double precision over rows.
fn products(details: &Image) -> SMatrix<f64, DETAIL, DETAIL> {
    let rows = details.data.par_chunks(details.width * DETAIL).map(|row| {
        let mut sum = [[0.0f32; DETAIL]; DETAIL];
        for d in row.chunks_exact(DETAIL) {
            for i in 0..DETAIL {
                for j in 0..DETAIL {
                    sum[i][j] += d[i] * d[j];
                }
            }
        }
        sum
    });
    let rows: Vec<_> = rows.collect();
    SMatrix::from_fn(|i, j| rows.iter().map(|r| r[i][j] as f64).sum())
}

/// Maps from a scene's moments to a style's, for any image of the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Transfer {
    content_mean: SVector<f64, 3>,
    style_mean: SVector<f64, 3>,
    low: SMatrix<f64, 3, 3>,
    details: [SMatrix<f64, DETAIL, DETAIL>; LEVELS],
    colors: SMatrix<f64, 3, 3>,
}

impl Transfer {
    /// Maps from the moments of all of a scene's images to those of a style.
    pub fn new(content: &Moments, style: &Moments) -> Transfer {
        let low = symmetric_map(&content.low, &style.low, FLAT);
        let recolored = SMatrix::<f64, DETAIL, DETAIL>::from_fn(|i, j| if i / 3 == j / 3 { low[(i % 3, j % 3)] } else { 0.0 });
        let details =
            std::array::from_fn(|l| STRENGTH * symmetric_map(&content.details[l], &style.details[l], FLAT) + (1.0 - STRENGTH) * recolored);
        let colors = symmetric_map(&content.colors(), &style.colors(), FLAT);
        Transfer { content_mean: content.mean, style_mean: style.mean, low, details, colors }
    }

    /// The image with the style's moments in the low band and half of the way in the details; values may leave 0 to 1.
    ///
    /// # Shapes
    /// `image_srgb` and the result `[H, W, 3]`.
    pub fn stylized(&self, image_srgb: &Image) -> Image {
        let mut haar = Haar::of(image_srgb);
        let shift = LOW_GAIN * (self.style_mean - self.low * self.content_mean);
        mapped(&mut haar.low, &self.low, &shift);
        for (details, map) in haar.details.iter_mut().zip(&self.details) {
            mapped(details, map, &SVector::zeros());
        }
        haar.inverse()
    }

    /// The image with the style's mean and covariance of colors and its own detail; values may leave 0 to 1.
    ///
    /// # Shapes
    /// `image_srgb` and the result `[H, W, 3]`.
    pub fn recolored(&self, image_srgb: &Image) -> Image {
        let mut out = image_srgb.clone();
        mapped(&mut out, &self.colors, &(self.style_mean - self.colors * self.content_mean));
        out
    }
}

/// Applies `A p + b` to each pixel `[N]`.
fn mapped<const N: usize>(image: &mut Image, map: &SMatrix<f64, N, N>, shift: &SVector<f64, N>) {
    let columns: [[f32; N]; N] = std::array::from_fn(|j| std::array::from_fn(|i| map[(i, j)] as f32));
    let shift: [f32; N] = std::array::from_fn(|i| shift[i] as f32);
    image.data.par_chunks_mut(N * image.width.max(1)).for_each(|row| {
        for pixel in row.chunks_exact_mut(N) {
            let mut sum = shift;
            for (value, column) in pixel.iter().zip(&columns) {
                (0..N).for_each(|i| sum[i] += value * column[i]);
            }
            pixel.copy_from_slice(&sum);
        }
    });
}

/// The symmetric map of one covariance into another, with limited factors; axes flatter than a deviation count as having it.
fn symmetric_map<const N: usize>(content: &SMatrix<f64, N, N>, style: &SMatrix<f64, N, N>, flat: f64) -> SMatrix<f64, N, N> {
    let floored = |l: f64| l.max(flat * flat);
    let root = with_eigenvalues(content, |l| floored(l).sqrt());
    let inverse = with_eigenvalues(content, |l| 1.0 / floored(l).sqrt());
    let style = with_eigenvalues(style, floored);
    let map = inverse * with_eigenvalues(&(root * style * root), |l| l.max(0.0).sqrt()) * inverse;
    with_eigenvalues(&map, |l| l.clamp(GAINS[0], GAINS[1]))
}

/// The symmetric matrix of the same eigenvectors, with eigenvalues changed.
fn with_eigenvalues<const N: usize>(matrix: &SMatrix<f64, N, N>, change: impl Fn(f64) -> f64) -> SMatrix<f64, N, N> {
    // Of dynamic size, because generic constants have no decomposition.
    let eigen = SymmetricEigen::new(DMatrix::from_fn(N, N, |i, j| 0.5 * (matrix[(i, j)] + matrix[(j, i)])));
    let vectors = SMatrix::<f64, N, N>::from_fn(|i, j| eigen.eigenvectors[(i, j)]);
    let values = SVector::<f64, N>::from_fn(|i, _| change(eigen.eigenvalues[i]));
    vectors * SMatrix::from_diagonal(&values) * vectors.transpose()
}
