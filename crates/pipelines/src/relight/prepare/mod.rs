//! A data set for the scene model from photographs of a place in several lights: poses, sessions, masks of what moved, photographs of pinhole
//! cameras, and a world whose cameras lie in the unit sphere.

mod masks;
mod sky;
mod world;

use crate::error::{PipelineError, Result};
use crate::run::prepare::{self as poses, Finish, Matcher, Sfm};
use crate::run::undistort;
use diorama_data::import::{self, ImportOptions};
use diorama_data::masks::{MaskOptions, SKY_CLASS, STATIC_CLASS};
use diorama_data::sessions::{self, SessionRule};
use diorama_data::split::{self, SplitRule};
use diorama_data::video::Choice;
use diorama_data::{DataError, atomic, lock, nerf_osr, photo, photo_import, sparse_ply, transforms_json};
use diorama_geom::capture::{Frame, MaskMeaning, MaskRule, Split};
use diorama_geom::glam::{DVec2, DVec3};
use diorama_geom::{Capture, ImageU8, Lens, SparsePoint};
use serde::Serialize;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Names within the data set.
const IMAGES: &str = "images";
const MASKS: &str = "masks";
const POINTS: &str = "points.ply";
/// Poses as COLMAP found them, and photographs of subfolders gathered for it.
const POSES: &str = "poses";
const GATHERED: &str = "photographs";
/// Height of a ray of length 1 from which on it may show sky: up is known to a few degrees.
const BELOW_HORIZON: f64 = -0.1;
/// Marks the folder as a data set of this command.
const MARK: &str = ".relight_prepare";

/// Input, output and settings of [`prepare`].
#[derive(Clone, Debug)]
pub struct PrepareOptions {
    /// A folder of photographs; with [`Sfm::None`] a capture that has poses, also in NeRF-OSR's layout.
    pub input: PathBuf,
    pub out: PathBuf,
    pub sfm: Sfm,
    /// Folder with a mask for each photograph: 255 is static, 192 static glass, 160 sky, 0 what moved.
    pub masks: Option<PathBuf>,
    /// Looks for the sky in each photograph and marks it in its mask.
    pub sky: bool,
    /// None: as the capture says, else by names.
    pub sessions: Option<SessionRule>,
    /// Longest side in pixels; larger photographs are downsampled.
    pub max_side: u32,
    pub matcher: Matcher,
    /// COLMAP's name of the camera model.
    pub lens: String,
    /// Most features per photograph.
    pub features: usize,
    /// Least share of the photographs that must get a pose, in percent.
    pub min_registered: f64,
    pub split: SplitRule,
    pub seed: u64,
    /// Up direction in the coordinates of the poses; none: that of level cameras.
    pub up: Option<DVec3>,
    /// Moves and scales given poses so that the cameras lie in the unit sphere; poses of COLMAP always are.
    pub rescale: bool,
    pub threads: Option<usize>,
    pub skip_broken: bool,
    pub resume: bool,
    pub force: bool,
}

/// Result of [`prepare`].
#[derive(Clone, Debug, Serialize)]
pub struct Prepared {
    pub folder: PathBuf,
    pub photographs: usize,
    /// Photographs without a pose.
    pub lost: Vec<String>,
    pub sessions: usize,
    /// Mean share of the photographs that masks leave; none without masks.
    pub static_share: Option<f64>,
    /// Mean share of the photographs that is glass, a part of the former.
    pub glass_share: Option<f64>,
    /// Mean share of the photographs in which sky was found or marked, and the number of photographs without any.
    pub sky_share: Option<f64>,
    pub without_sky: usize,
    pub undistorted: usize,
    pub held_out: usize,
    pub points: usize,
    /// What the user should know, one line each.
    pub notes: Vec<String>,
}

/// Photographs with poses, sessions and masks, as they are in the input.
struct Source {
    frames: Vec<Frame>,
    points: Vec<SparsePoint>,
    /// Whether masks in the frames are NeRF-OSR's or those of `--masks`: 255 static.
    rule: MaskRule,
    /// Shares of each such mask.
    shares: Vec<Shares>,
    lost: Vec<String>,
    has_own_split: bool,
    rescale: bool,
    notes: Vec<String>,
}

