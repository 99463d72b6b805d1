//! The light on a surface: radiance is albedo × shading, and the logarithm of shading is a quadratic of the position, fitted robustly to the
//! pixels beside the writing.

use diorama_geom::Image;
use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;

/// Terms of a quadratic of two variables.
const TERMS: usize = 6;
/// Pixels that a fit uses, about evenly spread.
const SAMPLES: usize = 40_000;
/// Least absolute deviations first, which outliers hardly move; then Tukey's weights, which ignore them.
const ABSOLUTE_ROUNDS: usize = 10;
const TUKEY_ROUNDS: usize = 20;
/// Deviations at which Tukey's weight is 0.
const TUKEY: f64 = 4.685;
/// Standard deviation over the median absolute deviation of a normal distribution.
const DEVIATION_OF_MAD: f64 = 1.4826;
/// Least radiance, whose logarithm is still useful.
const LEAST_RADIANCE: f64 = 1e-4;
/// Weight, over that of the samples, that keeps slopes at 0 where samples do not determine them.
const STIFFNESS: f64 = 1e-7;

/// A smooth factor on albedo over a rectangle, with geometric mean 1: `S_k(u, v) = exp(q_k(2u − 1, 2v − 1))`, q quadratic.
#[derive(Clone, Debug, PartialEq)]
pub struct Shading {
    /// Of 1, x, y, x², xy, y² per channel, x and y from −1 to 1.
    coefficients: [[f64; TERMS]; 3],
}

/// Colors of a sign without its shading, linear.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Albedos {
    pub ink_linear: [f32; 3],
    pub ground_linear: [f32; 3],
}

impl Shading {
    /// Fits shading to the pixels outside of a mask, a quadratic of log radiance per channel; a fifth of them may be outliers.
    ///
    /// Where fewer pixels than terms are left, shading is 1.
    ///
    /// # Shapes
    /// `image_linear` `[H, W, 3]`, `mask` `[H, W]`.
    ///
    /// # Panics
    /// When sizes or channels differ from that.
    pub fn fit(image_linear: &Image, mask: &[bool]) -> Shading {
        check(image_linear, mask);
        let (width, height) = (image_linear.width, image_linear.height);
        let unmasked: Vec<usize> = (0..mask.len()).filter(|i| !mask[*i]).collect();
        // A step that is not a divisor of the width visits all columns.
        let step = unmasked.len().div_ceil(SAMPLES) | 1;
        let samples: Vec<usize> = unmasked.into_iter().step_by(step).collect();
        let center = |i: usize| terms_at((i % width) as f64 + 0.5, (i / width) as f64 + 0.5, [width, height]);
        let terms: Vec<SVector<f64, TERMS>> = samples.iter().map(|i| center(*i)).collect();
        let mut coefficients = [[0.0; TERMS]; 3];
        coefficients.par_iter_mut().enumerate().for_each(|(k, out)| {
            let logs: Vec<f64> = samples.iter().map(|i| (image_linear.data[3 * i + k] as f64).max(LEAST_RADIANCE).ln()).collect();
            *out = robust_fit(&terms, &logs).into();
            // The means of x² and y² from −1 to 1 are 1/3; the other terms' are 0.
            out[0] = -(out[3] + out[5]) / 3.0;
        });
        Shading { coefficients }
    }

    /// Shading at a position in units of the rectangle, (0, 0) at its top left corner and (1, 1) at its bottom right.
    pub fn at(&self, u: f64, v: f64) -> [f32; 3] {
        let terms = terms_at(u, v, [1, 1]);
        self.coefficients.map(|c| c.iter().zip(terms.iter()).map(|(c, t)| c * t).sum::<f64>().exp() as f32)
    }

    /// Radiance of a surface with this shading, from its albedo `[H, W, 3]`.
    pub fn lit(&self, albedo_linear: &Image) -> Image {
        self.scaled(albedo_linear, |albedo, shading| albedo * shading)
    }

    /// Albedo of a surface, from its radiance `[H, W, 3]`: what [`Shading::lit`] undoes.
    pub fn unlit(&self, image_linear: &Image) -> Image {
        self.scaled(image_linear, |radiance, shading| radiance / shading)
    }

    fn scaled(&self, image: &Image, value: impl Fn(f32, f32) -> f32 + Sync) -> Image {
        assert_eq!(image.channels, 3, "shading is of three channels");
        let (width, height) = (image.width, image.height);
        let mut out = image.clone();
        out.data.par_chunks_mut(3 * width).enumerate().for_each(|(y, row)| {
            for (x, color) in row.chunks_mut(3).enumerate() {
                let shading = self.at((x as f64 + 0.5) / width as f64, (y as f64 + 0.5) / height as f64);
                color.iter_mut().zip(shading).for_each(|(c, s)| *c = value(*c, s));
            }
        });
        out
    }

