//! Post-processing of photographs with known poses: selection, exposure normalization, denoising, background removal, cropping. Results
//! are written to a separate folder; the originals, from which COLMAP computed the poses, are kept.

pub mod background;
mod denoise;
pub(crate) mod exposure;
mod grab_cut;
mod graph_cut;
#[cfg(feature = "onnx")]
mod network;
mod select;

use crate::error::{PipelineError, Result};
use background::{Background, Subject};
use diorama_data::colmap::Observed;
use diorama_data::{DataError, masks, photo, photo_import};
use diorama_geom::capture::{Frame, MaskRule};
use diorama_geom::glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Part of a photograph that is kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Crop {
    /// The largest centered square.
    Square,
    /// x, y, width, height in pixels of the photograph.
    Window([u32; 4]),
}

impl std::str::FromStr for Crop {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Self, String> {
        if s == "square" {
            return Ok(Crop::Square);
        }
        let v: Option<Vec<u32>> = s.split(',').map(|v| v.trim().parse().ok()).collect();
        match v.as_deref() {
            Some(&[x, y, w, h]) if w >= 16 && h >= 16 => Ok(Crop::Window([x, y, w, h])),
            _ => Err(format!("crop {s:?}: expected square or x,y,width,height in pixels, at least 16 wide and high")),
        }
    }
}

/// Options of [`finish`]; by default, nothing is done.
#[derive(Clone, Debug, Default)]
pub struct Finish {
    pub crop: Option<Crop>,
    /// Keep only this many photographs, those that differ most.
    pub diverse: Option<usize>,
    pub denoise: bool,
    pub normalize_exposure: bool,
    pub background: Background,
}

impl Finish {
    /// Whether any option changes pixels.
    pub fn touches_pixels(&self) -> bool {
        self.crop.is_some() || self.denoise || self.normalize_exposure || self.background != Background::Keep
    }
}

/// Result of [`finish`].
#[derive(Clone, Debug, Default, Serialize)]
pub struct Finished {
    /// Photographs with poses that were left out.
    pub left_out: usize,
    /// Darkest and brightest photograph before exposure normalization, in stops relative to the median gain.
    pub exposure_stops: Option<[f32; 2]>,
    /// Median standard deviation of the removed noise, in 8-bit steps.
    pub noise: Option<f32>,
    /// Mean share of the pixels that are foreground.
    pub foreground: Option<f32>,
}

/// Name of the folder of finished photographs within the data set.
pub const FINISHED: &str = "finished";
/// Folder of cropped masks within [`FINISHED`].
const MASKS: &str = "masks";
/// Folder of unfinished work; [`put_in_place`] renames it to [`FINISHED`].
const PARTIAL: &str = "finished.partial";

/// Sparse points that exposure normalization and background removal rely on.
#[derive(Default)]
pub struct Found {
    /// Observations of the points, by the photograph's file name.
    pub observed: HashMap<String, Observed>,
    /// Number, position in the world of the finished frames, and number of photographs of each point.
    pub points: Vec<(u64, DVec3, usize)>,
    /// Whether `observed` lists only visible points, rather than all points that project into the photograph.
    pub is_visibility_known: bool,
}

/// Replaces the results of an earlier call by those of [`finish`], or removes them if there are no new ones.
///
/// # Errors
/// When a folder cannot be removed or renamed.
pub fn put_in_place(root: &Path) -> Result<()> {
    let (folder, partial) = (root.join(FINISHED), root.join(PARTIAL));
    if folder.exists() {
        std::fs::remove_dir_all(&folder).map_err(DataError::io(&folder, "remove"))?;
    }
    if partial.exists() {
        std::fs::rename(&partial, &folder).map_err(DataError::io(&partial, "rename"))?;
    }
    Ok(())
}

/// Removes the unfinished work of an interrupted or failed [`finish`].
pub fn discard(root: &Path) {
    let _ = std::fs::remove_dir_all(root.join(PARTIAL));
}

