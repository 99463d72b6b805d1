//! Checks photographs against their cameras: sizes, color spaces, depth maps, and whether the files are complete.

use crate::error::{DataError, Result};
use crate::photo::{self, Depth, Header, Photo};
use crate::{npy, photo_import, sparse};
use diorama_geom::Capture;
use diorama_geom::capture::{ColorSpace, Frame};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;

/// Result of [`fit`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Fitted {
    /// Notes for the user, one line each.
    pub notes: Vec<String>,
    /// Indices of the frames that are kept, ascending.
    pub kept: Vec<usize>,
    /// Names of the photographs that were left out.
    pub broken: Vec<String>,
}

/// Reads the header of every photograph, adapts cameras to photographs of another size, notes color spaces, and checks depth maps. With
/// `skip_broken`, photographs that cannot be read are left out and listed.
///
/// # Errors
/// If a photograph cannot be read, has another aspect ratio than its camera, or another kind of light (sRGB or linear) than the others.
pub fn fit(frames: &mut Vec<Frame>, skip_broken: bool) -> Result<Fitted> {
    let mut notes = Vec::new();
    let headers: Vec<Result<Header>> = frames.par_iter().map(|f| photo::header(&f.image)).collect();
    let mut broken = Vec::new();
    let (mut kept, mut numbers) = (Vec::new(), Vec::new());
    for (i, (mut frame, header)) in std::mem::take(frames).into_iter().zip(headers).enumerate() {
        let header = match header {
            Ok(h) => h,
            Err(e) if skip_broken && e.is_input() => {
                broken.push(e);
                continue;
            }
            Err(e) => return Err(e),
        };
        frame.color_space = header.color_space();
        kept.push((frame, header));
        numbers.push(i);
    }
    notes.extend(left_out(&broken));
    notes.extend(scaled(&mut kept)?);
    *frames = kept.into_iter().map(|f| f.0).collect();
    one_kind_of_light(frames)?;
    frames.par_iter().try_for_each(depth_fits)?;
    match frames.iter().filter(|f| f.depth.is_some()).count() {
        0 => {}
        n => notes.push(format!("{n} depth maps (depth_file_path) are not used")),
    }
    Ok(Fitted { notes, kept: numbers, broken: names(&broken) })
}

/// Decodes every photograph, drops the frames of those that cannot be decoded, and lists them in the capture's notes.
///
/// # Errors
/// If reading fails, or too few training views remain.
pub fn leave_out_broken(capture: &mut Capture) -> Result<()> {
    let verdicts: Vec<Result<()>> = capture.frames.par_iter().map(|f| photo::load_full(&f.image).map(drop)).collect();
    let mut broken = Vec::new();
    let mut kept = Vec::new();
    for (i, verdict) in verdicts.into_iter().enumerate() {
        match verdict {
            Ok(()) => kept.push(i),
            Err(e) if e.is_input() => broken.push(e),
            Err(e) => return Err(e),
        }
    }
    capture.frames = kept.iter().map(|i| capture.frames[*i].clone()).collect();
    sparse::keep(&mut capture.points, capture.agreement.as_mut(), &kept);
    let train = capture.indices(diorama_geom::capture::Split::Train).len();
    if let (0..2, Some(first)) = (train, broken.first()) {
        return Err(DataError::input(
            broken_file(first),
            format!("one of {} broken photographs, without which {train} training views are left; copy them again", broken.len()),
        ));
    }
    capture.notes.extend(left_out(&broken));
    capture.broken.extend(names(&broken));
    Ok(())
}

fn broken_file(e: &DataError) -> &Path {
    match e {
        DataError::Input { path, .. } | DataError::Io { path, .. } | DataError::Failed { program: path, .. } => path,
    }
}

fn names(broken: &[DataError]) -> Vec<String> {
    broken.iter().map(|e| broken_file(e).file_name().unwrap_or_default().to_string_lossy().into_owned()).collect()
}

/// A note that lists the photographs that were left out.
pub fn left_out(broken: &[DataError]) -> Option<String> {
    let names = names(broken);
    let some = if names.len() == 1 { "broken photograph is" } else { "broken photographs are" };
    (!names.is_empty()).then(|| format!("{} {some} left out: {}", names.len(), names.join(", ")))
}

/// Most photographs that [`white`] reads.
const WHITE_SAMPLES: usize = 12;
/// Share of the values that are darker than white.
const DARKER: f32 = 0.97;

