//! Scores of held-out photographs: colors, and the classes of their pixels.

use super::label_maps::{self, UNKNOWN};
use super::model::TextModel;
use super::recipe;
use crate::error::{PipelineError, Result};
use crate::run::photographs::StoredPhotographs;
use crate::text::truth;
use diorama_data::{DataError, import, photo};
use diorama_engine::metrics;
use diorama_engine::metrics::lpips::Lpips;
use diorama_engine::renderers::view::View;
use diorama_engine::renderers::volume::Quality;
use diorama_engine::samplers::pixels::PixelSource;
use diorama_geom::capture::Split;
use diorama_geom::{Image, ImageU8};
use serde::Serialize;

/// Figures of the held-out views.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Scores {
    pub views: usize,
    /// Means over the views.
    pub psnr: f64,
    pub ssim: f64,
    /// Mean over the regions that any of the views shows of the intersection over the union, all views together; none where no classes are
    /// known or learned.
    pub miou: Option<f64>,
    /// Median over the pixels of all views of the error of depth over depth; none where it is not known.
    pub depth_error: Option<f64>,
    pub per_view: Vec<ViewScore>,
}

/// Figures of a held-out view.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewScore {
    pub name: String,
    pub psnr: f64,
    pub ssim: f64,
    /// Perceptual distance, where weights for it were given.
    pub lpips: Option<f64>,
}

/// Pixels of each class that are its own in both maps, and in either.
#[derive(Clone, Debug, PartialEq)]
pub struct Overlap {
    both: Vec<u64>,
    either: Vec<u64>,
}

impl Overlap {
    pub fn new(classes: usize) -> Overlap {
        Overlap { both: vec![0; classes], either: vec![0; classes] }
    }

    /// Adds a view; pixels that are unknown in `wanted` do not count.
    pub fn add(&mut self, got: &[u8], wanted: &[u8]) {
        for (g, w) in got.iter().zip(wanted).filter(|(_, w)| **w != UNKNOWN) {
            if g == w {
                self.both[*g as usize] += 1;
                self.either[*g as usize] += 1;
            } else {
                self.either[*g as usize] += 1;
                self.either[*w as usize] += 1;
            }
        }
    }

    /// Mean over the text classes that are anywhere in either map.
    pub fn mean(&self) -> Option<f64> {
        let of: Vec<f64> =
            self.both.iter().zip(&self.either).skip(1).filter(|(_, n)| **n > 0).map(|(b, n)| *b as f64 / *n as f64).collect();
        (!of.is_empty()).then(|| of.iter().sum::<f64>() / of.len() as f64)
    }
}

/// The class of the largest share of each row.
pub fn classes(shares: &[f32], count: usize) -> Vec<u8> {
    let largest = |row: &[f32]| (0..count).max_by(|a, b| row[*a].total_cmp(&row[*b])).unwrap_or(0) as u8;
    shares.chunks_exact(count).map(largest).collect()
}

/// Colors of the classes in pictures.
const PALETTE: [[u8; 3]; 7] = [[30, 30, 30], [230, 80, 70], [70, 150, 230], [90, 200, 90], [240, 190, 60], [170, 100, 220], [80, 210, 210]];

/// Color of a class in pictures.
pub fn class_color(class: u8) -> [u8; 3] {
    match class {
        0 => PALETTE[0],
        c => PALETTE[1 + (c as usize - 1) % (PALETTE.len() - 1)],
    }
}

/// Photograph, rendered view, classes and known classes side by side.
fn sheet(photo: &Image, view: &Image, classes: [Option<&[u8]>; 2]) -> ImageU8 {
    let (w, h) = (photo.width, photo.height);
    let mut out = ImageU8 { width: 4 * w, height: h, channels: 3, data: vec![0; 12 * w * h] };
    for y in 0..h {
        for x in 0..w {
            let i = y * w + x;
            let color = |im: &Image| [0, 1, 2].map(|k| (im.data[3 * i + k].clamp(0.0, 1.0) * 255.0).round() as u8);
            let class = |map: Option<&[u8]>| match map.map(|m| m[i]) {
                None | Some(UNKNOWN) => [128; 3],
                Some(c) => class_color(c),
            };
            let cells = [color(photo), color(view), class(classes[0]), class(classes[1])];
            for (k, cell) in cells.iter().enumerate() {
                let at = 3 * (y * 4 * w + k * w + x);
                out.data[at..at + 3].copy_from_slice(cell);
            }
        }
    }
    out
}