/// Prepares a data set; returns none when interrupted, after which `resume` continues. `note` receives progress messages.
///
/// # Errors
/// When the input is invalid, COLMAP is missing or fails, a camera is outside of the unit sphere, or masks do not fit.
pub fn prepare(o: &PrepareOptions, interrupt: &AtomicBool, note: &mut dyn FnMut(&str)) -> Result<Option<Prepared>> {
    if !o.input.exists() {
        return Err(DataError::input(&o.input, "does not exist; give a folder of photographs").into());
    }
    // What can be wrong with the input is known before anything is written.
    let (given, photographs) = match o.sfm {
        Sfm::None => (Some(given(o)?), None),
        Sfm::Colmap => (None, Some(photographs(o)?)),
    };
    let _lock = begin(o)?;
    let source = match photographs {
        Some(photographs) => posed(photographs, o, interrupt, note)?,
        None => given,
    };
    match source {
        Some(source) => complete(source, o, interrupt, note),
        None => Ok(None),
    }
}

/// A capture that has poses.
fn given(o: &PrepareOptions) -> Result<Source> {
    let is_osr = nerf_osr::is_layout(&o.input);
    let (mut frames, points, rule, notes) = if is_osr {
        (nerf_osr::read(&o.input)?, Vec::new(), MaskRule { meaning: MaskMeaning::Unknown, inverted: false }, Vec::new())
    } else {
        let options = ImportOptions { skip_broken: o.skip_broken, seed: o.seed, ..ImportOptions::default() };
        let c = import::import(&o.input, &options)?;
        (c.frames, c.points, c.masks, c.notes)
    };
    let images: Vec<PathBuf> = frames.iter().map(|f| f.image.clone()).collect();
    if o.sessions.is_some() || frames.iter().any(|f| f.session.is_none()) {
        let found = sessions::assign(o.sessions.as_ref().unwrap_or(&SessionRule::Names), &images)?;
        frames.iter_mut().zip(found).for_each(|(f, s)| f.session = Some(s));
    }
    let mut rule = rule;
    if let Some(folder) = &o.masks {
        rule = MaskRule { meaning: MaskMeaning::Unknown, inverted: false };
        frames.iter_mut().zip(masks::files(folder, &images)?).for_each(|(f, file)| f.mask = Some(file));
    }
    let with = frames.iter().filter_map(|f| f.mask.clone().map(|m| (m, f.image.clone())));
    // Whatever masks cut out elsewhere, here they keep the place and leave out what moved.
    let shares = if rule.inverted { Vec::new() } else { shares(with)? };
    if let (Some((frame, radius)), false) = (world::outside(&frames), o.rescale) {
        let what = format!("its camera is {radius:.2} from the origin, outside of the unit sphere; give --rescale");
        return Err(DataError::input(&frame.image, what).into());
    }
    Ok(Source { frames, points, rule, shares, lost: Vec::new(), has_own_split: true, rescale: o.rescale, notes })
}

/// Photographs without poses, with their sessions and masks.
struct Photographs {
    files: Vec<PathBuf>,
    sessions: Vec<u32>,
    masks: Option<Vec<PathBuf>>,
    shares: Vec<Shares>,
    /// Whether they lie in subfolders.
    in_folders: bool,
}

/// The photographs of a folder, or of its subfolders.
fn photographs(o: &PrepareOptions) -> Result<Photographs> {
    let rule = o.sessions.clone().unwrap_or(SessionRule::Names);
    let in_folders = rule == SessionRule::Folders;
    let files = if in_folders { of_subfolders(&o.input)? } else { photo_import::list(&o.input)? };
    let sessions = sessions::assign(&rule, &files)?;
    let masks = o.masks.as_ref().map(|folder| masks::files(folder, &files)).transpose()?;
    let with = masks.iter().flatten().cloned().zip(files.iter().cloned());
    let shares = shares(with)?;
    Ok(Photographs { files, sessions, masks, shares, in_folders })
}

fn of_subfolders(input: &Path) -> Result<Vec<PathBuf>> {
    let entries = input.read_dir().map_err(DataError::io(input, "read"))?;
    let mut folders: Vec<PathBuf> = entries.flatten().map(|e| e.path()).filter(|p| p.is_dir()).collect();
    folders.sort();
    if folders.is_empty() {
        return Err(DataError::input(input, "has no subfolders; --sessions folders needs one per session").into());
    }
    let mut files = Vec::new();
    for folder in folders {
        files.extend(photo_import::list(&folder)?);
    }
    Ok(files)
}

