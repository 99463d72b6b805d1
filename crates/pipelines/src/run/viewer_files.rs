//! What was saved in the viewer, in the folder of its run: the crop box (`crop.json`), a measured length (`scale.json`), and a camera
//! path (`camera_path.json`).

use crate::error::{PipelineError, Result};
use diorama_data::{DataError, atomic, camera_path_json, error};
use diorama_geom::Similarity;
use diorama_geom::glam::DVec3;
use diorama_geom::view_source::MeasuredLength;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Lowest and highest corner in the world.
pub type Crop = ([f32; 3], [f32; 3]);

const CROP: &str = "crop.json";
const SCALE: &str = "scale.json";
const PATH: &str = "camera_path.json";
const SMALL: u64 = 1 << 16;
const LONGEST_PATH: u64 = 1 << 26;

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CropFile {
    /// Corners in the world: z up, as in the viewer.
    min: [f32; 3],
    max: [f32; 3],
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ScaleFile {
    /// Two points in the capture's frame.
    points: [[f64; 3]; 2],
    metres: f64,
}

/// All that was saved in the viewer, in the world, as the page has it.
#[derive(Clone, Debug, Default)]
pub struct Saved {
    pub crop: Option<Crop>,
    pub measured: Option<MeasuredLength>,
    /// nerfstudio's JSON.
    pub path: Option<String>,
}

impl Saved {
    /// Reads what was saved for a run.
    ///
    /// # Errors
    /// When a file is malformed.
    pub fn read(run: &Path, world_from_capture: &Similarity) -> Result<Saved> {
        let measured = read_scale(run)?.map(|m| moved(m, world_from_capture));
        Ok(Saved { crop: read_crop(run)?, measured, path: read_path(run, world_from_capture)? })
    }
}

/// The crop box of a run, if one was saved.
///
/// # Errors
/// When the file is malformed.
pub fn read_crop(run: &Path) -> Result<Option<Crop>> {
    let cure = "save the box in the viewer again or remove the file";
    let Some(CropFile { min, max }) = read_json(&run.join(CROP), cure)? else { return Ok(None) };
    if (0..3).any(|k| min[k] >= max[k] || !min[k].is_finite() || !max[k].is_finite()) {
        return Err(DataError::input(run.join(CROP), format!("min: must lie below max; {cure}")).into());
    }
    Ok(Some((min, max)))
}

/// The length that was measured for a run, in the capture's frame, if one was saved.
///
/// # Errors
/// When the file is malformed.
pub fn read_scale(run: &Path) -> Result<Option<MeasuredLength>> {
    let cure = "measure in the viewer again or remove the file";
    let Some(ScaleFile { points, metres }) = read_json(&run.join(SCALE), cure)? else { return Ok(None) };
    if points[0] == points[1] || points.iter().flatten().any(|v| !v.is_finite()) || !(metres > 0.0 && metres.is_finite()) {
        return Err(DataError::input(run.join(SCALE), format!("needs two points that differ and metres above 0; {cure}")).into());
    }
    Ok(Some(MeasuredLength { points, metres }))
}

/// The camera path of a run with its cameras in the world, if one was saved.
fn read_path(run: &Path, world_from_capture: &Similarity) -> Result<Option<String>> {
    let file = run.join(PATH);
    if !file.exists() {
        return Ok(None);
    }
    let wrong = |e: String| DataError::input(&file, format!("{e}; save the path in the viewer again or remove the file"));
    let bytes = error::read(&file, LONGEST_PATH)?;
    let text = String::from_utf8(bytes).map_err(|_| wrong("is not UTF-8 text".into()))?;
    let path = camera_path_json::read(&file, world_from_capture).and_then(|_| camera_path_json::moved(&text, &file, world_from_capture));
    path.map(Some).map_err(|e| match e {
        DataError::Input { message, .. } => wrong(message).into(),
        e => e.into(),
    })
}

/// Keeps a crop box, or forgets it.
///
/// # Errors
/// When the file cannot be written.
pub fn save_crop(run: &Path, crop: Option<Crop>) -> Result<()> {
    write_json(&run.join(CROP), crop.map(|(min, max)| CropFile { min, max }))
}

/// Keeps a length that was measured in the world, or forgets it.
///
/// # Errors
/// When the file cannot be written.
pub fn save_measured(run: &Path, measured: Option<MeasuredLength>, world_from_capture: &Similarity) -> Result<()> {
    let in_capture = measured.map(|m| moved(m, &world_from_capture.inverse()));
    write_json(&run.join(SCALE), in_capture.map(|MeasuredLength { points, metres }| ScaleFile { points, metres }))
}

/// Keeps a camera path whose cameras stand in the world; the file.
///
/// # Errors
/// When the path is malformed, or the file cannot be written.
pub fn save_path(run: &Path, json: &str, world_from_capture: &Similarity) -> Result<PathBuf> {
    let file = run.join(PATH);
    let in_capture = camera_path_json::moved(json, &file, &world_from_capture.inverse())?;
    atomic::write(&file, in_capture.as_bytes())?;
    Ok(file)
}

/// A camera path as other programs write it, whose cameras stand in the capture's frame, with its cameras in the world.
///
/// # Errors
/// When the path is malformed.
pub fn path_in_world(run: &Path, json: &str, world_from_capture: &Similarity) -> Result<String> {
    Ok(camera_path_json::moved(json, &run.join(PATH), world_from_capture)?)
}

fn moved(m: MeasuredLength, by: &Similarity) -> MeasuredLength {
    MeasuredLength { points: m.points.map(|p| by.point(DVec3::from_array(p)).to_array()), ..m }
}

fn read_json<T: DeserializeOwned>(file: &Path, cure: &str) -> Result<Option<T>> {
    if !file.exists() {
        return Ok(None);
    }
    let text = error::read(file, SMALL)?;
    let wrong = |e: serde_json::Error| PipelineError::from(DataError::input(file, format!("{e}; {cure}")));
    serde_json::from_slice(&text).map(Some).map_err(wrong)
}

/// Writes a value, or removes the file.
fn write_json<T: Serialize>(file: &Path, value: Option<T>) -> Result<()> {
    match value {
        Some(v) => atomic::write(file, &serde_json::to_vec(&v).expect("plain values"))?,
        None if file.exists() => std::fs::remove_file(file).map_err(DataError::io(file, "remove"))?,
        None => {}
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::glam::DMat3;

    #[test]
    fn what_is_saved_comes_back_until_it_is_forgotten() {
        let dir = tempfile::tempdir().unwrap();
        let run = dir.path();
        let world_from_capture = Similarity { scale: 2.0, rotation: DMat3::from_rotation_z(0.5), translation: DVec3::new(1.0, 2.0, 3.0) };
        let measured = MeasuredLength { points: [[0.0; 3], [1.0, 2.0, 3.0]], metres: 4.0 };
        let crop = ([0.0, 0.1, 0.2], [1.0, 1.1, 1.2]);
        save_crop(run, Some(crop)).unwrap();
        save_measured(run, Some(measured), &world_from_capture).unwrap();
        let saved = Saved::read(run, &world_from_capture).unwrap();
        assert_eq!(saved.crop, Some(crop));
        let back = saved.measured.unwrap();
        let far = back.points.iter().flatten().zip(measured.points.iter().flatten()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(far < 1e-12 && back.metres == 4.0, "{back:?}");
        // The file has it in the capture's frame.
        assert!((read_scale(run).unwrap().unwrap().points[0][0] - measured.points[0][0]).abs() > 0.1);
        save_crop(run, None).unwrap();
        save_measured(run, None, &world_from_capture).unwrap();
        let saved = Saved::read(run, &world_from_capture).unwrap();
        assert!(saved.crop.is_none() && saved.measured.is_none());
    }

    #[test]
    fn malformed_files_are_named_with_a_cure() {
        let dir = tempfile::tempdir().unwrap();
        let run = dir.path();
        for (name, text) in [
            (CROP, r#"{"min":[0,0,0],"max":[1,0,1]}"#),
            (CROP, "{"),
            (SCALE, r#"{"points":[[0,0,0],[0,0,0]],"metres":1}"#),
            (SCALE, r#"{"points":[[0,0,0],[1,0,0]],"metres":0}"#),
            (PATH, "[]"),
        ] {
            std::fs::write(run.join(name), text).unwrap();
            let e = Saved::read(run, &Similarity::IDENTITY).unwrap_err().to_string();
            assert!(e.contains(name) && e.contains("remove the file"), "{e}");
            std::fs::remove_file(run.join(name)).unwrap();
        }
    }
}
