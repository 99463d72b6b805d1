//! A background that is learned as a function of direction: `sigmoid(Σ_i c_i Y_i(d))` per channel, with
//! spherical harmonics of degree 4.

use crate::params::ParamGroup;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::spherical_harmonics::cpu as sh;

const TERMS: usize = 16;

/// Coefficients `[16, 3]`.
pub struct LearnedBackground {
    pub group: ParamGroup,
    codes: Vec<f32>,
}

impl LearnedBackground {
    pub fn new(adam: Adam) -> Self {
        LearnedBackground { group: ParamGroup::dense("background", vec![0.0; TERMS * 3], adam), codes: Vec::new() }
    }

    /// A copy to look at, which cannot be trained.
    pub fn to_look_at(&self) -> Self {
        LearnedBackground { group: self.group.values_only(), codes: Vec::new() }
    }

    /// Colours `[R, 3]` for unit directions `[R, 3]`.
    pub fn forward(&self, dirs: &[f32], rgb: &mut Vec<f32>) {
        let mut codes = vec![0.0; dirs.len() / 3 * TERMS];
        sh::forward(4, dirs, &mut codes);
        rgb.clear();
        for y in codes.chunks_exact(TERMS) {
            for k in 0..3 {
                let x: f32 = (0..TERMS).map(|i| y[i] * self.group.values[i * 3 + k]).sum();
                rgb.push(1.0 / (1.0 + (-x).exp()));
            }
        }
    }

    /// Adds the gradient for that of the colours.
    pub fn backward(&mut self, dirs: &[f32], rgb: &[f32], d_rgb: &[f32]) {
        self.codes.resize(dirs.len() / 3 * TERMS, 0.0);
        sh::forward(4, dirs, &mut self.codes);
        for ((y, c), d) in self.codes.chunks_exact(TERMS).zip(rgb.chunks_exact(3)).zip(d_rgb.chunks_exact(3)) {
            for k in 0..3 {
                let g = d[k] * c[k] * (1.0 - c[k]);
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
        let mut b = LearnedBackground::new(Adam { rate: 0.05, ..Adam::default() });
        let dirs = [0.0, 0.0, 1.0, 0.0, 0.0, -1.0];
        let want = [0.2, 0.4, 0.9, 0.3, 0.2, 0.1];
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