/// Copies of photographs in subfolders in one folder, named after their folders; the copies in the photographs' order.
fn gather(files: &[PathBuf], target: &Path) -> Result<Vec<PathBuf>> {
    std::fs::create_dir_all(target).map_err(DataError::io(target, "create"))?;
    let copy = |p: &PathBuf| {
        let folder = p.parent().and_then(Path::file_name).unwrap_or_default().to_string_lossy().into_owned();
        target.join(format!("{folder}_{}", p.file_name().unwrap_or_default().to_string_lossy()))
    };
    let copies: Vec<PathBuf> = files.iter().map(copy).collect();
    for (from, to) in files.iter().zip(&copies) {
        if !to.exists() {
            // Another file system has no links to this one.
            std::fs::hard_link(from, to).or_else(|_| std::fs::copy(from, to).map(|_| ())).map_err(DataError::io(to, "write"))?;
        }
    }
    Ok(copies)
}

/// Poses of photographs by COLMAP; none when interrupted.
fn posed(p: Photographs, o: &PrepareOptions, interrupt: &AtomicBool, note: &mut dyn FnMut(&str)) -> Result<Option<Source>> {
    let gathered = o.out.join(GATHERED);
    let (input, read) = if p.in_folders { (gathered.clone(), gather(&p.files, &gathered)?) } else { (o.input.clone(), p.files.clone()) };
    let work = o.out.join(POSES);
    if !work.join("transforms.json").is_file() {
        let options = poses::PrepareOptions {
            input,
            out: work.clone(),
            sfm: Sfm::Colmap,
            format: None,
            masks: MaskOptions::default(),
            choice: Choice::Count(1),
            wanted: poses::Wanted::ANY,
            every: 1,
            max_side: o.max_side,
            matcher: o.matcher,
            features: o.features,
            lens: o.lens.clone(),
            finish: Finish::default(),
            split: SplitRule::All,
            seed: o.seed,
            min_registered: o.min_registered,
            threads: o.threads,
            resume: work.join("colmap").is_dir(),
            force: false,
            skip_broken: o.skip_broken,
        };
        if poses::prepare(&options, interrupt, note)?.is_none() {
            return Ok(None);
        }
    }
    let capture = import::import(&work, &ImportOptions { format: Some(import::Format::Transforms), ..ImportOptions::default() })?;
    let stems = poses::stems(&read);
    let number: HashMap<&str, usize> = stems.iter().enumerate().map(|(i, s)| (&s[..], i)).collect();
    let mut frames = capture.frames;
    let mut has_pose = vec![false; p.files.len()];
    for f in &mut frames {
        let stem = f.image.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let i = *number.get(&stem[..]).ok_or_else(|| DataError::input(&f.image, "belongs to no photograph; begin anew with --force"))?;
        has_pose[i] = true;
        f.session = Some(p.sessions[i]);
        f.mask = p.masks.as_ref().map(|m| m[i].clone());
    }
    let lost = p.files.iter().zip(&has_pose).filter(|(_, has)| !**has);
    let lost = lost.map(|(p, _)| p.file_name().unwrap_or_default().to_string_lossy().into_owned()).collect();
    let rule = MaskRule { meaning: MaskMeaning::Unknown, inverted: false };
    let (points, shares) = (capture.points, p.shares);
    Ok(Some(Source { frames, points, rule, shares, lost, has_own_split: false, rescale: true, notes: Vec::new() }))
}

