//! Codes: vectors that all samples of a ray share, such as its encoded direction, the appearance of its image, or one that the caller
//! gives.

use crate::params::ParamGroup;
use diorama_kernels::ops::{frequency, spherical_harmonics};

/// An encoding of directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DirectionCode {
    None,
    SphericalHarmonics(usize),
    Frequency(frequency::Frequency),
}

impl DirectionCode {
    pub fn dims(&self) -> usize {
        match self {
            DirectionCode::None => 0,
            DirectionCode::SphericalHarmonics(d) => d * d,
            DirectionCode::Frequency(f) => f.output_dims(),
        }
    }

    fn encode(&self, dirs: &[f32], out: &mut Vec<f32>) {
        out.resize(dirs.len() / 3 * self.dims(), 0.0);
        match self {
            DirectionCode::None => {}
            DirectionCode::SphericalHarmonics(d) => spherical_harmonics::cpu::forward(*d, dirs, out),
            DirectionCode::Frequency(f) => frequency::cpu::forward(f, dirs, out),
        }
    }
}

/// A vector per training image that the color network reads (Martin-Brualla et al. 2021, NeRF in the Wild).
#[derive(Clone, Debug)]
pub struct Appearance {
    pub dims: usize,
    /// `[images, dims]`
    pub group: ParamGroup,
}

impl Appearance {
    /// The mean code over all images, used for views that were not trained on.
    pub fn mean(&self) -> Vec<f32> {
        let n = (self.group.values.len() / self.dims).max(1) as f32;
        (0..self.dims).map(|k| self.group.values.iter().skip(k).step_by(self.dims).sum::<f32>() / n).collect()
    }
}

/// The codes that a field's network reads from input 1 on: direction, appearance, then the given ones.
#[derive(Clone, Debug)]
pub struct RayCodes {
    pub direction: DirectionCode,
    pub appearance: Option<Appearance>,
    /// Widths of the vectors that callers give per ray, for example a style or an expression.
    pub given: Vec<usize>,
}

impl RayCodes {
    /// Codes of direction and appearance alone.
    pub fn new(direction: DirectionCode, appearance: Option<Appearance>) -> RayCodes {
        RayCodes { direction, appearance, given: Vec::new() }
    }

    /// Widths of all codes, in the order in which the network reads them.
    pub fn widths(&self) -> Vec<usize> {
        let own = [self.direction.dims()].into_iter().filter(|d| *d > 0).chain(self.appearance.iter().map(|a| a.dims));
        own.chain(self.given.iter().copied()).collect()
    }

    /// Codes of rays: of their directions, and of the appearance of `images`, or of all in the mean.
    pub fn encode(&self, dirs: &[f32], images: Option<&[u32]>, direction: &mut Vec<f32>, appearance: &mut Vec<f32>) {
        self.direction.encode(dirs, direction);
        let Some(a) = &self.appearance else { return };
        appearance.resize(dirs.len() / 3 * a.dims, 0.0);
        let mean = if images.is_none() { a.mean() } else { Vec::new() };
        for (r, row) in appearance.chunks_exact_mut(a.dims).enumerate() {
            match images {
                Some(images) => {
                    let i = images[r] as usize * a.dims;
                    row.copy_from_slice(&a.group.values[i..i + a.dims]);
                }
                None => row.copy_from_slice(&mean),
            }
        }
    }

    /// A copy of the values alone, for rendering; it cannot be trained.
    pub fn for_rendering(&self) -> RayCodes {
        let appearance = self.appearance.as_ref().map(|a| Appearance { dims: a.dims, group: a.group.values_only() });
        RayCodes { direction: self.direction, appearance, given: self.given.clone() }
    }
}
