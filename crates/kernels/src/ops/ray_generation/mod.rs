//! Rays through pixels, with the gradient of small camera corrections.
//!
//! Camera `c` has pose `world_from_camera = (R, t)` and a correction `δ_c = (τ, ω, φ)`: origin `t + τ`,
//! direction `exp([ω]×) R d(x, y; f e^φ)` with `d` the lens's unit direction. Gradients are taken at
//! `ω = 0` of a further rotation on the left, which is exact for the update `ω ← log(exp(dω) exp(ω))`
//! and first order otherwise.

#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod reference;
#[cfg(test)]
mod tests;

use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Pose};

/// Numbers in a camera's correction: translation, rotation vector, log focal length.
pub const CORRECTION: usize = 7;

/// A posed camera.
#[derive(Clone, Copy, Debug)]
pub struct PosedCamera {
    pub camera: Camera,
    pub pose: Pose,
}

impl PosedCamera {
    /// The camera with a correction applied.
    pub fn corrected(&self, d: &[f64; CORRECTION]) -> PosedCamera {
        let turn = diorama_geom::transform::rotation_from_axis_angle(DVec3::new(d[3], d[4], d[5]));
        let scale = d[6].exp();
        PosedCamera {
            camera: Camera { fx: self.camera.fx * scale, fy: self.camera.fy * scale, ..self.camera },
            pose: Pose { rotation: turn * self.pose.rotation, translation: self.pose.translation + DVec3::new(d[0], d[1], d[2]) },
        }
    }
}
