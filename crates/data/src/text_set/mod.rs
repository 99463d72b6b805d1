//! Annotations of a generated data set of images with writing: one JSON object per line in `annotations.jsonl`, and writers of the
//! formats that detectors are trained from.
//!
//! Coordinates are in pixels of the image, the outer corner of the upper left pixel at 0, 0 and the opposite one at width, height. Every
//! quad and polygon is checked before anything is written: finite, inside of the image, without crossing sides, clockwise.
//!
//! | Format | Place in the data set's folder | A word that is not to be read |
//! |---|---|---|
//! | `icdar13` | `icdar13/gt_NAME.txt`: `left top right bottom "text"` | `###` |
//! | `icdar15` | `icdar15/gt_NAME.txt`: `x1,y1,…,x4,y4,text` | `###` |
//! | `mlt17` | `mlt17/gt_NAME.txt`: `x1,y1,…,x4,y4,script,text` | `###` |
//! | `ppocr` | `Label.txt`: the image, a tab, a list | `###` and `difficult` |
//! | `textnerf` | the same with poses, and `meta.json` | `###` and `difficult` |
//! | `mmocr` | `mmocr/textdet.json` | `ignore` |
//! | `doctr` | `doctr/labels.json`, with `images/` as the folder of images | left out |
//! | `coco` | `coco/instances.json` | `iscrowd` |
//! | `cocotext` | `coco_text/cocotext.json` | `illegible`, without text |
//! | `textocr` | `textocr/textocr.json` | the text `.` |

mod coco;
pub mod detector_set;
mod geometry;
mod icdar;
mod label_txt;
mod set_check;
pub mod tar_shards;
mod toolboxes;

use crate::atomic;
use crate::error::{self, DataError, Result};
use crate::text_labels::UNREADABLE;
use diorama_geom::glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};
use std::path::Path;

pub use set_check::check;

/// File of the annotations in the data set's folder.
pub const ANNOTATIONS: &str = "annotations.jsonl";
const LIMIT: u64 = 4 << 30;
/// Files of the formats that have one for all images.
const PLACES: [&str; 7] = [
    "Label.txt",
    "meta.json",
    "mmocr/textdet.json",
    "doctr/labels.json",
    "coco/instances.json",
    "coco_text/cocotext.json",
    "textocr/textocr.json",
];
/// What a line looks like, for errors.
const EXAMPLE: &str = r#"{"image": "images/000000.png", "width": 640, "height": 480, "intrinsic": [500, 500, 320, 240], "world_from_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scene": "s01", "words": []}"#;

/// An image of the data set, its camera and its words.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SetImage {
    /// Path relative to the data set's folder, with `/`: `images/000000.png`. Its name without the extension is unique in the set.
    pub image: String,
    pub width: u32,
    pub height: u32,
    /// fx, fy, cx, cy in pixels.
    pub intrinsic: [f64; 4],
    /// Rotation and center of the camera (right, down, forward).
    pub world_from_camera: [[f64; 4]; 3],
    /// Name of the scene that it shows.
    pub scene: String,
    /// Name of the style that changed its look.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub style: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    pub words: Vec<SetWord>,
}

/// A word of an image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SetWord {
    /// Region of the scene that it belongs to.
    pub id: u32,
    /// Corners in pixels, clockwise from the upper left in reading order.
    pub quad: [[f64; 2]; 4],
    /// Outline in pixels, clockwise from the upper left in reading order; more than four corners on curved surfaces.
    pub polygon: Vec<[f64; 2]>,
    /// `###` if nobody can read it.
    pub transcription: String,
    /// Unicode's name of the script, as far as it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub script: Option<String>,
    /// Whether it counts neither as found nor as missed.
    #[serde(default)]
    pub ignore: bool,
    /// Visible share of its surface, 0 to 1.
    pub visibility: f64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pose: Option<WordPose>,
    /// Cluster of poses that it was sampled from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cluster: Option<usize>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub characters: Vec<SetCharacter>,
}

/// Pose of a word's region: x along the reading direction, y up, z toward the viewer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WordPose {
    /// `camera_from_region`: rotation and center.
    pub text_pose: [[f64; 4]; 3],
    /// The rotation as w, x, y, z of unit length, w not negative.
    pub quaternion: [f64; 4],
    /// The rotation as axis times angle in radians, 0 to π.
    pub axis_angle: [f64; 3],
    /// Width and height in scene units.
    pub size: [f64; 2],
}

