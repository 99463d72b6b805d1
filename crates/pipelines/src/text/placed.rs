//! Text regions in the world: `regions.json` of a run.

use super::camera::Placed;
use super::surface::Rectangle;
use crate::error::{PipelineError, Result};
use diorama_data::text_labels::Kind;
use diorama_data::{DataError, atomic, error};
use diorama_geom::glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// File of a run's regions.
pub const REGIONS: &str = "regions.json";
const LIMIT: u64 = 1 << 26;

/// A region of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlacedRegion {
    pub id: u32,
    pub transcription: String,
    /// Unicode's name of the script, as far as it is known.
    pub script: Option<String>,
    pub kind: Kind,
    /// Where it is, in units of the capture; none where its points are not on a surface: it is then only known view by view.
    pub rectangle: Option<Rectangle>,
    /// Points that the surface was fitted to.
    pub points: usize,
    /// Distance before the surface, in units of the capture, from which on matter is its own.
    pub front: f64,
}

impl PlacedRegion {
    /// Frame at the middle, x along the reading direction, and size.
    pub fn placed(&self) -> Option<Placed> {
        let r = self.rectangle.as_ref()?;
        let middle = DVec2::ZERO;
        Some(Placed { world_from_region: r.reading_frame(middle), center_in_world: r.reading_point(middle), size: r.reading_size() })
    }
}

/// Reads the regions of a run.
///
/// # Errors
/// When `diorama text label` has not been run, or the file is damaged.
pub fn read(run: &Path) -> Result<Vec<PlacedRegion>> {
    let path = run.join(REGIONS);
    if !path.exists() {
        return Err(PipelineError::Usage(format!("{}: is missing; run `diorama text label {}` first", path.display(), run.display())));
    }
    let bytes = error::read(&path, LIMIT)?;
    Ok(serde_json::from_slice(&bytes).map_err(|e| DataError::input(&path, format!("{e}; run `diorama text label` again")))?)
}

/// # Errors
/// When the file cannot be written.
pub fn save(run: &Path, regions: &[PlacedRegion]) -> Result<()> {
    Ok(atomic::write(&run.join(REGIONS), &serde_json::to_vec_pretty(regions).expect("plain values"))?)
}

/// Angle between two rotations in radians.
pub fn angle_between(a: &DMat3, b: &DMat3) -> f64 {
    let m = a.transpose() * *b;
    (0.5 * (m.x_axis.x + m.y_axis.y + m.z_axis.z - 1.0)).clamp(-1.0, 1.0).acos()
}

/// A rotation's columns from the rows of `[rotation | translation]`, and its translation.
pub fn from_rows(rows: &[[f64; 4]; 3]) -> (DMat3, DVec3) {
    let column = |k: usize| DVec3::new(rows[0][k], rows[1][k], rows[2][k]);
    (DMat3::from_cols(column(0), column(1), column(2)), column(3))
}
