//! Photographs or a video without poses become a data set: sharp frames, poses from COLMAP, the world upright and of useful size,
//! photographs finished as wished, a division into training and held-out views, and a sheet that shows it all.

pub mod finish;
mod sfm;
mod sheet;
mod world;

use crate::error::{PipelineError, Result};
use diorama_data::split::{self, SplitRule};
use diorama_data::video::{self, Choice};
use diorama_data::{DataError, atomic, colmap, import, mesh_text, photo, photo_import, transforms_json};
use diorama_geom::capture::Split;
use diorama_geom::{Capture, Mesh};
use serde::Serialize;
use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

pub use finish::Finish;
pub use sfm::Matcher;

/// What to make a data set of, and how.
#[derive(Clone, Debug)]
pub struct PrepareOptions {
    /// A folder of photographs, or a video.
    pub input: PathBuf,
    pub out: PathBuf,
    /// Most frames of a video.
    pub choice: Choice,
    /// Take every n-th photograph.
    pub every: usize,
    /// Longest side; larger photographs are reduced.
    pub max_side: u32,
    pub matcher: Matcher,
    /// Most features per photograph.
    pub features: usize,
    /// COLMAP's name of the lens.
    pub lens: String,
    pub finish: Finish,
    pub split: SplitRule,
    pub seed: u64,
    /// Fewest photographs that need a pose, in percent.
    pub min_registered: f64,
    pub threads: Option<usize>,
    /// Go on from what an earlier call left.
    pub resume: bool,
    pub force: bool,
    /// Leave out photographs that cannot be decoded.
    pub skip_broken: bool,
}

/// What was made.
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
    /// Whether a floor was found, which then lies at the height of the lowest dense plane.
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
const POINTS: &str = "points.ply";
const IMAGES_DONE: &str = "images.done";
/// Within [`WORK`]: photographs of linear light as COLMAP can read them, PNGs of 8 bits under the same names.
const SEEN: &str = "seen";
/// Within [`WORK`]: names of the broken photographs that were left out, a line each.
const BROKEN: &str = "images.broken";

/// Prepares a data set; none when interrupted, after which `resume` goes on. `note` is told what happens.
///
/// # Errors
/// When the input is at fault, a program is missing, or too few photographs find a pose.
pub fn prepare(o: &PrepareOptions, interrupt: &AtomicBool, note: &mut dyn FnMut(&str)) -> Result<Option<Prepared>> {
    // Missing programs are told before any work is done.
    let colmap_program = sfm::program()?;
    let work = o.out.join(WORK);
    begin(o)?;
    if !work.join(IMAGES_DONE).exists() && !take_images(o, &work, interrupt, note)? {
        return Ok(None);
    }
    let images = photo_import::list(&o.out.join(IMAGES))?;
    if images.len() < 3 {
        return Err(DataError::input(
            &o.input,
            format!("{} photographs are not enough; at least 3 are needed, 30 to 150 are usual", images.len()),
        )
        .into());
    }
    let names: Vec<String> = images.iter().map(|p| p.file_name().unwrap_or_default().to_string_lossy().into_owned()).collect();
    let is_video = !o.input.is_dir();
    let one_size = one_size(&images)?;
    if !one_size {
        note("photographs differ in size: a lens is found for each; those of one size and zoom are found more reliably");
    }
    let kind = sfm::Photographs { names: &names, is_video, one_size, focal_ratio: read_focal_ratio(&work) };
    let Some(model) = sfm::reconstruct(&colmap_program, o, &kind, interrupt, note)? else { return Ok(None) };
    let registered: HashSet<String> = colmap::registered(&model)?.into_iter().collect();
    let lost: Vec<String> = names.iter().filter(|n| !registered.contains(*n)).cloned().collect();
    enough(o, &names, &lost)?;
    note("turning the world upright");
    let points = colmap::points(&model)?;
    let mut frames = colmap::read(&o.out)?.frames;
    let placed = world::place(&mut frames, &points);
    let in_world = points.iter().copied().zip(placed.points.iter().map(|p| p.0)).collect();
    let found = finish::Found { model: &model, points: in_world };
    let made = finish::finish(&o.finish, &o.out, &found, &mut frames, interrupt, note).inspect_err(|_| finish::discard(&o.out))?;
    let Some(finished) = made else {
        finish::discard(&o.out);
        return Ok(None);
    };
    split::apply(&o.split, &mut frames, false, o.seed);
    if frames.iter().filter(|f| f.split == Split::Train).count() < 2 {
        return Err(PipelineError::Usage(format!("--split {}: leaves fewer than 2 training views; choose another", o.split)));
    }
    let world_from_capture = diorama_geom::Similarity::IDENTITY;
    let capture = Capture { frames, world_from_capture, scene: placed.scene, notes: Vec::new() };
    finish::put_in_place(&o.out)?;
    let cloud = Mesh {
        positions: placed.points.iter().map(|p| p.0.as_vec3().to_array()).collect(),
        colors_srgb: placed.points.iter().map(|p| p.1.map(|v| v as f32 / 255.0)).collect(),
        ..Mesh::default()
    };
    mesh_text::save_ply(&o.out.join(POINTS), &cloud)?;
    transforms_json::write(&o.out.join("transforms.json"), &o.out, &capture, Some(POINTS))?;
    let sheet = o.out.join("sheet.png");
    sheet::draw(&sheet, &capture, &placed.points)?;
    // What was written reads back as a capture.
    let options = import::ImportOptions { format: Some(import::Format::Transforms), ..Default::default() };
    import::import(&o.out, &options)?;
    Ok(Some(Prepared {
        folder: o.out.clone(),
        images: names.len(),
        registered: registered.len(),
        lost,
        broken: std::fs::read_to_string(work.join(BROKEN)).unwrap_or_default().lines().map(String::from).collect(),
        points: points.len(),
        tilt: placed.tilt,
        floor: placed.floor,
        aabb_scale: placed.scene.aabb_scale,
        held_out: capture.indices(Split::Test).len(),
        sheet,
        finished,
    }))
}