/// Writes photographs, masks and the description; none when interrupted.
fn complete(mut s: Source, o: &PrepareOptions, interrupt: &AtomicBool, note: &mut dyn FnMut(&str)) -> Result<Option<Prepared>> {
    let shares = std::mem::take(&mut s.shares);
    let mean = |of: fn(&Shares) -> f64| (!shares.is_empty()).then(|| shares.iter().map(of).sum::<f64>() / shares.len() as f64);
    let up = o.up.unwrap_or_else(|| world::up(&s.frames));
    world::place(&mut s.frames, &mut s.points, up, s.rescale);
    if !(s.has_own_split && o.split == SplitRule::File) {
        split::apply(&o.split, &mut s.frames, false, o.seed);
    }
    if s.frames.iter().filter(|f| f.split == Split::Train).count() < 2 {
        return Err(PipelineError::Usage(format!("--split {}: leaves fewer than 2 training views; choose another", o.split)));
    }
    let images: Vec<PathBuf> = s.frames.iter().map(|f| f.image.clone()).collect();
    let (stems, mut undistorted, mut skies) = (poses::stems(&images), 0, Vec::new());
    let has_classes = s.rule.meaning != MaskMeaning::Object;
    for (i, (frame, stem)) in s.frames.iter_mut().zip(&stems).enumerate() {
        if interrupt.load(Ordering::Relaxed) {
            return Ok(None);
        }
        undistorted += write_frame(frame, &s.rule, stem, o)? as usize;
        if has_classes && o.sky {
            skies.push(mark_sky(frame, i, &s.points, &o.out.join(MASKS).join(format!("{stem}.png")))?);
        }
        note(&format!("undistorting: {} of {}", i + 1, stems.len()));
    }
    let without_sky = skies.iter().filter(|share| **share == 0.0).count();
    let scene = world::scene(&s.frames, &s.points);
    let meaning = if has_classes { MaskMeaning::Classes } else { s.rule.meaning };
    let capture = Capture { masks: MaskRule { meaning, inverted: false }, ..Capture::new(s.frames, scene) };
    if !s.points.is_empty() {
        sparse_ply::write(&o.out.join(POINTS), &s.points, &capture.frames, &o.out)?;
    }
    transforms_json::write(&o.out.join("transforms.json"), &o.out, &capture, (!s.points.is_empty()).then_some(POINTS))?;
    // The written data set must be readable.
    import::import(&o.out, &ImportOptions { format: Some(import::Format::Transforms), ..ImportOptions::default() })?;
    let sessions_of = |split: Option<Split>| -> usize {
        let of = capture.frames.iter().filter(|f| split.is_none_or(|s| f.split == s)).map(|f| f.session);
        of.collect::<std::collections::HashSet<_>>().len()
    };
    if sessions_of(Some(Split::Train)) == 1 {
        let cure = "photograph at other times of day, or name sessions with --sessions";
        s.notes.push(format!("all photographs to train on are of one session: albedo and light are ambiguous; {cure}"));
    }
    Ok(Some(Prepared {
        folder: o.out.clone(),
        photographs: capture.frames.len(),
        lost: s.lost,
        sessions: sessions_of(None),
        static_share: mean(|s| s.fixed),
        glass_share: mean(|s| s.glass),
        sky_share: (!skies.is_empty()).then(|| skies.iter().sum::<f64>() / skies.len() as f64),
        without_sky,
        undistorted,
        held_out: capture.indices(Split::Test).len(),
        points: s.points.len(),
        notes: s.notes,
    }))
}

/// Parts of a mask.
struct Shares {
    /// Static, glass included.
    fixed: f64,
    glass: f64,
}

/// Shares of each mask, given with its photograph.
fn shares(all: impl Iterator<Item = (PathBuf, PathBuf)>) -> Result<Vec<Shares>> {
    let of = |(file, image): (PathBuf, PathBuf)| -> Result<(PathBuf, Shares)> {
        let mask = masks::read(&file, &image)?;
        Ok((file, Shares { fixed: masks::static_share(&mask), glass: masks::glass_share(&mask) }))
    };
    let all = all.map(of).collect::<Result<Vec<_>>>()?;
    masks::check_together(&all.iter().map(|(file, s)| (file.clone(), s.fixed)).collect::<Vec<_>>())?;
    Ok(all.into_iter().map(|m| m.1).collect())
}