/// A character of a word.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SetCharacter {
    pub text: String,
    /// Corners in pixels, in the order of the word's.
    pub quad: [[f64; 2]; 4],
}

/// Formats that are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SetFormat {
    Icdar13,
    Icdar15,
    Mlt17,
    Ppocr,
    Mmocr,
    Doctr,
    Coco,
    CocoText,
    TextOcr,
    TextNerf,
}

impl SetFormat {
    pub const ALL: [SetFormat; 10] = [
        SetFormat::Icdar13,
        SetFormat::Icdar15,
        SetFormat::Mlt17,
        SetFormat::Ppocr,
        SetFormat::Mmocr,
        SetFormat::Doctr,
        SetFormat::Coco,
        SetFormat::CocoText,
        SetFormat::TextOcr,
        SetFormat::TextNerf,
    ];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            SetFormat::Icdar13 => "icdar13",
            SetFormat::Icdar15 => "icdar15",
            SetFormat::Mlt17 => "mlt17",
            SetFormat::Ppocr => "ppocr",
            SetFormat::Mmocr => "mmocr",
            SetFormat::Doctr => "doctr",
            SetFormat::Coco => "coco",
            SetFormat::CocoText => "cocotext",
            SetFormat::TextOcr => "textocr",
            SetFormat::TextNerf => "textnerf",
        }
    }

    /// The format of a name.
    pub fn named(name: &str) -> Option<SetFormat> {
        SetFormat::ALL.into_iter().find(|f| f.name() == name)
    }
}

impl WordPose {
    /// The pose of a rigid `camera_from_region`, with its rotation as quaternion and axis-angle.
    pub fn new(text_pose: [[f64; 4]; 3], size: [f64; 2]) -> WordPose {
        let mut q = DQuat::from_mat3(&rotation(&text_pose)).normalize();
        if q.w < 0.0 {
            q = -q;
        }
        let axis = DVec3::new(q.x, q.y, q.z);
        let sine = axis.length();
        let omega = if sine == 0.0 { DVec3::ZERO } else { axis * (2.0 * sine.atan2(q.w) / sine) };
        // Adding zero turns −0 into 0.
        WordPose { text_pose, quaternion: [q.w, q.x, q.y, q.z].map(|v| v + 0.0), axis_angle: omega.to_array().map(|v| v + 0.0), size }
    }
}

impl SetWord {
    /// Whether a detector is to find it and a reader to read it.
    fn is_read(&self) -> bool {
        !self.ignore && self.transcription != UNREADABLE
    }

    /// The transcription, `###` for a word that is not to be read.
    fn text(&self) -> &str {
        if self.is_read() { &self.transcription } else { UNREADABLE }
    }
}

impl SetImage {
    /// Name of the image without folders.
    fn file_name(&self) -> &str {
        self.image.rsplit('/').next().unwrap_or(&self.image)
    }

    /// Name of the image without folders and extension.
    fn stem(&self) -> &str {
        let name = self.file_name();
        name.rsplit_once('.').map_or(name, |(stem, _)| stem)
    }

    /// Points exactly inside of the image: [`check`] lets them leave it by a millionth of a pixel.
    fn clamped(&self, points: &[[f64; 2]]) -> Vec<[f64; 2]> {
        points.iter().map(|p| [p[0].clamp(0.0, self.width as f64) + 0.0, p[1].clamp(0.0, self.height as f64) + 0.0]).collect()
    }
}

/// The rotation of a 3×4 transform.
fn rotation(transform: &[[f64; 4]; 3]) -> DMat3 {
    let column = |c: usize| DVec3::new(transform[0][c], transform[1][c], transform[2][c]);
    DMat3::from_cols(column(0), column(1), column(2))
}