/// Renders and compares the held-out views; `look` receives the name and a picture of each: photograph, view, classes, known classes.
///
/// # Errors
/// When none is held out, a photograph cannot be read, or `look` fails.
pub fn evaluate(model: &TextModel, look: &mut dyn FnMut(&str, &ImageU8) -> Result<()>) -> Result<Scores> {
    evaluate_with(model, None, look)
}

/// [`evaluate`], with the perceptual distance where `lpips` is given.
///
/// # Errors
/// As [`evaluate`]; when a view is too small for the distance.
pub fn evaluate_with(model: &TextModel, lpips: Option<&Lpips>, look: &mut dyn FnMut(&str, &ImageU8) -> Result<()>) -> Result<Scores> {
    let held_out = model.capture.indices(Split::Test);
    if held_out.is_empty() {
        let path = model.config.data.path.display();
        return Err(PipelineError::Usage(format!("{path}: no photograph is held out: train with --set data.split=every:8")));
    }
    let photographs = StoredPhotographs::new(recipe::load_pixels(&model.config, &model.capture, Split::Test)?);
    let mut off: Vec<f64> = Vec::new();
    let (mut scores, mut overlap) = (Scores { views: held_out.len(), ..Scores::default() }, Overlap::new(model.labels.count()));
    for (k, frame) in held_out.iter().enumerate() {
        let camera = model.posed(*frame);
        let (w, h) = photographs.size(k);
        let mut photo = Image::zeros(w as usize, h as usize, 3);
        for (i, pixel) in photo.data.chunks_exact_mut(3).enumerate() {
            pixel.copy_from_slice(&photographs.rgba(k, i as u32 % w, i as u32 / w)[..3]);
        }
        let view = model.tracer(Quality::Full).view(&camera, &mut |_| ());
        let counts = |x: usize, y: usize| photographs.counts(k, x as u32, y as u32);
        let compared = metrics::compare(&view.rgb, &photo, counts);
        let name = &model.capture.frames[*frame].name;
        let too_small = |e: String| PipelineError::Usage(format!("{name}: {e}"));
        let distance = lpips.map(|l| l.distance(&where_it_counts(&view.rgb, &photo, counts), &photo)).transpose().map_err(too_small)?;
        scores.per_view.push(ViewScore { name: name.clone(), psnr: compared.psnr, ssim: compared.ssim, lpips: distance });
        scores.psnr += compared.psnr / held_out.len() as f64;
        scores.ssim += compared.ssim / held_out.len() as f64;
        let got = model.shares(&camera, &mut |_| ()).map(|s| classes(&s, model.labels.count()));
        let wanted = label_maps::known(&model.labels, &model.capture, &import::root(&model.config.data.path)?, *frame, (w, h))?;
        if let (Some(got), Some(wanted)) = (&got, &wanted) {
            overlap.add(got, wanted);
        }
        depth_errors(model, *frame, &view, &mut off)?;
        look(name, &sheet(&photo, &view.rgb, [got.as_deref(), wanted.as_deref()]))?;
    }
    scores.miou = overlap.mean();
    off.sort_by(f64::total_cmp);
    scores.depth_error = off.get(off.len() / 2).copied();
    Ok(scores)
}

/// A view whose pixels that do not count are those of the photograph.
fn where_it_counts(view: &Image, photo: &Image, counts: impl Fn(usize, usize) -> bool) -> Image {
    let (mut out, width) = (view.clone(), view.width);
    for (i, (o, p)) in out.data.chunks_exact_mut(3).zip(photo.data.chunks_exact(3)).enumerate() {
        if !counts(i % width, i / width) {
            o.copy_from_slice(p);
        }
    }
    out
}

/// Adds the errors of a view's depth over the exact depth of a generated scene, where it has surfaces.
fn depth_errors(model: &TextModel, frame: usize, view: &View, out: &mut Vec<f64>) -> Result<()> {
    let stem = model.capture.frames[frame].image.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let file = truth::file(&import::root(&model.config.data.path)?, &format!("{stem}_depth.exr"));
    if !file.exists() {
        return Ok(());
    }
    let photo::Photo::Linear(exact) = photo::load_full(&file)? else {
        return Err(DataError::input(&file, "is no EXR of distances; generate the scene again").into());
    };
    if (exact.width, exact.height) != (view.depth.width, view.depth.height) {
        return Ok(());
    }
    let scale = model.model_from_world.scale;
    for (i, pixel) in exact.data.chunks_exact(exact.channels).enumerate().filter(|(_, p)| p[1] > 0.5) {
        out.push((view.depth.data[i] as f64 / (scale * pixel[0] as f64) - 1.0).abs());
    }
    Ok(())
}