/// Writes a photograph of a pinhole camera and its mask, and points the frame to them; returns whether a lens was taken out.
fn write_frame(frame: &mut Frame, rule: &MaskRule, stem: &str, o: &PrepareOptions) -> Result<bool> {
    let images = o.out.join(IMAGES);
    let from = frame.camera;
    let to = if from.lens == Lens::Pinhole { None } else { undistort::pinhole(&from) };
    if to.is_none() && from.lens != Lens::Pinhole {
        let what = "its lens is too wide for a pinhole camera; leave the photograph out, or train on the capture as it is";
        return Err(DataError::input(&frame.image, what).into());
    }
    let mask = diorama_data::masks::of_frame(frame, rule, (from.width as usize, from.height as usize))?;
    let reduced = |im: ImageU8| {
        let by = (o.max_side as f64 / im.width.max(im.height) as f64).min(1.0);
        let side = |n: usize| ((n as f64 * by).round() as usize).max(1);
        im.downsampled(side(im.width), side(im.height))
    };
    let file = match &to {
        None => photo_import::import(&frame.image, &images, stem, o.max_side)?,
        Some(to) => {
            let flat = undistort::undistorted(&photo::load(&frame.image)?, &from, to);
            photo_import::write_like(&frame.image, &reduced(flat), &images, stem)?
        }
    };
    let (w, h) = photo::size(&file)?;
    if let Some(mask) = mask {
        let flat = to.as_ref().map_or(mask.clone(), |to| undistort::undistorted(&mask, &from, to));
        let path = o.out.join(MASKS).join(format!("{stem}.png"));
        photo::save_png(&path, &flat.downsampled(w as usize, h as usize))?;
        frame.mask = Some(path);
    }
    (frame.camera, frame.image) = (to.unwrap_or(from).resized(w, h), file);
    Ok(to.is_some())
}

/// Looks for the sky in the photograph of frame `i` and marks it in the frame's mask, which is written where there was none; returns its share
/// of the picture, what was marked before included.
fn mark_sky(frame: &mut Frame, i: usize, points: &[SparsePoint], file: &Path) -> Result<f64> {
    let photo = photo::load(&frame.image)?;
    let camera_from_world = frame.world_from_camera.inverse();
    let shows = |p: &&SparsePoint| p.frames.binary_search(&(i as u32)).is_ok();
    let seen = points.iter().filter(shows).filter_map(|p| frame.camera.project(camera_from_world.point(p.position)));
    let seen: Vec<DVec2> = seen.collect();
    let rises = |p: DVec2| (frame.world_from_camera.rotation * frame.camera.direction(p.x, p.y)).z > BELOW_HORIZON;
    let is_sky = sky::find(&photo, &sky::Known { points: &seen, rises: &rises });
    let mut mask = match &frame.mask {
        Some(file) => photo::load_mask(file)?,
        None => ImageU8 { width: photo.width, height: photo.height, channels: 1, data: vec![STATIC_CLASS; photo.width * photo.height] },
    };
    let marked = mask.data.iter_mut().zip(&is_sky).filter(|(v, s)| **s && **v == STATIC_CLASS);
    marked.for_each(|(v, _)| *v = SKY_CLASS);
    photo::save_png(file, &mask)?;
    frame.mask = Some(file.to_path_buf());
    Ok(mask.data.iter().filter(|v| diorama_data::masks::SKY.contains(v)).count() as f64 / mask.data.len() as f64)
}

/// Creates or clears the output folder and locks it; fails if the folder holds anything but an earlier data set.
fn begin(o: &PrepareOptions) -> Result<std::fs::File> {
    let is_ours = o.out.join(MARK).is_file();
    if o.out.is_file() {
        return Err(DataError::input(&o.out, "is a file; --out must name a folder").into());
    }
    if o.resume && !is_ours {
        return Err(DataError::input(&o.out, "holds nothing to go on from; leave out --resume").into());
    }
    let is_occupied = o.out.is_dir() && o.out.read_dir().map_err(DataError::io(&o.out, "read"))?.next().is_some();
    if is_occupied && !is_ours {
        return Err(DataError::input(&o.out, "exists and is not an earlier data set of relight prepare; choose another --out").into());
    }
    if is_occupied && !o.resume && !o.force {
        return Err(DataError::input(&o.out, "exists; give --resume to go on, --force to begin anew, or another --out").into());
    }
    std::fs::create_dir_all(&o.out).map_err(DataError::io(&o.out, "create"))?;
    let lock = lock::take(&o.out)?;
    if o.force {
        for part in [IMAGES, MASKS, POSES, GATHERED].map(|p| o.out.join(p)).into_iter().filter(|p| p.exists()) {
            std::fs::remove_dir_all(&part).map_err(DataError::io(&part, "remove"))?;
        }
        for part in ["transforms.json", POINTS].map(|p| o.out.join(p)).into_iter().filter(|p| p.exists()) {
            std::fs::remove_file(&part).map_err(DataError::io(&part, "remove"))?;
        }
    }
    for folder in [IMAGES, MASKS].map(|p| o.out.join(p)) {
        std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
    }
    atomic::write(&o.out.join(MARK), b"")?;
    Ok(lock)
}