/// Post-processes the photographs of `frames`, whose poses are in the upright world; returns none when interrupted. Results of an earlier
/// call stay until [`put_in_place`].
///
/// # Errors
/// When a photograph cannot be read, a crop exceeds it, or the object cannot be separated from its surroundings.
pub fn finish(
    o: &Finish,
    root: &Path,
    found: &Found,
    frames: &mut Vec<Frame>,
    interrupt: &AtomicBool,
    note: &mut dyn FnMut(&str),
) -> Result<Option<Finished>> {
    let mut made = Finished::default();
    if let Some(n) = o.diverse {
        note("choosing photographs that differ");
        made.left_out = keep_diverse(frames, n)?;
    }
    let folder = root.join(PARTIAL);
    if folder.exists() {
        std::fs::remove_dir_all(&folder).map_err(DataError::io(&folder, "remove"))?;
    }
    if !o.touches_pixels() {
        return Ok(Some(made));
    }
    std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
    if o.crop.is_some() && frames.iter().any(|f| f.mask.is_some()) {
        let masks = folder.join(MASKS);
        std::fs::create_dir_all(&masks).map_err(DataError::io(&masks, "create"))?;
    }
    if frames.iter().any(|f| photo::header(&f.image).is_ok_and(|h| h.depth > photo::Depth::Eight)) {
        note("photographs of more than 8 bits are finished in 8 bits");
    }
    let gains = match o.normalize_exposure {
        true => {
            note("comparing exposures");
            Some(exposure_gains(frames, found)?)
        }
        false => None,
    };
    made.exposure_stops = gains.as_deref().map(stops);
    let finisher = Finisher { options: o, root, folder, found, gains, remover: Remover::open(&o.background, frames, found)? };
    let mut out = Vec::new();
    // In groups, to report progress and to react to an interrupt.
    for first in (0..frames.len()).step_by(4) {
        if interrupt.load(Ordering::Relaxed) {
            return Ok(None);
        }
        let last = (first + 4).min(frames.len());
        let group: Vec<_> = (first..last).into_par_iter().map(|i| finisher.finish(i, &frames[i])).collect::<Result<_>>()?;
        out.extend(group);
        note(&format!("finishing photographs: {last} of {}", frames.len()));
    }
    let mut sigmas: Vec<f32> = out.iter().map(|v| v.noise).collect();
    sigmas.sort_by(f32::total_cmp);
    made.noise = o.denoise.then(|| sigmas[sigmas.len() / 2]);
    made.foreground = (o.background != Background::Keep).then(|| out.iter().map(|v| v.foreground).sum::<f32>() / out.len().max(1) as f32);
    *frames = out.into_iter().map(|v| v.frame).collect();
    Ok(Some(made))
}

/// Keeps the `n` photographs that differ most; returns how many were left out.
fn keep_diverse(frames: &mut Vec<Frame>, n: usize) -> Result<usize> {
    let looks = frames.par_iter().map(|f| Ok(select::looks(&photo::load(&f.image)?))).collect::<Result<Vec<_>>>()?;
    let chosen = select::diverse(frames, &looks, n);
    let left_out = frames.len() - chosen.len();
    *frames = chosen.into_iter().map(|i| frames[i].clone()).collect();
    Ok(left_out)
}

/// Log gain of each photograph and channel; [`exposure::apply`] removes it.
fn exposure_gains(frames: &[Frame], found: &Found) -> Result<Vec<[f32; 3]>> {
    let name = |f: &Frame| f.image.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let of = |f: &Frame| match found.observed.get(&name(f)) {
        Some(seen) => Ok(exposure::colors(&photo::load(&f.image)?, seen)),
        None => Ok(Vec::new()),
    };
    Ok(exposure::gains(&frames.par_iter().map(of).collect::<Result<Vec<_>>>()?))
}

/// Smallest and largest gain in stops.
fn stops(gains: &[[f32; 3]]) -> [f32; 2] {
    let stops = gains.iter().map(|g| g.iter().sum::<f32>() / 3.0 / std::f32::consts::LN_2);
    stops.fold([f32::INFINITY, f32::NEG_INFINITY], |[lo, hi], s| [lo.min(s), hi.max(s)])
}

/// Post-processes single photographs.
struct Finisher<'a> {
    options: &'a Finish,
    /// The data set.
    root: &'a Path,
    /// Folder of finished photographs until [`put_in_place`].
    folder: PathBuf,
    found: &'a Found,
    gains: Option<Vec<[f32; 3]>>,
    remover: Remover,
}

/// A frame with its post-processed photograph.
struct FinishedFrame {
    frame: Frame,
    /// Standard deviation of the removed noise, in 8-bit steps.
    noise: f32,
    /// Share of the pixels that are foreground.
    foreground: f32,
}

impl Finisher<'_> {
    fn finish(&self, i: usize, f: &Frame) -> Result<FinishedFrame> {
        let mut image = photo::load(&f.image)?;
        if let Some(g) = &self.gains {
            exposure::apply(&mut image, g[i]);
        }
        // The mask is computed before denoising.
        let alpha = self.remover.alpha(&image, f, self.found)?;
        let noise = if self.options.denoise { denoise::noise(&image) } else { 0.0 };
        image = denoise::denoise(&image, noise);
        let mut foreground = 1.0;
        if let Some(alpha) = alpha {
            foreground = alpha.iter().map(|a| *a as f64).sum::<f64>() as f32 / 255.0 / alpha.len().max(1) as f32;
            image = background::with_alpha(&image, &alpha);
        }
        let mut frame = f.clone();
        let stem = f.image.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        if let Some(crop) = self.options.crop {
            let mask = masks::of_frame(&frame, &MaskRule::default(), (image.width, image.height))?;
            if let Some(mask) = mask {
                let cut = crop_to(crop, mask, &mut frame.clone())?;
                let written = self.folder.join(MASKS).join(format!("{stem}.png"));
                photo::save_png(&written, &cut)?;
                frame.mask = Some(self.root.join(FINISHED).join(MASKS).join(written.file_name().unwrap_or_default()));
            }
            image = crop_to(crop, image, &mut frame)?;
        }
        let written = photo_import::write_like(&frame.image, &image, &self.folder, &stem)?;
        frame.image = self.root.join(FINISHED).join(written.file_name().unwrap_or_default());
        Ok(FinishedFrame { frame, noise, foreground })
    }
}

