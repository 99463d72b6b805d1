//! Class of each pixel of the training photographs: of labelled ones from their polygons, of the others by the depth that was learned
//! (Cui et al. 2024, equations 6 and 9).

use super::config::MOST_CLASSES;
use crate::error::{PipelineError, Result};
use crate::run::kept_capture;
use crate::text::annotate::LABELS;
use crate::text::truth;
use diorama_data::text_labels::{self, LabelledImage};
use diorama_data::{DataError, photo};
use diorama_engine::renderers::view::View;
use diorama_geom::Capture;
use diorama_geom::capture::{Frame, Split};
use diorama_geom::glam::{DVec2, DVec3};
use diorama_kernels::ops::ray_generation::PosedCamera;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;

/// Class of a pixel that nobody knows.
pub const UNKNOWN: u8 = 255;
/// Opacity from which a pixel has a surface.
const SURFACE: f32 = 0.9;
/// Pixels by which a point may miss itself on the way there and back, and the difference of depths on the way.
const ROUND_TRIP: f64 = 1.5;
const DEPTH: f64 = 0.02;

/// A text region.
#[derive(Clone, Debug, PartialEq)]
pub struct Class {
    pub id: u32,
    pub transcription: String,
}

/// Labels of a capture.
#[derive(Clone, Debug, PartialEq)]
pub struct Labels {
    /// Regions by class, from class 1 on; class 0 is the background.
    pub classes: Vec<Class>,
    /// Of each frame of the capture, where it is labelled.
    pub of_frame: Vec<Option<LabelledImage>>,
}

impl Labels {
    /// Reads `labels.jsonl` of `folder` for a capture whose photographs lie in `root`.
    ///
    /// # Errors
    /// When it is missing or damaged, labels no training photograph, or names other photographs.
    pub fn read(folder: &Path, capture: &Capture, root: &Path) -> Result<Labels> {
        let file = folder.join(LABELS);
        let root = kept_capture::absolute(root);
        let train = capture.indices(Split::Train);
        if !file.exists() {
            let what = "is missing; import labels with `diorama text annotate`, or write one line per photograph as";
            return Err(DataError::input(&file, format!("{what} {}", text_labels::EXAMPLE)).into());
        }
        let images = text_labels::load(&file)?;
        let name = |f: &Frame| {
            let path = kept_capture::absolute(&f.image);
            path.strip_prefix(&root).unwrap_or(&path).to_string_lossy().into_owned()
        };
        let mut of_frame: Vec<Option<LabelledImage>> = vec![None; capture.frames.len()];
        for image in images {
            let Some(i) = capture.frames.iter().position(|f| name(f) == image.image) else {
                let first = capture.frames.first().map(name).unwrap_or_default();
                return Err(
                    DataError::input(&file, format!("{}: the capture has no such photograph; its first is {first}", image.image)).into()
                );
            };
            of_frame[i] = Some(image);
        }
        let mut found: BTreeMap<u32, String> = BTreeMap::new();
        for region in train.iter().filter_map(|i| of_frame[*i].as_ref()).flat_map(|i| &i.regions).filter(|r| !r.ignore) {
            found.entry(region.id).or_insert_with(|| region.transcription.clone());
        }
        let classes: Vec<Class> = found.into_iter().map(|(id, transcription)| Class { id, transcription }).collect();
        if classes.is_empty() {
            let what = "labels no region of a training photograph; write lines like";
            return Err(DataError::input(&file, format!("{what} {}", text_labels::EXAMPLE)).into());
        }
        if classes.len() >= MOST_CLASSES {
            let what =
                format!("has {} regions; a field tells {} apart: leave some out, or split the scene", classes.len(), MOST_CLASSES - 1);
            return Err(DataError::input(&file, what).into());
        }
        Ok(Labels { classes, of_frame })
    }

    /// Writes them to `labels.jsonl` of a folder.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save(&self, folder: &Path) -> Result<()> {
        let images: Vec<LabelledImage> = self.of_frame.iter().flatten().cloned().collect();
        Ok(text_labels::save(&folder.join(LABELS), &images)?)
    }

    /// Classes, the background's among them.
    pub fn count(&self) -> usize {
        self.classes.len() + 1
    }

    /// Class of a region.
    pub fn class_of(&self, id: u32) -> Option<u8> {
        self.classes.iter().position(|c| c.id == id).map(|k| k as u8 + 1)
    }

    /// Class of each pixel of a labelled photograph of `size`, whose labels are in pixels of `of`: ignored regions are unknown.
    pub fn map(&self, image: &LabelledImage, size: (u32, u32), of: (u32, u32)) -> Vec<u8> {
        let (w, h) = (size.0 as usize, size.1 as usize);
        let scale = DVec2::new(size.0 as f64 / of.0 as f64, size.1 as f64 / of.1 as f64);
        let mut map = vec![0; w * h];
        for region in &image.regions {
            let class = if region.ignore { UNKNOWN } else { self.class_of(region.id).unwrap_or(UNKNOWN) };
            let polygon: Vec<DVec2> = region.polygon.iter().map(|p| DVec2::from(*p) * scale).collect();
            for (i, v) in map.iter_mut().enumerate() {
                if contains(&polygon, DVec2::new((i % w) as f64 + 0.5, (i / w) as f64 + 0.5)) {
                    *v = class;
                }
            }
        }
        map
    }
}