/// Reads the annotations of a data set and checks each image, see [`check`].
///
/// # Errors
/// With the line, when the file is missing, holds something else, an image fails its check or two images have one name.
pub fn read(folder: &Path) -> Result<Vec<SetImage>> {
    let path = folder.join(ANNOTATIONS);
    if !path.is_file() {
        return Err(DataError::input(
            folder,
            format!("holds no {ANNOTATIONS}; give the folder of a data set that `diorama text synth` wrote"),
        ));
    }
    let bytes = error::read(&path, LIMIT)?;
    let (mut images, mut at) = (Vec::<SetImage>::new(), Vec::new());
    for (n, line) in bytes.split(|b| *b == b'\n').enumerate().filter(|(_, l)| !l.trim_ascii().is_empty()) {
        let place = format!("line {}", n + 1);
        let wrong = |e: serde_json::Error| DataError::input(&path, format!("{place}: {e}; expected a line such as {EXAMPLE}"));
        images.push(serde_json::from_slice(line).map_err(wrong)?);
        at.push(place);
    }
    if images.is_empty() {
        return Err(DataError::input(&path, "holds no image; write the data set again"));
    }
    set_check::check_all(&images, |k| at[k].clone()).map_err(|e| DataError::input(&path, e))?;
    Ok(images)
}

/// Writes the annotations.
///
/// # Errors
/// When an image fails its check, two images have one name, or the file cannot be written.
pub fn save(folder: &Path, images: &[SetImage]) -> Result<()> {
    let path = folder.join(ANNOTATIONS);
    set_check::check_all(images, |k| format!("image {k}")).map_err(|e| DataError::input(&path, e))?;
    let lines: Vec<String> = images.iter().map(|i| serde_json::to_string(i).expect("plain values") + "\n").collect();
    put(folder, ANNOTATIONS, lines.concat().as_bytes())
}

/// Writes the annotations in the formats, each into its place in the data set's folder; equal annotations give equal bytes.
///
/// A `Label.txt` for both `ppocr` and `textnerf` is the one of `textnerf`, which has all keys of the other.
///
/// # Errors
/// When an image fails its check, two images have one name, an image that `doctr` hashes is missing, or a file cannot be written.
pub fn write(folder: &Path, images: &[SetImage], formats: &[SetFormat]) -> Result<()> {
    set_check::check_all(images, |k| format!("image {k}")).map_err(|e| DataError::input(folder, e))?;
    for format in SetFormat::ALL.into_iter().filter(|f| formats.contains(f)) {
        match format {
            SetFormat::Icdar13 | SetFormat::Icdar15 | SetFormat::Mlt17 => icdar::write(folder, images, format)?,
            SetFormat::Ppocr if formats.contains(&SetFormat::TextNerf) => (),
            SetFormat::Ppocr => label_txt::write_ppocr(folder, images)?,
            SetFormat::TextNerf => label_txt::write_textnerf(folder, images)?,
            SetFormat::Mmocr => toolboxes::write_mmocr(folder, images)?,
            SetFormat::Doctr => toolboxes::write_doctr(folder, images)?,
            SetFormat::Coco => coco::write_coco(folder, images)?,
            SetFormat::CocoText => coco::write_coco_text(folder, images)?,
            SetFormat::TextOcr => coco::write_textocr(folder, images)?,
        }
    }
    Ok(())
}

/// Removes images, their labels in all formats, shards, and the annotations first: what else is in the folder stays.
///
/// # Errors
/// When a file cannot be removed.
pub fn remove(folder: &Path, images: &[SetImage]) -> Result<()> {
    let gone = |place: &str| match std::fs::remove_file(folder.join(place)) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(DataError::io(&folder.join(place), "remove")(e)),
        _ => Ok(()),
    };
    [ANNOTATIONS].into_iter().chain(PLACES).try_for_each(gone)?;
    tar_shards::remove(folder)?;
    let lines = [SetFormat::Icdar13, SetFormat::Icdar15, SetFormat::Mlt17];
    images.iter().try_for_each(|image| {
        gone(&image.image)?;
        lines.iter().try_for_each(|f| gone(&format!("{}/gt_{}.txt", f.name(), image.stem())))
    })
}

/// Writes a file into its place in the data set's folder.
fn put(folder: &Path, place: &str, bytes: &[u8]) -> Result<()> {
    let path = folder.join(place);
    let parent = path.parent().unwrap_or(folder);
    std::fs::create_dir_all(parent).map_err(DataError::io(parent, "create"))?;
    atomic::write(&path, bytes)
}

/// Writes a JSON object as one line.
fn put_json(folder: &Path, place: &str, value: &serde_json::Value) -> Result<()> {
    put(folder, place, format!("{value}\n").as_bytes())
}

#[cfg(test)]
mod tests;
