//! Learned background, a function of direction: `a(Σ_i c_i Y_i(d))` per channel, with spherical harmonics of degree 4;
//! `a` is the sigmoid, or for linear light the exponential.

use crate::params::ParamGroup;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::linear::{Activation, cpu as linear};
use diorama_kernels::ops::spherical_harmonics::cpu as sh;

const TERMS: usize = 16;

/// Coefficients `[16, 3]`.
pub struct LearnedBackground {
    pub group: ParamGroup,
    pub activation: Activation,
    codes: Vec<f32>,
}

impl LearnedBackground {
    pub fn new(activation: Activation, adam: Adam) -> Self {
        LearnedBackground { group: ParamGroup::dense("background", vec![0.0; TERMS * 3], adam), activation, codes: Vec::new() }
    }

    /// A copy of the values alone, for rendering; it cannot be trained.
    pub fn for_rendering(&self) -> Self {
        LearnedBackground { group: self.group.values_only(), activation: self.activation, codes: Vec::new() }
    }

    /// Colors `[R, 3]` for unit directions `[R, 3]`.
    pub fn forward(&self, dirs: &[f32], rgb: &mut Vec<f32>) {
        let mut codes = vec![0.0; dirs.len() / 3 * TERMS];
        sh::forward(4, dirs, &mut codes);
        rgb.clear();
        for y in codes.chunks_exact(TERMS) {
            for k in 0..3 {
                let x: f32 = (0..TERMS).map(|i| y[i] * self.group.values[i * 3 + k]).sum();
                rgb.push(match self.activation {
                    Activation::Sigmoid => 1.0 / (1.0 + (-x).exp()),
                    _ => x.exp(),
                });
            }
        }
    }

    /// Adds the gradient for that of the colors.
    pub fn backward(&mut self, dirs: &[f32], rgb: &[f32], d_rgb: &[f32]) {
        self.codes.resize(dirs.len() / 3 * TERMS, 0.0);
        sh::forward(4, dirs, &mut self.codes);
        for ((y, c), d) in self.codes.chunks_exact(TERMS).zip(rgb.chunks_exact(3)).zip(d_rgb.chunks_exact(3)) {
            for k in 0..3 {
                let g = d[k] * linear::slope_from_output(self.activation, c[k]);
                for i in 0..TERMS {
                    self.group.grads[i * 3 + k] += g * y[i];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_learns_a_sky_that_depends_on_direction() {
        for (activation, sun) in [(Activation::Sigmoid, 0.9), (Activation::TruncatedExp, 3.0)] {
            let mut b = LearnedBackground::new(activation, Adam { rate: 0.05, ..Adam::default() });
            let dirs = [0.0, 0.0, 1.0, 0.0, 0.0, -1.0];
            let want = [0.2, 0.4, sun, 0.3, 0.2, 0.1];
            let mut rgb = Vec::new();
            for t in 1..500 {
                b.forward(&dirs, &mut rgb);
                let d: Vec<f32> = rgb.iter().zip(&want).map(|(a, b)| a - b).collect();
                b.backward(&dirs, &rgb, &d);
                b.group.step(t, 1.0);
            }
            b.forward(&dirs, &mut rgb);
            assert!(rgb.iter().zip(&want).all(|(a, b)| (a - b).abs() < 0.02), "{rgb:?}");
        }
    }
}
