//! `diorama bench render`

use super::alternating_seconds;
use crate::error::{PipelineError, Result};
use crate::object::held_out;
use crate::object::model::ObjectModel;
use crate::object::scored_view::{reference, scores};
use diorama_data::photo;
use diorama_engine::fields::Pruning;
use diorama_engine::metrics;
use diorama_engine::renderers::volume::{Quality, Tracer, View};
use diorama_geom::capture::Split;
use serde::Serialize;

/// Nothing but what next to no light reaches is left out.
const EXHAUSTIVE: Pruning = Pruning { stop: 1e-4, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 };

/// Speed and scores of one quality over all views.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct QualityFigure {
    pub frames_per_s: f64,
    /// Mean over the held-out views, against their photographs.
    pub psnr: f64,
    /// Mean over the held-out views, against the exhaustive ones; at most 120.
    pub psnr_against_exhaustive: f64,
}

/// Held-out views at every quality.
#[derive(Clone, Debug, Serialize)]
pub struct RenderReport {
    pub threads: usize,
    pub simd: &'static str,
    /// Device that renders.
    pub device: String,
    pub views: usize,
    pub width: u32,
    pub height: u32,
    /// Every sample that light reaches is evaluated on its own.
    pub exhaustive: QualityFigure,
    pub full: QualityFigure,
    pub fast: QualityFigure,
}

/// Draws every held-out view `repeats` times at each quality, the qualities in turns view by view, on what
/// [`super::super::object::device::accelerate`] named.
pub fn run(model: &ObjectModel, repeats: usize, device: String) -> Result<RenderReport> {
    let frames = held_out::frames(&model.capture, Split::Test);
    let Some(&first) = frames.first() else {
        return Err(PipelineError::Usage("the run holds no views out; train with --split every:8".into()));
    };
    let camera = model.posed(first).camera;
    let full = model.tracer(Quality::Full);
    let exhaustive = Tracer { shared_weight: 0.0, placement: full.placement.with_pruning(EXHAUSTIVE), ..full };
    let tracers = [exhaustive, full, model.tracer(Quality::Fast)];
    let mut sums = [QualityFigure::default(); 3];
    let mut seconds = [0.0; 3];
    for &i in &frames {
        let (photo, counts) = reference(model, i, photo::load_full(&model.capture.frames[i].image)?)?;
        let posed = model.posed(i);
        let mut views = tracers.each_ref().map(|_| None);
        let took: [f64; 3] = alternating_seconds(repeats, |k| views[k] = Some(tracers[k].view(&posed, &mut |_| {})));
        let views = views.map(|v: Option<View>| v.expect("a view was drawn"));
        for (k, (view, sum)) in views.iter().zip(&mut sums).enumerate() {
            seconds[k] += took[k];
            sum.psnr += scores(view, &photo, &counts).psnr;
            let squares: f64 = view.rgb.data.iter().zip(&views[0].rgb.data).map(|(a, b)| ((a - b) as f64).powi(2)).sum();
            sum.psnr_against_exhaustive += metrics::psnr(squares / view.rgb.data.len() as f64);
        }
    }
    model.check_device()?;
    let n = frames.len() as f64;
    let mean = |k: usize| QualityFigure {
        frames_per_s: n / seconds[k],
        psnr: sums[k].psnr / n,
        psnr_against_exhaustive: sums[k].psnr_against_exhaustive / n,
    };
    Ok(RenderReport {
        threads: rayon::current_num_threads(),
        simd: diorama_kernels::simd::level().name(),
        device,
        views: frames.len(),
        width: camera.width,
        height: camera.height,
        exhaustive: mean(0),
        full: mean(1),
        fast: mean(2),
    })
}