/// Whether a polygon contains a point, by the number of sides to its right.
pub fn contains(polygon: &[DVec2], p: DVec2) -> bool {
    let sides = (0..polygon.len()).map(|k| (polygon[k], polygon[(k + 1) % polygon.len()]));
    let crossed = sides.filter(|(a, b)| (a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x));
    crossed.count() % 2 == 1
}

/// Point on the surface that a pixel shows; none where it shows none.
fn surface(camera: &PosedCamera, view: &View, p: DVec2) -> Option<DVec3> {
    let (x, y) = (p.x as usize, p.y as usize);
    let i = y * view.depth.width + x;
    let opaque = p.x >= 0.0 && p.y >= 0.0 && x < view.depth.width && y < view.depth.height && view.opacity.data[i] > SURFACE;
    opaque
        .then(|| camera.pose.translation + camera.pose.rotation * camera.camera.direction(p.x, p.y).normalize() * view.depth.data[i] as f64)
}

/// Pixel of a point in a camera, and its depth along z.
fn seen(camera: &PosedCamera, point: DVec3) -> Option<(DVec2, f64)> {
    let p = camera.pose.inverse().point(point);
    (p.z > 0.0).then(|| camera.camera.project(p)).flatten().map(|at| (at, p.z))
}

/// How far a pixel of one view is from itself after the way to another and back, in pixels, and where it was there; none where it is hidden
/// or outside.
pub fn round_trip(from: (&PosedCamera, &View), to: (&PosedCamera, &View), p: DVec2) -> Option<(f64, DVec2)> {
    let point = surface(from.0, from.1, p)?;
    let (there, depth) = seen(to.0, point)?;
    let back = surface(to.0, to.1, there)?;
    let (_, other) = seen(to.0, back)?;
    let (home, _) = seen(from.0, back)?;
    let error = (home - p).length();
    (error < ROUND_TRIP && (depth - other).abs() < DEPTH * depth.min(other)).then_some((error, there))
}

/// Labels of photographs that have none, by the labelled ones that show the same surface: votes weigh `exp(−e² / 1.5²)` at an error `e` of the
/// round trip. `given` are the maps of labelled photographs.
pub fn proxies(cameras: &[PosedCamera], views: &[View], given: &[Option<Vec<u8>>], classes: usize) -> Vec<Vec<u8>> {
    let of = |i: usize| {
        let (w, h) = (views[i].depth.width, views[i].depth.height);
        let label = |k: usize| {
            let p = DVec2::new((k % w) as f64 + 0.5, (k / w) as f64 + 0.5);
            let mut votes = vec![0.0; classes];
            for (j, map) in given.iter().enumerate() {
                let Some(map) = map else { continue };
                let Some((error, there)) = round_trip((&cameras[i], &views[i]), (&cameras[j], &views[j]), p) else { continue };
                let class = map[there.y as usize * views[j].depth.width + there.x as usize];
                if class != UNKNOWN {
                    votes[class as usize] += (-(error / ROUND_TRIP).powi(2)).exp();
                }
            }
            let best = (0..classes).max_by(|a, b| votes[*a].total_cmp(&votes[*b])).unwrap_or(0);
            if votes[best] > 0.0 { best as u8 } else { UNKNOWN }
        };
        (0..w * h).into_par_iter().map(label).collect()
    };
    (0..views.len()).map(|i| if given[i].is_some() { vec![UNKNOWN; views[i].depth.data.len()] } else { of(i) }).collect()
}

/// # Errors
/// When no pixel of any photograph has a label.
pub fn check(maps: &[Vec<u8>]) -> Result<()> {
    if maps.iter().flatten().all(|c| *c == UNKNOWN) {
        return Err(PipelineError::Usage("no pixel of a labelled photograph counts: all of its regions are to be ignored".into()));
    }
    Ok(())
}

/// Class of each pixel of a frame whose photograph has `size`, as far as it is known: exact ones of a generated scene in `root`, else those of
/// its labels.
///
/// # Errors
/// When a file cannot be read.
pub fn known(labels: &Labels, capture: &Capture, root: &Path, frame: usize, size: (u32, u32)) -> Result<Option<Vec<u8>>> {
    let f = &capture.frames[frame];
    let stem = f.image.file_stem().unwrap_or_default().to_string_lossy();
    let path = truth::file(root, &format!("{stem}_classes.png"));
    if !path.exists() {
        let own = labels.of_frame[frame].as_ref();
        return Ok(own.map(|image| labels.map(image, size, (f.camera.width, f.camera.height))));
    }
    let image = photo::load(&path)?;
    let class = |value: u8| if value == 0 { 0 } else { labels.class_of(value as u32 - 1).unwrap_or(UNKNOWN) };
    let (w, h) = (size.0 as usize, size.1 as usize);
    let at = |i: usize| {
        let (x, y) = ((2 * (i % w) + 1) * image.width / (2 * w), (2 * (i / w) + 1) * image.height / (2 * h));
        class(image.data[(y * image.width + x) * image.channels])
    };
    Ok(Some((0..w * h).map(at).collect()))
}
