//! Full-quality views against exhaustive ones, and what an evaluation tells while it runs.

use diorama_engine::renderers::volume::Quality;
use diorama_geom::capture::Split;
use diorama_pipelines::bench;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::evaluate;
use diorama_pipelines::object::held_out;
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::object::quickstart::write_capture;
use diorama_pipelines::object::recipe;
use diorama_pipelines::object::scored_view::Doing;
use diorama_pipelines::run::RunFolder;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// A short run with held-out views.
fn train(dir: &Path, steps: u64) -> ObjectModel {
    let data = dir.join("data");
    write_capture(&data, 12, 40).unwrap();
    let mut c = Config::new(Method::Ngp, data);
    for (k, v) in [
        ("device", "cpu"),
        ("field.log2_size", "12"),
        ("field.finest", "64"),
        ("sampling.batch_samples", "8192"),
        ("sampling.occupancy_resolution", "32"),
    ] {
        c.set(k, v).unwrap();
    }
    c.run.steps = steps;
    let mut folder = RunFolder::create(&dir.join("run"), true).unwrap();
    recipe::train(&c, &mut folder, false, None, &AtomicBool::new(false), &mut |_| {}).unwrap().model
}

#[test]
fn full_views_score_as_exhaustive_ones_do() {
    let dir = tempfile::tempdir().unwrap();
    let model = train(dir.path(), 150);
    let r = bench::render::run(&model, 1, "cpu".into()).unwrap();
    println!("{r:?}");
    assert!((r.full.psnr - r.exhaustive.psnr).abs() < 0.05, "{r:?}");
    assert!(r.full.psnr_against_exhaustive > 45.0 && r.full.psnr_against_exhaustive < 119.0, "{r:?}");
    assert_eq!(r.exhaustive.psnr_against_exhaustive.round(), 120.0, "compared with itself");
    assert!(r.fast.psnr_against_exhaustive < r.full.psnr_against_exhaustive, "{r:?}");
    assert!([r.exhaustive, r.full, r.fast].iter().all(|q| q.frames_per_s > 0.0 && q.psnr > 10.0), "{r:?}");
}

#[test]
fn full_views_are_drawn_faster_than_exhaustive_ones() {
    let dir = tempfile::tempdir().unwrap();
    let model = train(dir.path(), 400);
    let r = bench::render::run(&model, 5, "cpu".into()).unwrap();
    println!("{r:?}");
    assert!([r.full, r.fast].iter().all(|q| q.frames_per_s > 2.0 * r.exhaustive.frames_per_s), "{r:?}");
}

#[test]
fn an_evaluation_tells_how_far_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let model = train(dir.path(), 4);
    let (mut told, mut done) = (Vec::new(), Vec::new());
    let report = evaluate::evaluate_with_training(
        &model,
        Split::Test,
        Quality::Full,
        None,
        &mut |name, _| {
            done.push(name.to_string());
            Ok(())
        },
        &mut |p| told.push((p.share, p.views, p.view.to_string(), p.doing)),
    )
    .unwrap();
    let held_out = held_out::frames(&model.capture, Split::Test).len();
    let all = held_out + report.training.as_ref().unwrap().views;
    assert!(held_out > 1 && done.len() == held_out && report.views == held_out);
    assert!(told.iter().all(|t| t.1.1 == all && t.1.0 < all), "{told:?}");
    assert!(told[0].0 == 0.0 && told.last().unwrap().0 < 1.0 && told.last().unwrap().0 > 1.0 - 0.2 / all as f64, "{told:?}");
    assert!(told.windows(2).all(|w| w[0].0 <= w[1].0), "never backwards: {told:?}");
    for k in 0..all {
        let of: Vec<_> = told.iter().filter(|t| t.1.0 == k).collect();
        assert!(of.iter().all(|t| t.2 == of[0].2) && (k >= held_out || of[0].2 == done[k]), "one view at a time: {of:?}");
        assert!(of.iter().filter(|t| t.3 == Doing::Drawing).count() >= 2 && of.last().unwrap().3 == Doing::Scoring, "{of:?}");
    }
}