/// A value of linear light that can be displayed as white: nearly all values of some photographs are darker.
///
/// # Errors
/// If a photograph cannot be decoded, or all are black.
pub fn white(frames: &[&Frame]) -> Result<f32> {
    let n = frames.len().min(WHITE_SAMPLES);
    let looks = (0..n).into_par_iter().map(|i| {
        let photo = photo::load_full(&frames[i * frames.len() / n].image)?;
        let (w, h) = photo.size();
        let by = (200.0 / w.max(h) as f64).min(1.0);
        let small = photo.downsampled(((w as f64 * by) as usize).max(1), ((h as f64 * by) as usize).max(1));
        let Photo::Linear(im) = small else { return Ok(Vec::new()) };
        let seen = im.data.chunks_exact(im.channels).filter(|p| p.get(3).is_none_or(|a| *a > 0.5));
        Ok(seen.map(|p| p[0].max(p[1]).max(p[2])).collect::<Vec<f32>>())
    });
    let mut values = looks.collect::<Result<Vec<_>>>()?.concat();
    values.sort_by(f32::total_cmp);
    let found = values.get(((values.len() as f32 * DARKER) as usize).min(values.len().saturating_sub(1))).copied().unwrap_or(0.0);
    match (found > 0.0, frames.first()) {
        (false, Some(f)) => {
            Err(DataError::input(&f.image, "is black, and so are the other photographs; give photographs that show something"))
        }
        _ => Ok(found),
    }
}

/// Scales cameras to the sizes of their photographs.
fn scaled(frames: &mut [(Frame, Header)]) -> Result<Vec<String>> {
    let mut changes: BTreeMap<((u32, u32), (u32, u32)), usize> = BTreeMap::new();
    for (f, header) in frames.iter_mut() {
        let (is, expected) = (header.size, (f.camera.width, f.camera.height));
        if is == expected {
            continue;
        }
        let turned = header.is_turned && photo::is_same_aspect((is.1, is.0), expected);
        if turned {
            return Err(DataError::input(
                &f.image,
                format!(
                    "the photograph is {}×{} after the rotation in its metadata, but its camera says {}×{}; the poses belong to unrotated \
                     photographs: remove the orientation (exiftool -Orientation= FILE)",
                    is.0, is.1, expected.0, expected.1
                ),
            ));
        }
        if !photo::is_same_aspect(is, expected) {
            return Err(DataError::input(
                &f.image,
                format!(
                    "the photograph is {}×{} but its camera says {}×{}, which has another aspect ratio; use the photographs that the poses \
                     were found for, or copies of them that are only resized",
                    is.0, is.1, expected.0, expected.1
                ),
            ));
        }
        f.camera = f.camera.resized(is.0, is.1);
        *changes.entry((is, expected)).or_default() += 1;
    }
    let note = |(((w, h), (cw, ch)), n): (&((u32, u32), (u32, u32)), &usize)| {
        format!("{n} photographs are {w}×{h} where the poses' file says {cw}×{ch}: focal lengths and centers are scaled")
    };
    Ok(changes.iter().map(note).collect())
}

fn one_kind_of_light(frames: &[Frame]) -> Result<()> {
    let of = |space: ColorSpace| frames.iter().find(|f| f.color_space == space);
    let (Some(linear), Some(srgb)) = (of(ColorSpace::Linear), of(ColorSpace::Srgb)) else { return Ok(()) };
    let other = srgb.image.file_name().unwrap_or_default().to_string_lossy();
    Err(DataError::input(&linear.image, format!("holds linear light, but {other} does not; give photographs of one kind")))
}

/// Checks that a frame's depth map is readable and has the aspect ratio of its photograph.
fn depth_fits(f: &Frame) -> Result<()> {
    let Some(file) = &f.depth else { return Ok(()) };
    let extension = file.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    let size = if extension == "npy" {
        match npy::read(file)?.0[..] {
            [h, w] | [h, w, 1] => (w as u32, h as u32),
            ref shape => return Err(DataError::input(file, format!("has shape {shape:?}; a depth map is [height, width]"))),
        }
    } else if photo_import::EXTENSIONS.contains(&&*extension) {
        let header = photo::header(file)?;
        if header.depth == Depth::Eight {
            return Err(DataError::input(file, "a depth map of 8 bits; give one of 16 bits, EXR or NPY, or remove depth_file_path"));
        }
        header.size
    } else {
        return Err(DataError::input(file, "not a depth map that can be read; give PNG of 16 bits, EXR or NPY, or remove depth_file_path"));
    };
    let photo = (f.camera.width, f.camera.height);
    if photo::is_same_aspect(size, photo) {
        return Ok(());
    }
    Err(DataError::input(
        file,
        format!(
            "the depth map is {}×{} but its photograph is {}×{}, which has another aspect ratio; remove depth_file_path or give the right one",
            size.0, size.1, photo.0, photo.1
        ),
    ))
}