/// Method that separates foreground and background, ready to run.
enum Remover {
    None,
    Points(Subject),
    #[cfg(feature = "onnx")]
    Network(network::Network),
}

impl Remover {
    fn open(how: &Background, frames: &[Frame], found: &Found) -> Result<Remover> {
        match how {
            Background::Keep => Ok(Remover::None),
            Background::Auto => {
                let subject = Subject::find(frames, &found.points);
                if subject.size() < FEWEST_POINTS {
                    return Err(PipelineError::Usage(format!(
                        "--remove-background auto: only {} points belong to what the cameras look at, {FEWEST_POINTS} are needed; \
                         give a network (NETWORK.onnx) or keep the background",
                        subject.size()
                    )));
                }
                Ok(Remover::Points(subject))
            }
            #[cfg(feature = "onnx")]
            Background::Network(file) => Ok(Remover::Network(network::Network::open(file)?)),
            #[cfg(not(feature = "onnx"))]
            Background::Network(file) => Err(PipelineError::Usage(format!(
                "--remove-background {}: this build runs no networks; build it with --features onnx, or use auto",
                file.display()
            ))),
        }
    }

    fn alpha(&self, image: &diorama_geom::ImageU8, frame: &Frame, found: &Found) -> Result<Option<Vec<u8>>> {
        match self {
            Remover::None => Ok(None),
            Remover::Points(subject) => {
                let name = frame.image.file_name().unwrap_or_default().to_string_lossy();
                let mut observed = found.observed.get(&*name).cloned();
                if let (false, Some(o)) = (found.is_visibility_known, &mut observed) {
                    // Points behind the object would seed background on top of it; the object's own points are inside its outline anyway.
                    o.points.retain(|p| subject.is_own(p.1));
                }
                Ok(Some(subject.alpha(image, frame, observed.as_ref())))
            }
            #[cfg(feature = "onnx")]
            Remover::Network(network) => network.alpha(image).map(Some),
        }
    }
}

/// Fewest points that separate an object from its surroundings.
const FEWEST_POINTS: usize = 50;

/// Crops a photograph and adjusts its camera.
fn crop_to(crop: Crop, image: diorama_geom::ImageU8, frame: &mut Frame) -> Result<diorama_geom::ImageU8> {
    let (w, h) = (image.width, image.height);
    let [x, y, cw, ch] = match crop {
        Crop::Square => {
            let side = w.min(h);
            [(w - side) / 2, (h - side) / 2, side, side]
        }
        Crop::Window(v) => v.map(|v| v as usize),
    };
    if x + cw > w || y + ch > h {
        return Err(PipelineError::Usage(format!(
            "--crop {x},{y},{cw},{ch}: leaves {}, which has {w} by {h} pixels",
            frame.image.display()
        )));
    }
    let c = image.channels;
    let data = (y..y + ch).flat_map(|row| &image.data[(row * w + x) * c..(row * w + x + cw) * c]).copied().collect();
    let camera = &mut frame.camera;
    (camera.width, camera.height) = (cw as u32, ch as u32);
    (camera.cx, camera.cy) = (camera.cx - x as f64, camera.cy - y as f64);
    Ok(diorama_geom::ImageU8 { width: cw, height: ch, channels: c, data })
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::{Camera, ImageU8, Pose};

    #[test]
    fn a_cropped_camera_sees_the_same_directions() {
        let data = (0..40 * 30).flat_map(|i| [(i % 40) as u8, (i / 40) as u8, 0]).collect();
        let image = ImageU8 { width: 40, height: 30, channels: 3, data };
        for (crop, [x, y, w, h]) in [(Crop::Square, [5, 0, 30, 30]), ("3,4,20,16".parse().unwrap(), [3usize, 4, 20, 16])] {
            let mut f = Frame::new("a", "a.jpg", Camera::pinhole(40, 30, 0.8), Pose::IDENTITY);
            let before = f.camera;
            let cut = crop_to(crop, image.clone(), &mut f).unwrap();
            assert_eq!((cut.width, cut.height, cut.pixel(0, 0)), (w, h, &[x as u8, y as u8, 0][..]));
            let (a, b) = (before.direction(17.5, 12.5), f.camera.direction(17.5 - x as f64, 12.5 - y as f64));
            assert!((a - b).length() < 1e-12);
        }
        let mut f = Frame::new("a", "a.jpg", Camera::pinhole(40, 30, 0.8), Pose::IDENTITY);
        assert!(crop_to(Crop::Window([30, 0, 20, 20]), image, &mut f).unwrap_err().to_string().contains("--crop"));
        assert!("1,2,3".parse::<Crop>().is_err() && "0,0,4,4".parse::<Crop>().is_err());
    }
}
