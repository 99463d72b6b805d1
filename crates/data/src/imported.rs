//! The result that each format's reader returns to [`crate::import`], and functions that readers share: finding photographs, and listing
//! those without pose.

use crate::error::{DataError, Result};
use crate::photo_import;
use diorama_geom::capture::{Agreement, Frame, MaskMeaning};
use diorama_geom::{SceneBox, Similarity, SparsePoint};
use std::collections::{BTreeSet, HashSet};
use std::path::{Component, Path, PathBuf};

/// Result of a reader.
#[derive(Debug, Default)]
pub struct Imported {
    pub frames: Vec<Frame>,
    /// The scene's box, if the format defines it.
    pub scene: Option<SceneBox>,
    /// Names of listed images that do not exist.
    pub missing: Vec<String>,
    pub has_own_split: bool,
    /// Inverse of a transform that the file's author applied to the poses; `None` if there was none.
    pub frames_from_capture: Option<Similarity>,
    /// Whether the world may not be z up and must be rotated by the cameras' up directions.
    pub unknown_up: bool,
    /// What masked-out pixels mean, if the file says so.
    pub mask_meaning: Option<MaskMeaning>,
    /// Points from structure from motion, in the same world as the frames.
    pub points: Vec<SparsePoint>,
    /// How well the points agree with the poses, if the format allows to compare them.
    pub agreement: Option<Agreement>,
    /// Folder of the COLMAP model, if there is one.
    pub model: Option<PathBuf>,
    /// What was skipped or assumed, one line each.
    pub notes: Vec<String>,
}

/// Folders that may contain the photographs, in order of preference; the last ones hold reduced copies.
pub const IMAGE_FOLDERS: [&str; 5] = ["images", ".", "images_2", "images_4", "images_8"];

/// A note that lists photographs beside the model's that are not in the model; `None` if there are none. The capture's own folder is not
/// searched, because it may contain other pictures.
///
/// # Errors
/// If a folder of photographs cannot be read.
pub(crate) fn without_pose(root: &Path, frames: &[Frame]) -> Result<Option<String>> {
    let known: HashSet<&Path> = frames.iter().map(|f| &*f.image).collect();
    let folders: BTreeSet<&Path> = known.iter().filter_map(|i| i.parent()).filter(|f| *f != root && *f != root.join(".")).collect();
    let mut unknown = Vec::new();
    for folder in folders {
        let beside = photo_import::found(folder)?.into_iter().filter(|p| !known.contains(&**p));
        unknown.extend(beside.filter_map(|p| p.file_name().map(|n| n.to_string_lossy().into_owned())));
    }
    let note = |n: usize| format!("{n} photographs beside these have no pose in the model and are left out ({})", few(&unknown));
    Ok((!unknown.is_empty()).then(|| note(unknown.len())))
}

/// Finds a file that a description names, inside `root` only. A missing extension is added.
///
/// # Errors
/// If the name leads out of `root`.
pub fn locate(root: &Path, name: &str, file: &Path, field: &str) -> Result<Option<PathBuf>> {
    let escape = || DataError::input(file, format!("{field}: {name} leads out of the dataset folder; move the file into it"));
    let relative = Path::new(name);
    let windows = name.contains('\\') || name.as_bytes().get(1) == Some(&b':');
    let mut depth = 0i32;
    for c in relative.components() {
        match c {
            Component::Normal(_) => depth += 1,
            Component::ParentDir => depth -= 1,
            Component::CurDir => {}
            Component::RootDir | Component::Prefix(_) => return Err(escape()),
        }
        if depth < 0 {
            return Err(escape());
        }
    }
    if windows {
        return Err(escape());
    }
    let direct = root.join(relative);
    let mut candidates = vec![direct.clone()];
    for extension in ["png", "jpg", "jpeg", "PNG", "JPG", "JPEG", "webp", "tif", "tiff", "exr", "hdr"] {
        let mut name = direct.clone().into_os_string();
        name.push(".");
        name.push(extension);
        candidates.push(name.into());
    }
    let Some(found) = candidates.into_iter().find(|c| c.is_file()) else { return Ok(None) };
    let real = found.canonicalize().map_err(DataError::io(&found, "read"))?;
    let base = root.canonicalize().map_err(DataError::io(root, "read"))?;
    if !real.starts_with(&base) {
        return Err(escape());
    }
    Ok(Some(found))
}

/// The first three names, for messages.
pub(crate) fn few(names: &[String]) -> String {
    format!("{}{}", names[..names.len().min(3)].join(", "), if names.len() > 3 { ", …" } else { "" })
}
