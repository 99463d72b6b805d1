//! Scores on held-out views: full images, in the photographs' own distorted pixels.

use super::depth_error::{self, DepthError};
use super::fog::{self, Surfaces};
use super::held_out::{self, GAP_DB, GAP_MEANS};
use super::model::ObjectModel;
use super::scored_view::{Doing, ScoredView, admits, reference, score_view, where_it_counts};
use crate::error::{PipelineError, Result};
use diorama_data::photo;
use diorama_engine::metrics::lpips::Lpips;
use diorama_engine::metrics::{self, ImageScores};
use diorama_engine::renderers::volume::Quality;
use diorama_geom::Image;
use diorama_geom::capture::Split;
use serde::Serialize;

/// Scores of one view.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewScore {
    pub name: String,
    pub psnr: f64,
    pub ssim: f64,
    pub mse: f64,
    pub psnr_affine: f64,
    /// Perceptual distance, where weights for it were given.
    pub lpips: Option<f64>,
    /// Whether the view lies behind fog ([`super::fog`]); false where that is not asked.
    pub behind_fog: bool,
}

/// Training views, for comparison.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrainingScores {
    pub views: usize,
    pub psnr: f64,
    pub ssim: f64,
}

/// Most training views that are judged beside held-out ones.
const TRAINING_VIEWS: usize = 8;

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
    /// Perceptual distance over whole pictures; its weights are the user's.
    pub lpips: Option<f64>,
    /// How far surfaces are from sparse points, where held-out views show enough of them.
    pub depth: Option<DepthError>,
    /// Some training views, where they were asked for.
    pub training: Option<TrainingScores>,
    /// What drew the views.
    pub device: String,
    /// The space in which views and photographs are compared.
    pub scored_in: &'static str,
    pub per_view: Vec<ViewScore>,
}

impl Report {
    /// How far held-out views are below training views, in dB.
    pub fn gap(&self) -> Option<f64> {
        self.training.as_ref().map(|t| t.psnr - self.psnr)
    }

    /// What a gap that is too large means, and what helps.
    pub fn advice(&self) -> Option<String> {
        let gap = self.gap().filter(|g| *g > GAP_DB)?;
        Some(format!("held-out views are {gap:.1} dB below training views: {GAP_MEANS}"))
    }

    /// Names of the views behind fog.
    pub fn behind_fog(&self) -> Vec<&str> {
        self.per_view.iter().filter(|v| v.behind_fog).map(|v| &v.name[..]).collect()
    }
}

/// How far an evaluation is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EvaluationProgress<'a> {
    /// Share of the work that is done, in [0, 1].
    pub share: f64,
    /// Views that are done, and all of them, training views included.
    pub views: (usize, usize),
    pub view: &'a str,
    pub doing: Doing,
}

/// Share of a view's time that drawing takes, and that scores take, where a perceptual distance follows and where not.
const SHARES: [(f64, f64); 2] = [(0.5, 0.1), (0.9, 0.1)];

/// Views that are done, and all of them.
struct Count<'a> {
    done: usize,
    all: usize,
    report: &'a mut dyn FnMut(EvaluationProgress),
}

impl Count<'_> {
    /// Tells how far the view in hand is; without a perceptual distance it is done after its scores.
    fn tell(&mut self, view: &str, part: f64, doing: Doing, with_distance: bool) {
        let (drawing, scoring) = SHARES[!with_distance as usize];
        let within = match doing {
            Doing::Drawing => part * drawing,
            Doing::Scoring => drawing,
            Doing::PerceptualDistance => drawing + scoring,
        };
        let share = (self.done as f64 + within) / self.all.max(1) as f64;
        (self.report)(EvaluationProgress { share, views: (self.done, self.all), view, doing });
    }
}

/// Training views that are judged beside so many held-out ones.
fn training_views(model: &ObjectModel, split: Split, held_out: usize) -> Vec<usize> {
    if split == Split::Train { Vec::new() } else { held_out::spread(&model.train, TRAINING_VIEWS.min(held_out)) }
}

/// Scores all views of a split, and some training views beside them; tells which lie behind fog. `each` sees every view of
/// the split as it is done, and `progress` how far all is.
pub fn evaluate_with_training(
    model: &ObjectModel,
    split: Split,
    quality: Quality,
    lpips: Option<&Lpips>,
    each: &mut dyn FnMut(&str, &ScoredView) -> Result<()>,
    progress: &mut dyn FnMut(EvaluationProgress),
) -> Result<Report> {
    let held_out = held_out::frames(&model.capture, split).len();
    let beside = training_views(model, split, held_out);
    let mut count = Count { done: 0, all: held_out + beside.len(), report: progress };
    let mut report = evaluate_counted(model, split, quality, lpips, each, &mut count)?;
    if split == Split::Train {
        return Ok(report);
    }
    let mut scores = Vec::new();
    for i in beside {
        let frame = &model.capture.frames[i];
        let full = photo::load_full(&frame.image)?;
        scores.push(score_view(model, i, full, quality, &mut |part, doing| count.tell(&frame.name, part, doing, false))?.scores);
        count.done += 1;
    }
    let mean = |f: fn(&ImageScores) -> f64| mean_of_numbers(scores.iter().map(f));
    let training = TrainingScores { views: scores.len(), psnr: mean(|s| s.psnr), ssim: mean(|s| s.ssim) };
    let middle = fog::median(scores.iter().map(|s| s.psnr).filter(|p| !p.is_nan()).collect()).unwrap_or(training.psnr);
    let mut surfaces = None;
    for (v, i) in report.per_view.iter_mut().zip(held_out::frames(&model.capture, split)) {
        // Depth is asked only where scores alone do not tell.
        let near = fog::depends_on_depth(v.psnr, middle)
            .then(|| surfaces.get_or_insert_with(|| Surfaces::of(model)).near_share(model, i))
            .flatten();
        v.behind_fog = fog::is_behind(v.psnr, middle, near);
    }
    model.check_device()?;
    report.training = Some(training);
    Ok(report)
}

