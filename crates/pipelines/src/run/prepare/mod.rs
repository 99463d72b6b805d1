//! Prepares a data set from photographs or a video: selects sharp frames, takes poses from COLMAP or from the input, orients and scales the
//! world, post-processes photographs, splits them into training and held-out views, and draws a contact sheet.

pub mod finish;
mod frames;
mod posed;
mod sfm;
mod sheet;
mod world;

use crate::error::{PipelineError, Result};
use diorama_data::masks::MaskOptions;
use diorama_data::split::{self, SplitRule};
use diorama_data::video::{self, Choice};
use diorama_data::{DataError, atomic, colmap, import, lock, photo, photo_import, sparse_ply, transforms_json};
use diorama_geom::capture::{Frame, MaskRule, Split};
use diorama_geom::{Capture, SceneBox, SparsePoint};
use serde::Serialize;
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

pub use finish::Finish;
pub use frames::Wanted;
pub use sfm::Matcher;
pub(crate) use world::cameras_up;

/// Source of the camera poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sfm {
    Colmap,
    /// No structure from motion: the input has poses.
    None,
}

impl std::str::FromStr for Sfm {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Self, String> {
        match s {
            "colmap" => Ok(Sfm::Colmap),
            "none" => Ok(Sfm::None),
            _ => Err(format!("sfm {s:?}: expected colmap or none")),
        }
    }
}

/// Input, output and settings of [`prepare`].
#[derive(Clone, Debug)]
pub struct PrepareOptions {
    /// A folder of photographs or a video; a posed capture with [`Sfm::None`].
    pub input: PathBuf,
    pub out: PathBuf,
    pub sfm: Sfm,
    /// Which format to read from a posed capture that holds several.
    pub format: Option<import::Format>,
    /// How the masks of a posed capture are read.
    pub masks: MaskOptions,
    /// Which frames of a video are extracted, and with [`Choice::Sharp`] which photographs of a folder are taken.
    pub choice: Choice,
    /// How many photographs [`Sfm::Colmap`] is given.
    pub wanted: Wanted,
    /// Take every n-th photograph.
    pub every: usize,
    /// Longest side in pixels; larger photographs are downsampled.
    pub max_side: u32,
    pub matcher: Matcher,
    /// Most features per photograph.
    pub features: usize,
    /// COLMAP's name of the camera model, one of `sfm::LENSES`.
    pub lens: String,
    pub finish: Finish,
    /// [`SplitRule::File`] keeps the split of a posed capture; without one, every eighth frame is held out.
    pub split: SplitRule,
    pub seed: u64,
    /// Least share of the photographs that must get a pose, in percent.
    pub min_registered: f64,
    pub threads: Option<usize>,
    /// Continue an interrupted call.
    pub resume: bool,
    pub force: bool,
    /// Leave out photographs that cannot be decoded.
    pub skip_broken: bool,
}

/// Result of [`prepare`].
#[derive(Clone, Debug, Serialize)]
pub struct Prepared {
    pub folder: PathBuf,
    pub images: usize,
    pub registered: usize,
    /// Photographs without a pose.
    pub lost: Vec<String>,
    /// Photographs that could not be decoded and were left out.
    pub broken: Vec<String>,
    pub points: usize,
    /// Mean angle between the cameras' own up directions and the world's, in degrees.
    pub tilt: f64,
    /// Whether a floor plane was found; its normal is then the up direction.
    pub floor: bool,
    pub aabb_scale: u32,
    pub held_out: usize,
    pub sheet: PathBuf,
    #[serde(flatten)]
    pub finished: finish::Finished,
}

/// Names within the data set.
const IMAGES: &str = "images";
const WORK: &str = "colmap";
const POSED: &str = "posed";
const MASKS: &str = "masks";
const POINTS: &str = "points.ply";
const IMAGES_DONE: &str = "images.done";
/// Within [`WORK`]: 8-bit PNGs of linear-light photographs for COLMAP, under the same file names.
const SEEN: &str = "seen";
/// Within [`WORK`]: names of the broken photographs that were left out, one per line.
const BROKEN: &str = "images.broken";

/// Photographs with poses, before they are finished.
struct Posed {
    frames: Vec<Frame>,
    scene: SceneBox,
    masks: MaskRule,
    /// From the frames' world to the upright world of [`finish::finish`]: the origin is the focus point, the cameras are [`world::DISTANCE`] away.
    finishing_from_world: diorama_geom::Similarity,
    found: finish::Found,
    /// Sparse points in the frames' world; their frame numbers index `frames`.
    points: Vec<SparsePoint>,
    images: usize,
    lost: Vec<String>,
    broken: Vec<String>,
    tilt: f64,
    floor: bool,
    /// Whether the capture has a split of its own.
    is_divided: bool,
}

