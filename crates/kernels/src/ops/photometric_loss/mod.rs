//! The loss of rays against photographs: `1/R Σ_r (⅓ Σ_k ℓ(c_rk − ĉ_rk) + λ_α (o_r − a_r)² + λ_s spread_r + λ_d astray_r)` with squared
//! differences or Huber's (1964) as `ℓ`, opacities `o`, photographs' alphas `a`, the distortion loss ([`distortion`](super::distortion)) and
//! the depth loss ([`depth_loss`](super::depth_loss)).

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use super::composite::Packed;
use super::distortion;

pub use cpu::{shown, squared_error};

/// How a color difference `d` counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ColorLoss {
    /// `d²`
    Mse,
    /// `d² / 2δ` within δ, `|d| − δ/2` beyond.
    Huber(f32),
}

/// The terms of the loss and their weights.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Terms {
    pub color: ColorLoss,
    /// Weight of the distortion loss.
    pub distortion: f32,
    /// Weight of the light that ends away from surfaces of known distance.
    pub depth: f32,
    /// Weight of the squared difference between opacity and the photograph's alpha.
    pub alpha: f32,
}

/// What [`Measure::relative`] is for linear light.
pub const RELATIVE: f32 = 1e-3;

/// How a field's colors and distances are measured.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Measure {
    /// For linear light: differences are divided by the prediction plus this, which takes no part in the gradient, so that dark parts
    /// count like bright ones (Mildenhall et al. 2022, equation 5). 0: differences count as they are.
    pub relative: f32,
    /// Whether the distortion loss is taken in [normalized distance](distortion::normalized_distance).
    pub normalized: bool,
}

/// What rays are compared with.
#[derive(Clone, Copy, Debug)]
pub struct Targets<'a> {
    /// Straight RGBA, `[R, 4]`.
    pub rgba: &'a [f32],
    /// What transparent pixels are composited on, `[R, 3]`.
    pub background: &'a [f32],
    /// Whether each ray counts, `[R]`.
    pub counts: &'a [bool],
    /// Distance of the surface along the ray, 0 where it is not known, `[R]`.
    pub distance: &'a [f32],
}

impl Targets<'_> {
    /// What ray `r` should come to, background included.
    pub fn color(&self, r: usize) -> [f32; 3] {
        let t = &self.rgba[r * 4..r * 4 + 4];
        std::array::from_fn(|k| t[k] * t[3] + self.background[r * 3 + k] * (1.0 - t[3]))
    }
}

/// The loss of a batch of rays with packed samples.
pub struct Photometric<'a> {
    pub terms: Terms,
    pub measure: Measure,
    pub targets: Targets<'a>,
    samples: Packed<'a>,
    /// Starts and lengths of the samples in normalized distance; empty where the distortion loss does not take them.
    normalized: (Vec<f32>, Vec<f32>),
}

impl<'a> Photometric<'a> {
    pub fn new(terms: Terms, measure: Measure, targets: Targets<'a>, samples: Packed<'a>) -> Self {
        let mut normalized = (Vec::new(), Vec::new());
        if measure.normalized && terms.distortion > 0.0 {
            distortion::cpu::normalize(&samples, &mut normalized.0, &mut normalized.1);
        }
        Photometric { terms, measure, targets, samples, normalized }
    }

    /// The samples in the distance that the distortion loss measures.
    fn measured(&self) -> Packed<'_> {
        let (t, dt) = (&self.normalized.0[..], &self.normalized.1[..]);
        if t.is_empty() { self.samples } else { Packed { offsets: self.samples.offsets, t, dt } }
    }
}