/// Scores all views of a split; `each` sees every view as it is done.
pub fn evaluate(
    model: &ObjectModel,
    split: Split,
    quality: Quality,
    each: &mut dyn FnMut(&str, &ScoredView) -> Result<()>,
) -> Result<Report> {
    let all = held_out::frames(&model.capture, split).len();
    evaluate_counted(model, split, quality, None, each, &mut Count { done: 0, all, report: &mut |_| {} })
}

/// Frames of a split.
///
/// # Errors
/// When there are none.
pub fn judged(model: &ObjectModel, split: Split) -> Result<Vec<usize>> {
    match held_out::frames(&model.capture, split) {
        none if none.is_empty() => {
            Err(PipelineError::Usage("the run holds no views out; train with --split every:8 or judge --on train".into()))
        }
        frames => Ok(frames),
    }
}

/// [`evaluate`], with the perceptual distance where `lpips` is given.
fn evaluate_counted(
    model: &ObjectModel,
    split: Split,
    quality: Quality,
    lpips: Option<&Lpips>,
    each: &mut dyn FnMut(&str, &ScoredView) -> Result<()>,
    count: &mut Count,
) -> Result<Report> {
    let frames = judged(model, split)?;
    let mean = mean_image(model)?;
    let (mut per_view, mut mean_scores, mut depth_errors) = (Vec::new(), Vec::new(), Vec::new());
    for i in frames {
        let frame = &model.capture.frames[i];
        let full = photo::load_full(&frame.image)?;
        let scored = score_view(model, i, full, quality, &mut |part, doing| count.tell(&frame.name, part, doing, lpips.is_some()))?;
        if let Some(mean) = mean.as_ref().filter(|m| (m.width, m.height) == (scored.photo.width, scored.photo.height)) {
            mean_scores.push(metrics::compare(mean, &scored.photo, admits(&scored.counts)).psnr);
        }
        depth_errors.extend(depth_error::errors(model, i, &scored));
        each(&frame.name, &scored)?;
        let s = scored.scores;
        let too_small = |e: String| PipelineError::Usage(format!("{}: {e}", frame.name));
        if lpips.is_some() {
            count.tell(&frame.name, 1.0, Doing::PerceptualDistance, true);
        }
        let distance = lpips.map(|l| l.distance(&where_it_counts(&scored), &scored.photo)).transpose().map_err(too_small)?;
        per_view.push(ViewScore {
            name: frame.name.clone(),
            psnr: s.psnr,
            ssim: s.ssim,
            mse: s.mse,
            psnr_affine: s.psnr_affine,
            lpips: distance.filter(|_| !s.psnr.is_nan()),
            behind_fog: false,
        });
        count.done += 1;
    }
    // Views in which no pixel counts say nothing.
    let average = |f: fn(&ViewScore) -> f64| mean_of_numbers(per_view.iter().map(f));
    Ok(Report {
        views: per_view.len(),
        psnr: average(|v| v.psnr),
        ssim: average(|v| v.ssim),
        mse: average(|v| v.mse),
        psnr_min: per_view.iter().map(|v| v.psnr).fold(f64::INFINITY, f64::min),
        psnr_affine: average(|v| v.psnr_affine),
        psnr_mean_image: (!mean_scores.is_empty()).then(|| mean_of_numbers(mean_scores.into_iter())),
        lpips: lpips.map(|_| mean_of_numbers(per_view.iter().filter_map(|v| v.lpips))),
        depth: DepthError::of(depth_errors),
        training: None,
        device: model.drew_on(),
        scored_in: if model.is_linear() { "sRGB, of linear light up to white" } else { "sRGB" },
        per_view,
    })
}

fn mean_of_numbers(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.filter(|v| !v.is_nan()).fold((0.0, 0), |(sum, n), v| (sum + v, n + 1));
    sum / n as f64
}

/// Mean of up to 24 training photographs, where all are of one size.
fn mean_image(model: &ObjectModel) -> Result<Option<Image>> {
    let step = model.train.len().div_ceil(24).max(1);
    let mut sum: Option<Image> = None;
    let mut n = 0.0;
    for &i in model.train.iter().step_by(step) {
        let (im, _) = reference(model, i, photo::load_full(&model.capture.frames[i].image)?)?;
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
