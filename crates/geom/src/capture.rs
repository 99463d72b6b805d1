//! A capture: frames with cameras, and the world that contains them.

use crate::{Camera, Pose, Similarity};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// One photograph with its camera and metadata.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// Short unique name, for reports.
    pub name: String,
    pub image: PathBuf,
    pub camera: Camera,
    pub world_from_camera: Pose,
    /// Mask file; [`Capture::masks`] says how it is read and what it means.
    pub mask: Option<PathBuf>,
    pub depth: Option<PathBuf>,
    pub time: Option<f64>,
    /// Photographs of one session have the same lighting.
    pub session: Option<u32>,
    pub labels: Option<PathBuf>,
    /// Network conditioning, for example expression coefficients.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub conditioning: Vec<f32>,
    pub split: Split,
    pub color_space: ColorSpace,
}

impl Frame {
    /// A training frame with a photograph and a pose, without other metadata.
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

/// Encoding of a photograph's values.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ColorSpace {
    Srgb,
    Linear,
}

/// Use of a frame: training, or held out for validation or test.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Split {
    Train,
    Val,
    Test,
}

/// Position and size of the scene: an inner cube, and how many times larger the outer cube is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneBox {
    pub center: DVec3,
    /// Half the edge of the inner cube, in world units.
    pub half: f64,
    /// Edge of the outer cube divided by the edge of the inner one; a power of two.
    pub aabb_scale: u32,
}

/// Share of the visible points on either side of an axis that need not be in the inner cube of [`SceneBox::holding`], how much larger than the
/// points that cube is, and the edge of its outer cube at most.
const OUTLIERS: f64 = 0.1;
const MARGIN: f64 = 1.01;
const MOST_SCALE: u32 = 8;

impl SceneBox {
    /// The box whose inner cube holds cameras and most of the points that they see, and whose outer cube all of these, as far as it may be so
    /// large.
    pub fn holding(eyes: &[DVec3], seen: &[DVec3]) -> SceneBox {
        let range = |axis: usize| -> (f64, f64) {
            let mut along: Vec<f64> = seen.iter().map(|p| p[axis]).collect();
            along.sort_by(f64::total_cmp);
            let at = |share: f64| along.get((share * (along.len().max(1) - 1) as f64) as usize).copied();
            let fold = |first: Option<f64>, of: fn(f64, f64) -> f64| eyes.iter().map(|p| p[axis]).chain(first).reduce(of).unwrap_or(0.0);
            (fold(at(OUTLIERS), f64::min), fold(at(1.0 - OUTLIERS), f64::max))
        };
        let [(x0, x1), (y0, y1), (z0, z1)] = [range(0), range(1), range(2)];
        let (low, high) = (DVec3::new(x0, y0, z0), DVec3::new(x1, y1, z1));
        let (center, half) = (0.5 * (low + high), 0.5 * MARGIN * (high - low).max_element());
        let farthest = seen.iter().map(|p| (*p - center).abs().max_element()).fold(half, f64::max);
        let aabb_scale = ((farthest / half).min(MOST_SCALE as f64).ceil().max(1.0) as u32).next_power_of_two();
        SceneBox { center, half, aabb_scale }
    }

    /// Transform to model space, in which the inner cube is `[0, 1]³`.
    pub fn model_from_world(&self) -> Similarity {
        let scale = 0.5 / self.half;
        Similarity { scale, rotation: glam::DMat3::IDENTITY, translation: DVec3::splat(0.5) - self.center * scale }
    }
}

/// A 3D point found by structure from motion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SparsePoint {
    /// Position in the world.
    pub position: DVec3,
    /// sRGB color.
    pub color: [u8; 3],
    /// Reprojection error in pixels, from the model; 0 if the model has none.
    pub error: f32,
    /// Frames that see it, as ascending indices into the capture's frames; empty if unknown.
    pub frames: Vec<u32>,
}

/// Agreement between the poses of a structure-from-motion model and its points.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Agreement {
    /// Number of observations: keypoints that show a point.
    pub observations: usize,
    /// Number of observations whose point is not in the model.
    pub absent: usize,
    /// Mean and median distance in pixels between observed and projected points; `None` if nothing could be compared.
    pub error_px: Option<(f64, f64)>,
    /// Median diagonal of the photographs in pixels, for comparison with the errors.
    pub diagonal_px: f64,
    /// One entry per frame, in the capture's order.
    pub frames: Vec<FrameAgreement>,
}

/// [`Agreement`] of one photograph.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FrameAgreement {
    /// Mean distance in pixels; `None` if nothing could be compared.
    pub error_px: Option<f64>,
    /// Points that it shares with at least one other photograph.
    pub shared: usize,
}

impl Agreement {
    /// Whether the poses contradict the points, so that training may produce only fog: half of the points lie more than 1 % of the
    /// diagonal from where photographs show them.
    pub fn is_broken(&self) -> bool {
        self.error_px.is_some_and(|(_, median)| median > 0.01 * self.diagonal_px)
    }

    /// Whether more than half of the observations are of points that are not in the model.
    pub fn is_mixed(&self) -> bool {
        self.absent * 2 > self.observations
    }
}

/// Meaning of the pixels that a mask leaves out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MaskMeaning {
    /// Empty space: these pixels are transparent.
    Object,
    /// Unknown: these pixels are neither trained on nor scored.
    Unknown,
    /// As unknown; but masks mark classes besides, of which the sky is empty space.
    Classes,
}

/// How the masks of a capture are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MaskRule {
    pub meaning: MaskMeaning,
    /// White is left out instead of black.
    pub inverted: bool,
}

impl Default for MaskRule {
    fn default() -> Self {
        MaskRule { meaning: MaskMeaning::Unknown, inverted: false }
    }
}

/// Photographs with poses. The world is z up; `world_from_capture` maps from the coordinates of the input.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Capture {
    pub frames: Vec<Frame>,
    pub world_from_capture: Similarity,
    pub scene: SceneBox,
    /// What the importer skipped or assumed, one line each.
    pub notes: Vec<String>,
    #[serde(default)]
    pub masks: MaskRule,
    /// Points from structure from motion, if there are any. Not stored in a run's folder, since there may be millions.
    #[serde(skip)]
    pub points: Vec<SparsePoint>,
    /// Agreement of poses and points, if the poses come from a COLMAP model. Not stored in a run's folder.
    #[serde(skip)]
    pub agreement: Option<Agreement>,
    /// Names of photographs that could not be decoded and were left out. Not stored in a run's folder.
    #[serde(skip)]
    pub broken: Vec<String>,
}

impl Capture {
    /// How far cameras stand from what they look at, in inner cubes.
    pub fn viewing_distance(&self) -> f64 {
        let poses: Vec<Pose> = self.frames.iter().map(|f| f.world_from_camera).collect();
        focus_point(&poses).1 * self.scene.model_from_world().scale
    }

    /// A capture of frames without other metadata, in their own world.
    pub fn new(frames: Vec<Frame>, scene: SceneBox) -> Capture {
        Capture {
            frames,
            world_from_capture: Similarity::IDENTITY,
            scene,
            notes: Vec::new(),
            masks: MaskRule::default(),
            points: Vec::new(),
            agreement: None,
            broken: Vec::new(),
        }
    }

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
    fn focus_of_a_ring_is_its_center() {
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
