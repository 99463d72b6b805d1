//! Photographs with known poses: copies the photographs and masks, keeps the poses and the world.

use super::{IMAGES, IMAGES_DONE, MASKS, POSED, Posed, PrepareOptions, finish, stems, world};
use crate::error::{PipelineError, Result};
use diorama_data::colmap::Observed;
use diorama_data::import::{self, ImportOptions};
use diorama_data::split::{self, SplitRule};
use diorama_data::{DataError, atomic, photo, photo_check, photo_import};
use diorama_geom::capture::{Frame, focus_point};
use diorama_geom::glam::DVec3;
use diorama_geom::{Capture, ImageU8, Lens, Pose, Similarity, SparsePoint};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Assumed number of images per point where visibility is unknown: the least that makes a point reliable.
const UNTOLD: usize = 3;

/// Reads the posed capture.
///
/// # Errors
/// When it cannot be read, has a lens that `transforms.json` cannot express, or lacks data that the options need.
pub fn read(o: &PrepareOptions) -> Result<Capture> {
    let options = ImportOptions { format: o.format, seed: o.seed, masks: o.masks, skip_broken: o.skip_broken, ..ImportOptions::default() };
    let mut capture = import::import(&o.input, &options)?;
    if o.skip_broken {
        photo_check::leave_out_broken(&mut capture)?;
    }
    let has_words = |l: &Lens| match l {
        Lens::Pinhole | Lens::Equirectangular => true,
        Lens::Brown { k, .. } => k[3..] == [0.0; 3],
        Lens::Fisheye { p, s, .. } => *p == [0.0; 2] && *s == [0.0; 2],
        Lens::Fov { .. } => false,
    };
    if let Some(f) = capture.frames.iter().find(|f| !has_words(&f.camera.lens)) {
        let what = "its lens cannot be written to transforms.json; undistort the photographs with COLMAP (image_undistorter) first";
        return Err(DataError::input(&f.image, what).into());
    }
    let left = capture.frames.len().div_ceil(o.every);
    if left < 3 {
        return Err(DataError::input(&o.input, format!("--every {} leaves {left} photographs; at least 3 are needed", o.every)).into());
    }
    let by_points = [
        ("--normalize-exposure", o.finish.normalize_exposure),
        ("--remove-background auto", o.finish.background == finish::background::Background::Auto),
    ];
    if let Some((flag, _)) = by_points.iter().find(|f| f.1 && capture.points.is_empty()) {
        let what = "goes by points, and the capture has none: neither COLMAP's points3D nor a ply_file_path in transforms.json";
        return Err(PipelineError::Usage(format!("{flag}: {what}")));
    }
    Ok(capture)
}

/// Copies the photographs and masks of a capture into the data set; returns none when interrupted.
///
/// # Errors
/// When a photograph or mask cannot be read or copied, or its size contradicts its camera.
pub fn take(capture: Capture, o: &PrepareOptions, interrupt: &AtomicBool, note: &mut dyn FnMut(&str)) -> Result<Option<Posed>> {
    capture.notes.iter().for_each(|n| note(n));
    let is_divided = !divided_by_default(&capture.frames);
    let chosen: Vec<usize> = (0..capture.frames.len()).step_by(o.every).collect();
    let mut frames: Vec<Frame> = chosen.iter().map(|i| capture.frames[*i].clone()).collect();
    let done = o.out.join(POSED).join(IMAGES_DONE);
    let images: Vec<PathBuf> = frames.iter().map(|f| f.image.clone()).collect();
    let stems = stems(&images);
    if !done.exists() {
        if !copy(&capture, &frames, &stems, o, interrupt, note)? {
            return Ok(None);
        }
        atomic::write(&done, b"")?;
    }
    let copied: HashMap<String, PathBuf> = photo_import::list(&o.out.join(IMAGES))?
        .into_iter()
        .map(|p| (p.file_stem().unwrap_or_default().to_string_lossy().into_owned(), p))
        .collect();
    for (f, stem) in frames.iter_mut().zip(&stems) {
        let there = copied
            .get(stem)
            .ok_or_else(|| DataError::input(&o.out, format!("holds no copy of {}; begin anew with --force", f.image.display())))?;
        let (w, h) = photo::size(there)?;
        (f.camera, f.image) = (f.camera.resized(w, h), there.clone());
        f.mask = f.mask.as_ref().map(|_| mask_file(&o.out, stem));
    }
    let poses: Vec<Pose> = frames.iter().map(|f| f.world_from_camera).collect();
    let (center, distance) = focus_point(&poses);
    let scale = world::DISTANCE / distance;
    let finishing_from_world = Similarity { scale, translation: -center * scale, ..Similarity::IDENTITY };
    let angle = |p: &Pose| (-p.rotation.y_axis).dot(DVec3::Z).clamp(-1.0, 1.0).acos().to_degrees();
    let tilt = poses.iter().map(angle).sum::<f64>() / poses.len() as f64;
    let found = found(&capture, &chosen, &frames, &finishing_from_world, o);
    Ok(Some(Posed {
        images: frames.len(),
        scene: capture.scene,
        // The copied masks are already inverted where needed.
        masks: diorama_geom::capture::MaskRule { inverted: false, ..capture.masks },
        finishing_from_world,
        found,
        points: seen_by(&capture.points, &chosen),
        frames,
        lost: Vec::new(),
        broken: capture.broken,
        tilt,
        floor: false,
        is_divided,
    }))
}

