//! Reads folders of photographs with poses into a [`Capture`].

use crate::archive::{self, ArchiveLimits};
use crate::error::{DataError, Result};
pub use crate::imported::locate;
use crate::imported::{Imported, few};
use crate::masks::{self, MaskOptions};
use crate::split::{self, SplitRule};
use crate::{colmap, llff, photo_check, sparse, transforms_json};
use diorama_geom::capture::{Frame, Split, focus_point};
use diorama_geom::glam::DVec3;
use diorama_geom::{Capture, SceneBox, Similarity};
use std::path::{Path, PathBuf};

/// Formats of capture descriptions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// `transforms.json` of instant-ngp or nerfstudio.
    Transforms,
    /// `transforms_{train,val,test}.json` of the Blender set.
    Blender,
    /// COLMAP's `cameras`, `images`, `points3D`, binary or text.
    Colmap,
    /// `poses_bounds.npy` of LLFF.
    Llff,
}

impl Format {
    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Format::Transforms => "transforms",
            Format::Blender => "blender",
            Format::Colmap => "colmap",
            Format::Llff => "llff",
        }
    }
}

impl std::str::FromStr for Format {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Self, String> {
        match s {
            "transforms" | "nerfstudio" | "instant-ngp" => Ok(Format::Transforms),
            "blender" => Ok(Format::Blender),
            "colmap" => Ok(Format::Colmap),
            "llff" => Ok(Format::Llff),
            _ => Err(format!("format {s:?}: expected transforms, blender, colmap or llff")),
        }
    }
}

/// Options for reading a capture.
#[derive(Clone, Debug)]
pub struct ImportOptions {
    pub format: Option<Format>,
    pub split: SplitRule,
    pub seed: u64,
    /// Fewest usable views that are accepted.
    pub min_views: usize,
    pub masks: MaskOptions,
    /// Also read COLMAP models whose poses contradict their points, to inspect them, not to train on them.
    pub allow_broken: bool,
    /// Leave out photographs whose header cannot be read; [`photo_check::leave_out_broken`] handles all other damage.
    pub skip_broken: bool,
}

impl Default for ImportOptions {
    fn default() -> Self {
        ImportOptions {
            format: None,
            split: SplitRule::File,
            seed: 0,
            min_views: 3,
            masks: MaskOptions::default(),
            allow_broken: false,
            skip_broken: false,
        }
    }
}

/// Reads a capture: a folder, one of the description files in it, or a zip of it.
///
/// If a folder has several formats, `transforms.json` is preferred to the Blender set, COLMAP and LLFF, in this order, unless
/// `options.format` is set.
pub fn import(data: &Path, options: &ImportOptions) -> Result<Capture> {
    if !data.exists() {
        return Err(DataError::input(
            data,
            "does not exist; give a folder with photographs and transforms.json, a COLMAP model or poses_bounds.npy",
        ));
    }
    let unpacked;
    let data = if data.is_file() && data.extension().is_some_and(|e| e.eq_ignore_ascii_case("zip")) {
        unpacked = archive::unpacked(data, &ArchiveLimits::default())?;
        &unpacked
    } else {
        data
    };
    let (root, file) = if data.is_dir() { (data, None) } else { (data.parent().unwrap_or(Path::new(".")), Some(data)) };
    let root = if root.as_os_str().is_empty() { Path::new(".") } else { root };
    let named = file.and_then(|f| f.extension()).is_some_and(|e| e == "json");
    let format = match (options.format, named) {
        (Some(f), _) => f,
        (None, true) => Format::Transforms,
        (None, false) => detect(root)?,
    };
    let imported = match format {
        Format::Transforms => {
            transforms_json::read(&file.filter(|_| named).map_or_else(|| root.join("transforms.json"), Path::to_path_buf), root)
        }
        Format::Blender => transforms_json::read_blender(root),
        Format::Colmap => colmap::read(root),
        Format::Llff => llff::read(root),
    };
    let was_chosen = options.format.is_some() || named;
    let capture = imported.and_then(|imported| finish(data, root, imported, options));
    capture.map_err(|e| if was_chosen { e } else { beside_others(e, root, format) })
}

/// Adds to an error the other formats that the folder contains.
fn beside_others(e: DataError, root: &Path, format: Format) -> DataError {
    let others: Vec<String> = found(root).into_iter().filter(|f| *f != format).map(|f| format!("--format {}", f.name())).collect();
    match e {
        DataError::Input { path, message } if !others.is_empty() => {
            DataError::Input { path, message: format!("{message}; or read what else is there: {}", others.join(", ")) }
        }
        e => e,
    }
}

/// The folder that relative paths of a capture refer to: the capture itself, the folder of its description, or the folder that its zip was
/// unpacked to.
///
/// # Errors
/// If the path does not exist, or the zip cannot be unpacked.
pub fn root(data: &Path) -> Result<PathBuf> {
    if data.is_dir() {
        return Ok(data.to_path_buf());
    }
    if !data.is_file() {
        return Err(DataError::input(data, "does not exist; give the folder of the photographs"));
    }
    if data.extension().is_some_and(|e| e.eq_ignore_ascii_case("zip")) {
        return archive::unpacked(data, &ArchiveLimits::default());
    }
    let parent = data.parent().filter(|p| !p.as_os_str().is_empty());
    Ok(parent.unwrap_or(Path::new(".")).to_path_buf())
}

