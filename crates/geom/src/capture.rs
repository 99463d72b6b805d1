//! A capture: frames with cameras, and the world they stand in.

use crate::{Camera, Pose, Similarity};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// One photograph with all that any application may know about it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// Short unique name, for reports.
    pub name: String,
    pub image: PathBuf,
    pub camera: Camera,
    pub world_from_camera: Pose,
    /// Black where pixels are to be ignored.
    pub mask: Option<PathBuf>,
    pub depth: Option<PathBuf>,
    pub time: Option<f64>,
    /// Photographs of one session share their light.
    pub session: Option<u32>,
    pub labels: Option<PathBuf>,
    /// Network conditioning, for example expression coefficients.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub conditioning: Vec<f32>,
    pub split: Split,
    pub color_space: ColorSpace,
}

impl Frame {
    /// A training photograph about which no more is known than where it was taken.
    pub fn new(name: impl Into<String>, image: impl Into<PathBuf>, camera: Camera, world_from_camera: Pose) -> Frame {
        Frame {
            name: name.into(),
            image: image.into(),
            camera,
            world_from_camera,
            mask: None,
            depth: None,
            time: None,
            session: None,
            labels: None,
            conditioning: Vec::new(),
            split: Split::Train,
            color_space: ColorSpace::Srgb,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ColorSpace {
    Srgb,
    Linear,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Split {
    Train,
    Val,
    Test,
}

/// Where the scene is: an inner cube and how many times larger the outer cube is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneBox {
    pub center: DVec3,
    /// Half the edge of the inner cube, in world units.
    pub half: f64,
    /// Edge of the outer cube over the edge of the inner one; a power of two.
    pub aabb_scale: u32,
}

impl SceneBox {
    /// Model space, in which the inner cube is `[0, 1]³`.
    pub fn model_from_world(&self) -> Similarity {
        let scale = 0.5 / self.half;
        Similarity { scale, rotation: glam::DMat3::IDENTITY, translation: DVec3::splat(0.5) - self.center * scale }
    }
}

/// A posed set of photographs. The world is z up; `world_from_capture` undoes what the importer did.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Capture {
    pub frames: Vec<Frame>,
    pub world_from_capture: Similarity,
    pub scene: SceneBox,
    /// What the importer skipped or assumed, one line each.
    pub notes: Vec<String>,
}

impl Capture {
    /// Indices of the frames of one split, in order.
    pub fn indices(&self, split: Split) -> Vec<usize> {
        (0..self.frames.len()).filter(|&i| self.frames[i].split == split).collect()
    }
}

/// The point nearest to all optical axes (least squares) and the median camera distance from it.
pub fn focus_point(poses: &[Pose]) -> (DVec3, f64) {
    let mut a = glam::DMat3::ZERO;
    let mut b = DVec3::ZERO;
    for p in poses {
        let d = p.rotation.z_axis;
        let m = glam::DMat3::IDENTITY - glam::DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        a += m;
        b += m * p.translation;
    }
    let mean = poses.iter().map(|p| p.translation).sum::<DVec3>() / poses.len().max(1) as f64;
    let n = poses.len() as f64;
    let focus = if a.determinant().abs() > 1e-6 * n * n * n { a.inverse() * b } else { mean };
    let mut distances: Vec<f64> = poses.iter().map(|p| (p.translation - focus).length()).collect();
    distances.sort_by(f64::total_cmp);
    (focus, distances.get(distances.len() / 2).copied().unwrap_or(1.0).max(1e-6))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn focus_of_a_ring_is_its_centre() {
        let target = DVec3::new(0.5, -0.3, 1.0);
        let poses: Vec<Pose> = (0..8)
            .map(|i| {
                let a = i as f64 * 0.785;
                Pose::look_at(target + DVec3::new(3.0 * a.cos(), 3.0 * a.sin(), 1.0), target, DVec3::Z)
            })
            .collect();
        let (focus, distance) = focus_point(&poses);
        assert!((focus - target).length() < 1e-9);
        assert!((distance - 10f64.sqrt()).abs() < 1e-9);
    }

    #[test]
    fn model_space_puts_the_inner_cube_at_zero_to_one() {
        let s = SceneBox { center: DVec3::new(1.0, 2.0, 3.0), half: 2.0, aabb_scale: 4 };
        let m = s.model_from_world();
        assert!((m.point(s.center - DVec3::splat(2.0))).length() < 1e-12);
        assert!((m.point(s.center + DVec3::splat(2.0)) - DVec3::ONE).length() < 1e-12);
    }
}
