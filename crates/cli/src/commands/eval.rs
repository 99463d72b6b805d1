//! `diorama eval`

use super::{Outcome, note, use_threads};
use crate::arguments::EvalArgs;
use crate::terminal::ShareShown;
use diorama_data::{DataError, photo};
use diorama_geom::ImageU8;
use diorama_geom::capture::Split;
use diorama_pipelines::object::depth_error::DepthError;
use diorama_pipelines::object::evaluate::{EvaluationProgress, ScoredView};
use diorama_pipelines::object::seen_by::{SeenBy, Sights};
use diorama_pipelines::object::{device, evaluate, run_folder};
use diorama_pipelines::run::kept_capture;
use diorama_pipelines::{PipelineError, Result};
use std::cell::RefCell;
use std::path::Path;

pub fn run(a: &EvalArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let split = match &a.on[..] {
        "train" => Split::Train,
        "val" => Split::Val,
        "test" => Split::Test,
        other => return Err(PipelineError::Usage(format!("--on {other}: expected train, val or test"))),
    };
    let quality = a.quality.parse().map_err(|e| PipelineError::Usage(format!("--{e}")))?;
    let lpips = if a.lpips.is_empty() { None } else { Some(evaluate::load_lpips(&a.lpips)?) };
    let (mut model, notes) = run_folder::load_model_of(&a.run, a.data.as_deref())?;
    let no_points = run_folder::add_points(&mut model, &a.run, a.data.as_deref())?;
    notes.iter().chain(&no_points).for_each(|n| note(n));
    kept_capture::require_photographs(&model.capture)?;
    device::accelerate(&mut model, &a.device, Box::new(note))?;
    let folder = a.run.join("eval");
    if a.save_images || a.explain {
        std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
    }
    let shown = RefCell::new(ShareShown::new());
    // Before the training views are drawn.
    evaluate::judged(&model, split)?;
    let sights = a.explain.then(|| {
        let mut told = |done: usize, all: usize| {
            shown.borrow_mut().show(done as f64 / all as f64, &format!("training view {} of {all}: where its rays end", done + 1));
        };
        Sights::of(&model, &mut told)
    });
    shown.borrow().finish();
    shown.replace(ShareShown::new());
    let asked = sights.as_ref().map_or(0, Sights::len);
    let file = |name: &str, what: &str| folder.join(format!("{}{what}.png", name.replace(['/', '\\'], "_")));
    let mut seen_by = Vec::new();
    let mut each = |name: &str, v: &ScoredView| -> Result<()> {
        shown.borrow().line(&format!("{name}: psnr {:.2} ssim {:.3}", v.scores.psnr, v.scores.ssim));
        if a.save_images {
            let (r, p) = (v.view.rgb.to_u8(), v.photo.to_u8());
            let rows = r.data.chunks_exact(r.width * 3).zip(p.data.chunks_exact(p.width * 3));
            let data = rows.flat_map(|(a, b)| [a, b].concat()).collect();
            let both = ImageU8 { width: r.width + p.width, height: r.height, channels: 3, data };
            photo::save_png(&file(name, ""), &both)?;
        }
        if let (Some(sights), Some(frame)) = (&sights, model.capture.frames.iter().position(|f| f.name == name)) {
            let (seen, map) = sights.explain(&model, frame, v);
            photo::save_png(&file(name, ".seen"), &map)?;
            seen_by.push(seen);
        }
        Ok(())
    };
    let mut progress = |p: EvaluationProgress<'_>| {
        let (done, all) = p.views;
        shown.borrow_mut().show(p.share, &format!("view {} of {all} ({}): {}", done + 1, p.view, p.doing.name()));
    };
    let report = evaluate::evaluate_with_training(&model, split, quality, lpips.as_ref(), &mut each, &mut progress);
    shown.borrow().finish();
    let report = report?;
    if a.json {
        let mut object = serde_json::to_value(&report).expect("a report is JSON");
        object["gap"] = serde_json::json!(report.gap());
        object["advice"] = serde_json::json!(report.advice());
        object["depth_advice"] = serde_json::json!(report.depth.as_ref().and_then(DepthError::advice));
        if a.explain {
            object["seen_by"] = serde_json::json!(seen_by);
            object["seen_by_of"] = serde_json::json!(asked);
        }
        println!("{object}");
    } else {
        println!(
            "{} views: psnr {:.2} dB (worst {:.2}, affine {:.2}), ssim {:.4}, mse {:.5}",
            report.views, report.psnr, report.psnr_min, report.psnr_affine, report.ssim, report.mse
        );
        if let (Some(l), Some(network)) = (report.lpips, &lpips) {
            println!("lpips {l:.4} ({})", network.network());
        }
        if let Some(t) = &report.training {
            println!("{} training views: psnr {:.2} dB, ssim {:.4}", t.views, t.psnr, t.ssim);
        }
        report.depth.iter().for_each(|d| println!("{d}"));
        report.depth.iter().filter_map(DepthError::advice).for_each(|a| println!("{a}"));
        report.advice().into_iter().for_each(|a| println!("{a}"));
        if let fog @ [_, ..] = &report.behind_fog()[..] {
            println!("behind fog: {}", fog.join(", "));
        }
        if !seen_by.is_empty() {
            print_seen_by(&seen_by, asked, model.train.len(), &folder);
        }
        if model.is_linear() {
            println!("scored in {}: the photographs hold linear light", report.scored_in);
        }
        if let Some(p) = report.psnr_mean_image {
            println!("the mean training image in place of renders: {p:.2} dB");
        }
    }
    Ok(Outcome::Done)
}

/// Which share of each view's light comes from places that so many training views see, and who sees what few see.
fn print_seen_by(views: &[SeenBy], asked: usize, all: usize, folder: &Path) {
    let of = if asked < all { format!("of {asked} of the {all} training views, those") } else { "training views".into() };
    println!("{of} that see what a view shows, in percent of its light (maps in {}):", folder.display());
    println!("{:>6}{:>6}{:>6}{:>6}{:>6}  psnr where two or more see it", "none", "1", "2", "3", "more");
    for v in views {
        let shares: String = v.shares.iter().map(|s| format!("{:>6.1}", 100.0 * s)).collect();
        let sources: Vec<String> = v.sources.iter().map(|s| format!("{} {:.1}", s.name, 100.0 * s.share)).collect();
        let of_few = if sources.is_empty() { String::new() } else { format!("; what one or two see is of {}", sources.join(", ")) };
        let psnr = v.psnr_where_seen.map_or("-".into(), |p| format!("{p:.2}"));
        println!("{shares}  {psnr:>5}  {}{of_few}", v.name);
    }
    let known: Vec<f64> = views.iter().filter_map(|v| v.psnr_where_seen).collect();
    if !known.is_empty() {
        let (mean, worst) = (known.iter().sum::<f64>() / known.len() as f64, known.iter().copied().fold(f64::INFINITY, f64::min));
        let of = if known.len() < views.len() { format!(", in {} of {} views", known.len(), views.len()) } else { String::new() };
        println!("where two or more training views see it: psnr {mean:.2} dB (worst {worst:.2}{of})");
    }
}
