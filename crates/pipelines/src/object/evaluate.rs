//! Scores on held-out views: full images, in the photographs' own distorted pixels.

use super::model::ObjectModel;
use crate::error::{PipelineError, Result};
use diorama_data::photo::{self, Photo};
use diorama_engine::losses;
use diorama_engine::metrics::{self, Scores};
use diorama_engine::renderers::volume::{Quality, View};
use diorama_geom::capture::Split;
use diorama_geom::{Capture, Image};
use serde::Serialize;

/// Frames of a split; held-out ones fall back to validation where there is no test split.
pub fn held_out(capture: &Capture, split: Split) -> Vec<usize> {
    let frames = capture.indices(split);
    if frames.is_empty() && split == Split::Test { capture.indices(Split::Val) } else { frames }
}

/// One view's render and scores.
pub struct ScoredView {
    pub view: View,
    pub photo: Image,
    pub scores: Scores,
}

/// Scores of one view.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewScore {
    pub name: String,
    pub psnr: f64,
    pub ssim: f64,
    pub mse: f64,
    pub psnr_affine: f64,
}

/// Means over all views.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    pub views: usize,
    pub psnr: f64,
    pub ssim: f64,
    pub mse: f64,
    pub psnr_min: f64,
    /// PSNR after the best affine map per channel and view.
    pub psnr_affine: f64,
    /// PSNR of the mean training photograph in place of a render: what knowing nothing gives.
    pub psnr_mean_image: Option<f64>,
    /// Needs weights that are not part of this program.
    pub lpips: Option<f64>,
    /// The space in which views and photographs are compared.
    pub scored_in: &'static str,
    pub per_view: Vec<ViewScore>,
}

/// A photograph at the run's resolution, transparent pixels on the model's backdrop: sRGB up to white.
pub fn reference_photo(model: &ObjectModel, full: &Photo) -> Image {
    let d = model.config.data.downscale as usize;
    let (w, h) = full.size();
    let small = full.downsampled((w / d).max(1), (h / d).max(1));
    // What a field of linear light was trained on is blended there, too.
    let (small, is_linear) = match small {
        Photo::Linear(mut im) if model.is_linear() => {
            let white = model.config.data.white;
            im.data.chunks_exact_mut(im.channels).for_each(|p| p.iter_mut().take(3).for_each(|v| *v /= white));
            (im, true)
        }
        other => (other.into_srgb(), false),
    };
    let back = model.backdrop_color();
    let mut out = Image::zeros(small.width, small.height, 3);
    for (o, p) in out.data.chunks_exact_mut(3).zip(small.data.chunks_exact(small.channels)) {
        let a = if small.channels == 4 { p[3] } else { 1.0 };
        for k in 0..3 {
            let v = p[k.min(small.channels - 1)] * a + back[k] * (1.0 - a);
            o[k] = if is_linear { losses::shown(v) } else { v.clamp(0.0, 1.0) };
        }
    }
    out
}

/// Renders frame `i` and scores it against `full`, its photograph at full size.
pub fn score_view(model: &ObjectModel, i: usize, full: &Photo, quality: Quality) -> ScoredView {
    let photo = reference_photo(model, full);
    let view = model.tracer(quality).view(&model.posed(i), &mut |_| {});
    let mask =
        model.capture.frames[i].mask.as_ref().and_then(|m| photo::load_mask(m).ok()).map(|m| m.downsampled(photo.width, photo.height));
    let mut shown = view.rgb.clone();
    shown.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    let scores = metrics::compare(&shown, &photo, |x, y| mask.as_ref().is_none_or(|m| m.pixel(x, y)[0] >= 128));
    ScoredView { view, photo, scores }
}

/// Scores all views of a split; `each` sees every view as it is done.
pub fn evaluate(
    model: &ObjectModel,
    split: Split,
    quality: Quality,
    each: &mut dyn FnMut(&str, &ScoredView) -> Result<()>,
) -> Result<Report> {
    let frames = held_out(&model.capture, split);
    if frames.is_empty() {
        return Err(PipelineError::Usage("the run holds no views out; train with --split every:8 or judge --on train".into()));
    }
    let mean = mean_image(model)?;
    let (mut per_view, mut mean_scores) = (Vec::new(), Vec::new());
    for i in frames {
        let frame = &model.capture.frames[i];
        let full = photo::load_full(&frame.image)?;
        let scored = score_view(model, i, &full, quality);
        if let Some(mean) = mean.as_ref().filter(|m| (m.width, m.height) == (scored.photo.width, scored.photo.height)) {
            mean_scores.push(metrics::compare(mean, &scored.photo, |_, _| true).psnr);
        }
        each(&frame.name, &scored)?;
        let s = scored.scores;
        per_view.push(ViewScore { name: frame.name.clone(), psnr: s.psnr, ssim: s.ssim, mse: s.mse, psnr_affine: s.psnr_affine });
    }
    let n = per_view.len() as f64;
    let average = |f: fn(&ViewScore) -> f64| per_view.iter().map(f).sum::<f64>() / n;
    Ok(Report {
        views: per_view.len(),
        psnr: average(|v| v.psnr),
        ssim: average(|v| v.ssim),
        mse: average(|v| v.mse),
        psnr_min: per_view.iter().map(|v| v.psnr).fold(f64::INFINITY, f64::min),
        psnr_affine: average(|v| v.psnr_affine),
        psnr_mean_image: (!mean_scores.is_empty()).then(|| mean_scores.iter().sum::<f64>() / mean_scores.len() as f64),
        lpips: None,
        scored_in: if model.is_linear() { "sRGB, of linear light up to white" } else { "sRGB" },
        per_view,
    })
}

/// Mean of up to 24 training photographs, where all are of one size.
fn mean_image(model: &ObjectModel) -> Result<Option<Image>> {
    let step = model.train.len().div_ceil(24).max(1);
    let mut sum: Option<Image> = None;
    let mut n = 0.0;
    for &i in model.train.iter().step_by(step) {
        let im = reference_photo(model, &photo::load_full(&model.capture.frames[i].image)?);
        n += 1.0;
        match &mut sum {
            None => sum = Some(im),
            Some(s) if (s.width, s.height) == (im.width, im.height) => s.data.iter_mut().zip(&im.data).for_each(|(a, b)| *a += b),
            Some(_) => return Ok(None),
        }
    }
    Ok(sum.map(|mut s| {
        s.data.iter_mut().for_each(|v| *v /= n);
        s
    }))
}