    /// Median albedos inside and outside of a mask of glyphs, away from their edges where there are such pixels.
    ///
    /// Without any pixel of a kind, its albedo is the other's.
    ///
    /// # Shapes
    /// `image_linear` `[H, W, 3]`, `mask` `[H, W]`.
    ///
    /// # Panics
    /// When sizes or channels differ from that.
    pub fn albedos(&self, image_linear: &Image, mask: &[bool]) -> Albedos {
        check(image_linear, mask);
        let albedo = self.unlit(image_linear);
        let median_of = |kind: bool| {
            let all: Vec<usize> = (0..mask.len()).filter(|i| mask[*i] == kind).collect();
            let inner: Vec<usize> = all.iter().copied().filter(|i| is_inner(mask, albedo.width, albedo.height, *i)).collect();
            let chosen = if inner.is_empty() { all } else { inner };
            (!chosen.is_empty()).then(|| [0, 1, 2].map(|k| median(chosen.iter().map(|i| albedo.data[3 * i + k] as f64).collect()) as f32))
        };
        let (ink, ground) = (median_of(true), median_of(false));
        let any = ink.or(ground).unwrap_or([0.0; 3]);
        Albedos { ink_linear: ink.unwrap_or(any), ground_linear: ground.unwrap_or(any) }
    }
}

impl Albedos {
    /// Albedo of writing, from the share `[H, W]` of each pixel that is ink.
    ///
    /// # Panics
    /// When `ink` does not have as many values as that size.
    pub fn drawn(&self, ink: &[f32], width: usize, height: usize) -> Image {
        assert_eq!(ink.len(), width * height, "the ink does not have the size of the image");
        let mix = |a: &f32| [0, 1, 2].map(|k| self.ground_linear[k] + a * (self.ink_linear[k] - self.ground_linear[k]));
        Image { width, height, channels: 3, data: ink.iter().flat_map(mix).collect() }
    }
}

fn check(image: &Image, mask: &[bool]) {
    assert_eq!(image.channels, 3, "shading is of three channels");
    assert_eq!(mask.len(), image.width * image.height, "the mask does not have the size of the image");
}

/// Whether a pixel's whole neighborhood of 3x3 has its value in the mask.
fn is_inner(mask: &[bool], width: usize, height: usize, i: usize) -> bool {
    let (x, y) = (i % width, i / width);
    let mut rows = y.saturating_sub(1)..(y + 2).min(height);
    rows.all(|y| mask[y * width..][x.saturating_sub(1)..(x + 2).min(width)].iter().all(|m| *m == mask[i]))
}

/// Terms of the quadratic at a position in a rectangle of a size.
fn terms_at(x: f64, y: f64, size: [usize; 2]) -> SVector<f64, TERMS> {
    let (x, y) = (2.0 * x / size[0] as f64 - 1.0, 2.0 * y / size[1] as f64 - 1.0);
    SVector::from([1.0, x, y, x * x, x * y, y * y])
}

/// Coefficients of the terms by least squares with weights that residuals determine again and again.
fn robust_fit(terms: &[SVector<f64, TERMS>], values: &[f64]) -> SVector<f64, TERMS> {
    let mut fit = SVector::<f64, TERMS>::zeros();
    if values.len() < TERMS {
        return fit;
    }
    fit[0] = median(values.to_vec());
    for round in 0..ABSOLUTE_ROUNDS + TUKEY_ROUNDS {
        let residuals: Vec<f64> = terms.iter().zip(values).map(|(t, v)| v - t.dot(&fit)).collect();
        let scale = (DEVIATION_OF_MAD * median(residuals.iter().map(|r| r.abs()).collect())).max(1e-6);
        let weight = |r: f64| {
            if round < ABSOLUTE_ROUNDS {
                return 1.0 / (r.abs() / scale).max(0.1);
            }
            let x = r / (TUKEY * scale);
            if x.abs() < 1.0 { (1.0 - x * x).powi(2) } else { 0.0 }
        };
        let next = weighted_fit(terms, values, residuals.iter().map(|r| weight(*r)));
        let change = (next - fit).amax();
        fit = next;
        if round > ABSOLUTE_ROUNDS && change < 1e-7 {
            break;
        }
    }
    fit
}

fn weighted_fit(terms: &[SVector<f64, TERMS>], values: &[f64], weights: impl Iterator<Item = f64>) -> SVector<f64, TERMS> {
    let (mut a, mut b) = (SMatrix::<f64, TERMS, TERMS>::zeros(), SVector::<f64, TERMS>::zeros());
    for ((t, v), w) in terms.iter().zip(values).zip(weights) {
        a += (t * w) * t.transpose();
        b += t * (w * v);
    }
    let stiffness = STIFFNESS * a[(0, 0)];
    (1..TERMS).for_each(|i| a[(i, i)] += stiffness);
    a.cholesky().map_or(SVector::zeros(), |c| c.solve(&b))
}

/// The middle value, 0 of none.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let k = values.len() / 2;
    *values.select_nth_unstable_by(k, f64::total_cmp).1
}