/// Prepares a data set; returns none when interrupted, after which `resume` continues. `note` receives progress messages.
///
/// # Errors
/// When the input is invalid, a program is missing, or too few photographs get a pose.
pub fn prepare(o: &PrepareOptions, interrupt: &AtomicBool, note: &mut dyn FnMut(&str)) -> Result<Option<Prepared>> {
    // Report missing programs before any work is done.
    let colmap_program = (o.sfm == Sfm::Colmap).then(sfm::program).transpose()?;
    if !o.input.exists() {
        return Err(DataError::input(&o.input, "does not exist; give a folder of photographs or a video").into());
    }
    let given = if o.sfm == Sfm::None { Some(posed::read(o)?) } else { None };
    let _lock = begin(o)?;
    let posed = match (colmap_program, given) {
        (Some(program), _) => pose(&program, o, interrupt, note)?,
        (None, Some(capture)) => posed::take(capture, o, interrupt, note)?,
        (None, None) => unreachable!("poses come from COLMAP or are given"),
    };
    match posed {
        Some(posed) => complete(posed, o, interrupt, note),
        None => Ok(None),
    }
}

/// Finds poses with COLMAP; returns none when interrupted.
fn pose(program: &Path, o: &PrepareOptions, interrupt: &AtomicBool, note: &mut dyn FnMut(&str)) -> Result<Option<Posed>> {
    let work = o.out.join(WORK);
    if !work.join(IMAGES_DONE).exists() && !take_images(o, &work, interrupt, note)? {
        return Ok(None);
    }
    let broken = left_out(&work.join(BROKEN))?;
    let images = photo_import::list(&o.out.join(IMAGES))?;
    let names: Vec<String> = images.iter().map(|p| p.file_name().unwrap_or_default().to_string_lossy().into_owned()).collect();
    let is_video = !o.input.is_dir();
    let one_size = one_size(&images)?;
    if !one_size {
        note("photographs differ in size: a lens is found for each; those of one size and zoom are found more reliably");
    }
    let kind = sfm::Photographs { names: &names, is_video, one_size, focal_ratio: read_focal_ratio(&work) };
    let Some(model) = sfm::reconstruct(program, o, &kind, interrupt, note)? else { return Ok(None) };
    let registered: HashSet<String> = colmap::registered(&model)?.into_iter().collect();
    let lost: Vec<String> = names.iter().filter(|n| !registered.contains(*n)).cloned().collect();
    enough(o, &names, &lost)?;
    note("turning the world upright");
    let points = colmap::points(&model)?;
    let read = colmap::read(&o.out)?;
    let mut frames = read.frames;
    let placed = world::place(&mut frames, &points);
    let observed = if o.finish.touches_pixels() { colmap::observations(&model)? } else { Vec::new() };
    let found = finish::Found {
        observed: observed.into_iter().map(|v| (v.image.clone(), v)).collect(),
        points: points.iter().zip(&placed.points).map(|(p, at)| (p.id, at.0, p.images)).collect(),
        is_visibility_known: true,
    };
    Ok(Some(Posed {
        frames,
        scene: placed.scene,
        masks: MaskRule::default(),
        finishing_from_world: diorama_geom::Similarity::IDENTITY,
        found,
        points: read.points.into_iter().zip(placed.points).map(|(p, (position, _))| SparsePoint { position, ..p }).collect(),
        images: names.len(),
        lost,
        broken,
        tilt: placed.tilt,
        floor: placed.floor,
        is_divided: false,
    }))
}

