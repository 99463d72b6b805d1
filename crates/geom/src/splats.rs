//! Gaussian splats; points are splats of size 0.

use crate::Similarity;
use glam::{DQuat, DVec3};

/// Gaussians in space, as arrays of equal length.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Splats {
    pub positions: Vec<[f32; 3]>,
    pub rgb_srgb: Vec<[f32; 3]>,
    /// Opacity in [0, 1].
    pub opacities: Vec<f32>,
    /// Standard deviations along the splat's own axes; 0 for points.
    pub scales: Vec<[f32; 3]>,
    /// Unit quaternions (w, x, y, z) that rotate the splat's axes to the world.
    pub rotations: Vec<[f32; 4]>,
}

impl Splats {
    /// Number of splats.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are no splats.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Splats for opaque points.
    pub fn of_points(points: impl Iterator<Item = ([f32; 3], [f32; 3])>) -> Splats {
        let mut out = Splats::default();
        points.for_each(|(p, c)| out.push(p, c, 1.0, [0.0; 3], [1.0, 0.0, 0.0, 0.0]));
        out
    }

    /// Adds a splat.
    pub fn push(&mut self, position: [f32; 3], rgb_srgb: [f32; 3], opacity: f32, scale: [f32; 3], rotation: [f32; 4]) {
        self.positions.push(position);
        self.rgb_srgb.push(rgb_srgb);
        self.opacities.push(opacity);
        self.scales.push(scale);
        self.rotations.push(rotation);
    }

    /// Transforms all splats.
    pub fn transform(&mut self, s: &Similarity) {
        let turn = DQuat::from_mat3(&s.rotation);
        for p in &mut self.positions {
            *p = s.point(DVec3::from(p.map(f64::from))).as_vec3().to_array();
        }
        self.scales.iter_mut().flatten().for_each(|v| *v *= s.scale as f32);
        for q in &mut self.rotations {
            let [w, x, y, z] = q.map(f64::from);
            let r = (turn * DQuat::from_xyzw(x, y, z, w)).normalize();
            *q = [r.w, r.x, r.y, r.z].map(|v| v as f32);
        }
    }
}
