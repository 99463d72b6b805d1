//! Exact labels of a generated scene with writing, in `truth/` beside its photographs.
//!
//! `truth.json` lists regions, cameras' views and what they show; `VIEW_classes.png` has 0 for the background and `id + 1` for a region,
//! `VIEW_ink.png` the share of each pixel that is ink, `VIEW_depth.exr` the distance along the ray and whether it meets a surface.

use super::regions::{Character, Rect, Region, TextPose};
use crate::error::Result;
use diorama_data::{DataError, atomic, error};
use diorama_geom::glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

const NAME: &str = "truth.json";
const LIMIT: u64 = 1 << 28;

/// All that is exact of a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    pub family: String,
    pub seed: u64,
    /// Fonts of the boards.
    pub fonts: Vec<String>,
    pub regions: Vec<Region>,
    pub views: Vec<ViewTruth>,
}

/// A photograph.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewTruth {
    pub name: String,
    pub held_out: bool,
    /// Exposure over the others' mean, in stops.
    pub exposure: f64,
    /// Regions of which something is visible.
    pub regions: Vec<Shown>,
}

/// A region in a view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shown {
    pub id: usize,
    /// Corners in pixels, clockwise from the upper left in reading order; where the board bends, of what faces the camera.
    pub quad: [[f64; 2]; 4],
    /// The outline from the same corner; of flat regions the corners.
    pub polygon: Vec<[f64; 2]>,
    /// Corners of each character; none of one that faces away.
    pub characters: Vec<Option<[[f64; 2]; 4]>>,
    /// Share of the region that is visible.
    pub visibility: f64,
    /// Rows of `[rotation | translation]` of the region's frame in the camera's.
    pub text_pose: [[f64; 4]; 3],
    /// Width along the surface, and height, in meters.
    pub size: [f64; 2],
}

impl Shown {
    /// Pose of the region in the camera.
    pub fn pose(&self) -> TextPose {
        let p = &self.text_pose;
        let column = |k: usize| DVec3::new(p[0][k], p[1][k], p[2][k]);
        TextPose { rotation: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) }
    }
}

/// Rows of a pose.
pub fn rows(pose: &TextPose) -> [[f64; 4]; 3] {
    let (r, t) = (&pose.rotation, pose.translation);
    std::array::from_fn(|k| [r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]])
}

impl Truth {
    /// # Errors
    /// When the file is missing or damaged.
    pub fn read(scene: &Path) -> Result<Truth> {
        let path = file(scene, NAME);
        let bytes = error::read(&path, LIMIT)?;
        Ok(serde_json::from_slice(&bytes).map_err(|e| DataError::input(&path, format!("{e}; generate the scene again")))?)
    }

    /// # Errors
    /// When the file cannot be written.
    pub fn save(&self, scene: &Path) -> Result<()> {
        Ok(atomic::write(&file(scene, NAME), &serde_json::to_vec_pretty(self).expect("plain values"))?)
    }
}

/// A file of the truth.
pub fn file(scene: &Path, name: &str) -> PathBuf {
    scene.join("truth").join(name)
}

/// A character from its bounds.
pub(super) fn character(text: &str, rect: Rect) -> Character {
    Character { text: text.into(), rect }
}