fn mask_file(out: &Path, stem: &str) -> PathBuf {
    out.join(MASKS).join(format!("{stem}.png"))
}

/// Whether the frames have the default split, that of a capture without a split of its own.
fn divided_by_default(frames: &[Frame]) -> bool {
    let mut other = frames.to_vec();
    split::apply(&SplitRule::File, &mut other, false, 0);
    frames.iter().zip(&other).all(|(a, b)| a.split == b.split)
}

/// Copies photographs without metadata, and masks; returns false when interrupted.
fn copy(
    capture: &Capture,
    frames: &[Frame],
    stems: &[String],
    o: &PrepareOptions,
    interrupt: &AtomicBool,
    note: &mut dyn FnMut(&str),
) -> Result<bool> {
    let images = o.out.join(IMAGES);
    if frames.iter().any(|f| f.mask.is_some()) {
        let masks = o.out.join(MASKS);
        std::fs::create_dir_all(&masks).map_err(DataError::io(&masks, "create"))?;
    }
    for (i, (f, stem)) in frames.iter().zip(stems).enumerate() {
        if interrupt.load(Ordering::Relaxed) {
            return Ok(false);
        }
        let (size, c) = (photo::size(&f.image)?, &f.camera);
        if size != (c.width, c.height) {
            let what =
                format!("the photograph is {}×{} but its camera says {}×{}; correct the poses' file", size.0, size.1, c.width, c.height);
            return Err(DataError::input(&f.image, what).into());
        }
        photo_import::import(&f.image, &images, stem, o.max_side)?;
        let mask = diorama_data::masks::of_frame(f, &capture.masks, (size.0 as usize, size.1 as usize))?;
        if let Some(mask) = mask {
            photo::save_png(&mask_file(&o.out, stem), &ImageU8 { channels: 1, ..mask })?;
        }
        note(&format!("photographs: {} of {}", i + 1, frames.len()));
    }
    Ok(true)
}

/// The points with their frame lists restricted to the `chosen` frames and renumbered.
fn seen_by(points: &[SparsePoint], chosen: &[usize]) -> Vec<SparsePoint> {
    let place: HashMap<u32, u32> = chosen.iter().enumerate().map(|(k, i)| (*i as u32, k as u32)).collect();
    points.iter().map(|p| SparsePoint { frames: p.frames.iter().filter_map(|f| place.get(f).copied()).collect(), ..p.clone() }).collect()
}

/// The capture's points as [`finish::finish`] needs them; `chosen` holds the indices of `frames` in the capture.
fn found(capture: &Capture, chosen: &[usize], frames: &[Frame], finishing_from_world: &Similarity, o: &PrepareOptions) -> finish::Found {
    if !o.finish.touches_pixels() || capture.points.is_empty() {
        return finish::Found::default();
    }
    let is_visibility_known = capture.points.iter().any(|p| !p.frames.is_empty());
    let mut observed: Vec<Vec<([f64; 2], u64)>> = vec![Vec::new(); frames.len()];
    let place: HashMap<usize, usize> = chosen.iter().enumerate().map(|(k, i)| (*i, k)).collect();
    let camera_from_world: Vec<Pose> = frames.iter().map(|f| f.world_from_camera.inverse()).collect();
    for (id, p) in capture.points.iter().enumerate() {
        let told = p.frames.iter().filter_map(|f| place.get(&(*f as usize)).copied());
        let shown_by: Vec<usize> = if is_visibility_known { told.collect() } else { (0..frames.len()).collect() };
        for k in shown_by {
            let c = &frames[k].camera;
            let inside = |px: &diorama_geom::glam::DVec2| px.min_element() >= 0.0 && px.x < c.width as f64 && px.y < c.height as f64;
            if let Some(px) = c.project(camera_from_world[k].point(p.position)).filter(inside) {
                observed[k].push((px.to_array(), id as u64));
            }
        }
    }
    let name = |f: &Frame| f.image.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let images = |n: usize| if is_visibility_known { n } else { UNTOLD };
    let points =
        capture.points.iter().enumerate().map(|(id, p)| (id as u64, finishing_from_world.point(p.position), images(p.frames.len())));
    finish::Found {
        points: points.collect(),
        observed: frames.iter().zip(observed).map(|(f, points)| (name(f), Observed { image: name(f), points })).collect(),
        is_visibility_known,
    }
}