/// Makes the folder ready, or refuses.
fn begin(o: &PrepareOptions) -> Result<()> {
    if !o.input.exists() {
        return Err(DataError::input(&o.input, "does not exist; give a folder of photographs or a video").into());
    }
    if o.resume {
        return if o.out.join(WORK).is_dir() {
            Ok(())
        } else {
            Err(DataError::input(&o.out, "holds nothing to go on from; leave out --resume").into())
        };
    }
    if o.out.exists() && std::fs::read_dir(&o.out).map_err(DataError::io(&o.out, "read"))?.next().is_some() {
        let ours = o.out.join(WORK).is_dir();
        if !ours {
            return Err(DataError::input(&o.out, "exists and is not an earlier data set of prepare; choose another --out").into());
        }
        if !o.force {
            return Err(DataError::input(&o.out, "exists; give --resume to go on, --force to begin anew, or another --out").into());
        }
        for part in [IMAGES, WORK, "sparse", finish::FINISHED] {
            let folder = o.out.join(part);
            if folder.exists() {
                std::fs::remove_dir_all(&folder).map_err(DataError::io(&folder, "remove"))?;
            }
        }
        let _ = std::fs::remove_file(o.out.join("transforms.json"));
    }
    for folder in [o.out.join(IMAGES), o.out.join(WORK)] {
        std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
    }
    Ok(())
}

/// Whether all photographs have as many pixels.
fn one_size(images: &[PathBuf]) -> Result<bool> {
    let first = photo::size(&images[0])?;
    for i in images {
        if photo::size(i)? != first {
            return Ok(false);
        }
    }
    Ok(true)
}

/// What [`take_images`] has kept of the photographs' metadata.
fn read_focal_ratio(work: &Path) -> Option<f64> {
    std::fs::read_to_string(work.join(IMAGES_DONE)).ok()?.trim().parse().ok()
}

/// The focal length that photographs agree on, over the longer side.
fn common_focal_ratio(all: &[PathBuf]) -> Option<f64> {
    let mut found: Vec<f64> = all.iter().filter_map(|p| photo_import::focal_ratio(p)).collect();
    found.sort_by(f64::total_cmp);
    let middle = *found.get(found.len() / 2)?;
    let agree = found.iter().filter(|f| (*f / middle - 1.0).abs() < 0.02).count();
    (agree * 10 >= all.len() * 9).then_some(middle)
}

/// Fills the folder of images; false when interrupted.
fn take_images(o: &PrepareOptions, work: &Path, interrupt: &AtomicBool, note: &mut dyn FnMut(&str)) -> Result<bool> {
    let folder = o.out.join(IMAGES);
    let mut focal_ratio = None;
    let mut broken = Vec::new();
    if o.input.is_dir() {
        let all: Vec<PathBuf> = photo_import::list(&o.input)?.into_iter().step_by(o.every).collect();
        focal_ratio = common_focal_ratio(&all);
        let mut stems = HashSet::new();
        for (i, source) in all.iter().enumerate() {
            if interrupt.load(Ordering::Relaxed) {
                return Ok(false);
            }
            let own = source.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let stem = if stems.contains(&own) { format!("{own}_{i}") } else { own };
            stems.insert(stem.clone());
            match photo_import::import(source, &folder, &stem, o.max_side) {
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
        let Some((all, taken)) = video::extract(&o.input, &folder, o.choice, &work.join("ffmpeg.log"), interrupt)? else {
            return Ok(false);
        };
        note(&format!("frames: {taken} of {all} taken"));
        if o.max_side < u32::MAX {
            for file in photo_import::list(&folder)? {
                let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
                photo_import::import(&file, &folder, &stem, o.max_side)?;
            }
        }
    }
    atomic::write(&work.join(BROKEN), broken.join("\n").as_bytes())?;
    let kept = focal_ratio.map(|f| f.to_string()).unwrap_or_default();
    atomic::write(&work.join(IMAGES_DONE), kept.as_bytes())?;
    Ok(true)
}

/// Makes a picture that COLMAP can read of a photograph of linear light.
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