/// The formats that a folder contains, in order of preference.
fn found(root: &Path) -> Vec<Format> {
    let holds = |name: &str| root.join(name).exists();
    let all = [
        (Format::Transforms, holds("transforms.json")),
        (Format::Blender, holds("transforms_train.json")),
        (Format::Colmap, colmap::find_model(root).is_some()),
        (Format::Llff, holds("poses_bounds.npy")),
    ];
    all.into_iter().filter(|f| f.1).map(|f| f.0).collect()
}

/// The preferred format of a folder.
///
/// # Errors
/// If the folder contains no format that can be read.
pub fn detect(root: &Path) -> Result<Format> {
    if let Some(first) = found(root).first() {
        Ok(*first)
    } else if root.join("config.toml").exists() && root.join("capture.json").exists() {
        Err(DataError::input(root, "is the folder of a run; give the folder of the photographs (diorama info RUN prints it)"))
    } else {
        Err(DataError::input(
            root,
            "holds no transforms.json, transforms_train.json, COLMAP model (sparse/0) or poses_bounds.npy; diorama prepare makes a data set of bare photographs",
        ))
    }
}

fn finish(data: &Path, root: &Path, mut imported: Imported, options: &ImportOptions) -> Result<Capture> {
    let mut notes = std::mem::take(&mut imported.notes);
    if !imported.missing.is_empty() {
        notes.push(format!("{} listed images do not exist and are skipped ({})", imported.missing.len(), few(&imported.missing)));
    }
    let fitted = photo_check::fit(&mut imported.frames, options.skip_broken)?;
    sparse::keep(&mut imported.points, imported.agreement.as_mut(), &fitted.kept);
    notes.extend(fitted.notes);
    let n = imported.frames.len();
    if n < options.min_views {
        return Err(DataError::input(
            data,
            format!(
                "only {n} usable views ({} listed images are missing); at least {} are needed",
                imported.missing.len(),
                options.min_views
            ),
        ));
    }
    let first = imported.frames[0].world_from_camera;
    if n > 1 && imported.frames.iter().all(|f| (f.world_from_camera.translation - first.translation).length() < 1e-9) {
        return Err(DataError::input(data, "all cameras have the same position, so depth cannot be estimated; estimate the poses again"));
    }
    if let Some(a) = &imported.agreement {
        if a.is_broken() && !options.allow_broken {
            let model = imported.model.as_deref().unwrap_or(data);
            let others = sparse::others_beside(model).map_or(String::new(), |files| format!("; {files}"));
            return Err(DataError::input(model, format!("{}; {}{others}", sparse::broken(a), sparse::BROKEN_CURE)));
        }
        if !a.is_broken() {
            notes.extend(sparse::warnings(a, &imported.frames));
        }
    }
    let mut seen = std::collections::HashSet::new();
    if let Some(twice) = imported.frames.iter().find(|f| !seen.insert(&f.image)) {
        notes.push(format!("{} is listed more than once", twice.name));
    }
    let rule = masks::assign(root, &mut imported.frames, &options.masks, imported.mask_meaning, &mut notes)?;
    let leveled = if imported.unknown_up { level(&mut imported.frames) } else { Similarity::IDENTITY };
    imported.points.iter_mut().for_each(|p| p.position = leveled.point(p.position));
    let world_from_capture = imported.frames_from_capture.map_or(leveled, |f| leveled.after(&f));
    split::apply(&options.split, &mut imported.frames, imported.has_own_split, options.seed);
    let train = imported.frames.iter().filter(|f| f.split == Split::Train).count();
    if train < 2 {
        return Err(DataError::input(data, format!("the split leaves {train} training views of {n}; choose another --split")));
    }
    let scene = imported.scene.unwrap_or_else(|| automatic_scene(&imported.frames));
    Ok(Capture {
        world_from_capture,
        notes,
        masks: rule,
        points: imported.points,
        agreement: imported.agreement,
        broken: fitted.broken,
        ..Capture::new(imported.frames, scene)
    })
}

/// Rotates the world so that the mean up direction of the cameras is +z.
fn level(frames: &mut [Frame]) -> Similarity {
    let up: DVec3 = frames.iter().map(|f| -f.world_from_camera.rotation.y_axis).sum();
    if up.length() < 1e-6 {
        return Similarity::IDENTITY;
    }
    let s = Similarity { rotation: diorama_geom::transform::rotation_between(up, DVec3::Z), ..Similarity::IDENTITY };
    for f in frames {
        f.world_from_camera = s.pose(&f.world_from_camera);
    }
    s
}

/// Chooses a box around the point that the cameras look at. The edge of the inner cube is the median distance of the cameras from that
/// point; the outer cube is eight times as wide.
fn automatic_scene(frames: &[Frame]) -> SceneBox {
    let poses: Vec<_> = frames.iter().map(|f| f.world_from_camera).collect();
    let (center, distance) = focus_point(&poses);
    SceneBox { center, half: 0.5 * distance, aabb_scale: 8 }
}