/// Post-processes photographs and writes the data set; returns none when interrupted.
fn complete(mut p: Posed, o: &PrepareOptions, interrupt: &AtomicBool, note: &mut dyn FnMut(&str)) -> Result<Option<Prepared>> {
    let registered = p.frames.len();
    let to_world = p.finishing_from_world.inverse();
    let before: Vec<String> = p.frames.iter().map(|f| f.name.clone()).collect();
    p.frames.iter_mut().for_each(|f| f.world_from_camera = p.finishing_from_world.pose(&f.world_from_camera));
    let made = finish::finish(&o.finish, &o.out, &p.found, &mut p.frames, interrupt, note).inspect_err(|_| finish::discard(&o.out))?;
    let Some(finished) = made else {
        finish::discard(&o.out);
        return Ok(None);
    };
    p.frames.iter_mut().for_each(|f| f.world_from_camera = to_world.pose(&f.world_from_camera));
    if !(p.is_divided && o.split == SplitRule::File) {
        split::apply(&o.split, &mut p.frames, false, o.seed);
    }
    if p.frames.iter().filter(|f| f.split == Split::Train).count() < 2 {
        return Err(PipelineError::Usage(format!("--split {}: leaves fewer than 2 training views; choose another", o.split)));
    }
    let capture = Capture { masks: p.masks, ..Capture::new(p.frames, p.scene) };
    finish::put_in_place(&o.out)?;
    p.points.retain(|p| p.position.as_vec3().is_finite());
    let has_points = !p.points.is_empty();
    if has_points {
        // Finishing may have dropped photographs: renumber the frames of the points.
        let now: HashMap<&str, u32> = capture.frames.iter().enumerate().map(|(i, f)| (&f.name[..], i as u32)).collect();
        p.points.iter_mut().for_each(|p| p.frames = p.frames.iter().filter_map(|f| now.get(&before[*f as usize][..]).copied()).collect());
        sparse_ply::write(&o.out.join(POINTS), &p.points, &capture.frames, &o.out)?;
    }
    transforms_json::write(&o.out.join("transforms.json"), &o.out, &capture, has_points.then_some(POINTS))?;
    let sheet = o.out.join("sheet.png");
    sheet::draw(&sheet, &capture, &p.points)?;
    // Check that the written data set can be read.
    let options = import::ImportOptions { format: Some(import::Format::Transforms), ..Default::default() };
    import::import(&o.out, &options)?;
    Ok(Some(Prepared {
        folder: o.out.clone(),
        images: p.images,
        registered,
        lost: p.lost,
        broken: p.broken,
        points: p.points.len(),
        tilt: p.tilt,
        floor: p.floor,
        aabb_scale: p.scene.aabb_scale,
        held_out: capture.indices(Split::Test).len(),
        sheet,
        finished,
    }))
}

/// Creates or clears the output folder and locks it; fails if the folder holds anything but an earlier data set.
fn begin(o: &PrepareOptions) -> Result<std::fs::File> {
    let work = o.out.join(if o.sfm == Sfm::Colmap { WORK } else { POSED });
    let existed = o.out.is_dir();
    if o.resume && !existed {
        return Err(DataError::input(&o.out, "does not exist; leave out --resume").into());
    }
    if o.out.is_file() {
        return Err(DataError::input(&o.out, "is a file; --out must name a folder").into());
    }
    // Never touch a folder that is not an earlier data set.
    let names = |p: &Path| -> Result<Vec<std::ffi::OsString>> {
        Ok(std::fs::read_dir(p).map_err(DataError::io(p, "read"))?.flatten().map(|e| e.file_name()).filter(|n| n != lock::NAME).collect())
    };
    let ours = [WORK, POSED].iter().any(|w| o.out.join(w).is_dir());
    let occupied = existed && !names(&o.out)?.is_empty();
    if occupied && !ours {
        return Err(DataError::input(&o.out, "exists and is not an earlier data set of prepare; choose another --out").into());
    }
    std::fs::create_dir_all(&o.out).map_err(DataError::io(&o.out, "create"))?;
    let lock = lock::take(&o.out)?;
    if o.resume {
        return if work.is_dir() {
            Ok(lock)
        } else {
            Err(DataError::input(&o.out, "holds nothing to go on from; leave out --resume").into())
        };
    }
    if occupied {
        if !o.force {
            return Err(DataError::input(&o.out, "exists; give --resume to go on, --force to begin anew, or another --out").into());
        }
        for part in [IMAGES, MASKS, WORK, POSED, "sparse", finish::FINISHED] {
            let folder = o.out.join(part);
            if folder.exists() {
                std::fs::remove_dir_all(&folder).map_err(DataError::io(&folder, "remove"))?;
            }
        }
        for part in ["transforms.json", POINTS] {
            let file = o.out.join(part);
            if file.exists() {
                std::fs::remove_file(&file).map_err(DataError::io(&file, "remove"))?;
            }
        }
    }
    for folder in [o.out.join(IMAGES), work] {
        std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
    }
    Ok(lock)
}

