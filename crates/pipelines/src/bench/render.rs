//! `diorama bench render`

use super::median_seconds;
use crate::error::{PipelineError, Result};
use crate::object::evaluate::score_view;
use crate::object::held_out;
use crate::object::model::ObjectModel;
use diorama_data::photo;
use diorama_engine::renderers::volume::Quality;
use diorama_geom::capture::Split;
use serde::Serialize;

/// What one quality reaches over all views.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct QualityFigure {
    pub frames_per_s: f64,
    /// Mean over the held-out views.
    pub psnr: f64,
}

/// Held-out views at both qualities.
#[derive(Clone, Debug, Serialize)]
pub struct RenderReport {
    pub threads: usize,
    pub simd: &'static str,
    /// What draws.
    pub device: String,
    pub views: usize,
    pub width: u32,
    pub height: u32,
    pub full: QualityFigure,
    pub fast: QualityFigure,
}

/// Draws every held-out view `repeats` times at each quality, on what [`super::super::object::device::accelerate`] named.
pub fn run(model: &ObjectModel, repeats: usize, device: String) -> Result<RenderReport> {
    let frames = held_out::frames(&model.capture, Split::Test);
    let Some(&first) = frames.first() else {
        return Err(PipelineError::Usage("the run holds no views out; train with --split every:8".into()));
    };
    let camera = model.posed(first).camera;
    let figure = |quality: Quality| -> Result<QualityFigure> {
        let (mut seconds, mut psnr) = (0.0, 0.0);
        for &i in &frames {
            let (tracer, camera) = (model.tracer(quality), model.posed(i));
            seconds += median_seconds(repeats, || drop(tracer.view(&camera, &mut |_| {})));
            psnr += score_view(model, i, photo::load_full(&model.capture.frames[i].image)?, quality)?.scores.psnr;
        }
        let n = frames.len() as f64;
        Ok(QualityFigure { frames_per_s: n / seconds, psnr: psnr / n })
    };
    Ok(RenderReport {
        threads: rayon::current_num_threads(),
        simd: diorama_kernels::simd::level().name(),
        device,
        views: frames.len(),
        width: camera.width,
        height: camera.height,
        full: figure(Quality::Full)?,
        fast: figure(Quality::Fast)?,
    })
}