/// Whether all photographs have the same size.
fn one_size(images: &[PathBuf]) -> Result<bool> {
    let first = photo::size(&images[0])?;
    for i in images {
        if photo::size(i)? != first {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Focal ratio that [`take_images`] has stored, if any.
fn read_focal_ratio(work: &Path) -> Option<f64> {
    std::fs::read_to_string(work.join(IMAGES_DONE)).ok()?.trim().parse().ok()
}

/// Median focal length over the longer side; none unless 90 % of the photographs agree with it within 2 %.
fn common_focal_ratio(all: &[PathBuf]) -> Option<f64> {
    let mut found: Vec<f64> = all.iter().filter_map(|p| photo_import::focal_ratio(p)).collect();
    found.sort_by(f64::total_cmp);
    let middle = *found.get(found.len() / 2)?;
    let agree = found.iter().filter(|f| (*f / middle - 1.0).abs() < 0.02).count();
    (agree * 10 >= all.len() * 9).then_some(middle)
}

/// Names of the photographs that were left out; empty if there is no list.
fn left_out(file: &Path) -> Result<Vec<String>> {
    match std::fs::read_to_string(file) {
        Ok(names) => Ok(names.lines().map(String::from).collect()),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(Vec::new()),
        Err(e) => Err(DataError::io(file, "read")(e).into()),
    }
}

/// Fills the image folder; returns false when interrupted.
fn take_images(o: &PrepareOptions, work: &Path, interrupt: &AtomicBool, note: &mut dyn FnMut(&str)) -> Result<bool> {
    let folder = o.out.join(IMAGES);
    // What an interrupted or refused call has left may be another choice.
    if folder.exists() {
        std::fs::remove_dir_all(&folder).map_err(DataError::io(&folder, "remove"))?;
    }
    std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
    let mut focal_ratio = None;
    let mut broken = Vec::new();
    if o.input.is_dir() {
        let all = photo_import::list(&o.input).map_err(|e| match import::detect(&o.input) {
            Ok(_) => DataError::input(&o.input, "has poses already: train on it as it is, or finish its photographs with --sfm none"),
            Err(_) => e,
        })?;
        let all: Vec<PathBuf> = all.into_iter().step_by(o.every).collect();
        let Some(all) = frames::of_folder(all, o, interrupt, note)? else { return Ok(false) };
        focal_ratio = common_focal_ratio(&all);
        let stems = stems(&all);
        for (i, (source, stem)) in all.iter().zip(&stems).enumerate() {
            if interrupt.load(Ordering::Relaxed) {
                return Ok(false);
            }
            match photo_import::import(source, &folder, stem, o.max_side) {
                Ok(taken) => see(&taken, work)?,
                Err(e) if o.skip_broken && e.is_input() => {
                    note(&format!("left out: {e}"));
                    broken.push(source.file_name().unwrap_or_default().to_string_lossy().into_owned());
                }
                Err(e) => return Err(e.into()),
            }
            note(&format!("photographs: {} of {}", i + 1, all.len()));
        }
    } else {
        note("choosing sharp frames of the video");
        let Some(made) = video::extract(&video::ffmpeg()?, &o.input, &folder, o.choice, &work.join("ffmpeg.log"), interrupt)? else {
            return Ok(false);
        };
        note(&format!("frames: {} of {} taken", made.taken, made.frames));
        if let Some(fault) = made.fault {
            note(&format!("the video can be decoded up to frame {} only, the rest is missing: {fault}", made.frames));
        }
        if o.max_side < u32::MAX {
            for file in photo_import::list(&folder)? {
                let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
                photo_import::import(&file, &folder, &stem, o.max_side)?;
            }
        }
    }
    o.wanted.check(&o.input, photo_import::list(&folder)?.len(), note)?;
    atomic::write(&work.join(BROKEN), broken.join("\n").as_bytes())?;
    let kept = focal_ratio.map(|f| f.to_string()).unwrap_or_default();
    atomic::write(&work.join(IMAGES_DONE), kept.as_bytes())?;
    Ok(true)
}

/// Unique file stems, one per file.
pub fn stems(files: &[PathBuf]) -> Vec<String> {
    let mut taken = HashSet::new();
    let stem = |(i, f): (usize, &PathBuf)| {
        let own = f.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let stem = if taken.contains(&own) { format!("{own}_{i}") } else { own };
        taken.insert(stem.clone());
        stem
    };
    files.iter().enumerate().map(stem).collect()
}

/// Saves an 8-bit version of a linear-light photograph for COLMAP.
fn see(taken: &Path, work: &Path) -> Result<()> {
    if photo::header(taken)?.depth == photo::Depth::Linear {
        let folder = work.join(SEEN);
        std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
        photo::save_png(&folder.join(taken.file_name().unwrap_or_default()), &photo::load(taken)?)?;
    }
    Ok(())
}

fn enough(o: &PrepareOptions, names: &[String], lost: &[String]) -> Result<()> {
    let found = names.len() - lost.len();
    let share = 100.0 * found as f64 / names.len() as f64;
    if found >= 3 && share >= o.min_registered {
        return Ok(());
    }
    let shown = lost.iter().take(8).cloned().collect::<Vec<_>>().join(", ");
    let more = if lost.len() > 8 { format!(" and {} more", lost.len() - 8) } else { String::new() };
    Err(DataError::failed(
        &o.out,
        format!(
            "COLMAP found poses for {found} of {} photographs ({share:.0} %, at least {:.0} % are wanted); without: {shown}{more}; \
             take more photographs with more overlap and texture, or accept this with --resume --min-registered {:.0}",
            names.len(),
            o.min_registered,
            share.floor()
        ),
    )
    .into())
}
