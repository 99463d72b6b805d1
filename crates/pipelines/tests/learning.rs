//! A bounded capture before a flat background is learned: its matter survives the pruning of the first steps.

use diorama_engine::renderers::volume::Quality;
use diorama_geom::capture::Split;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::quickstart::write_capture;
use diorama_pipelines::object::{evaluate, recipe};
use diorama_pipelines::run::RunFolder;
use std::sync::atomic::AtomicBool;

/// Held-out PSNR after `steps`.
fn score(steps: u64) -> (f64, f64) {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    write_capture(&data, 24, 64).unwrap();
    let mut c = Config::new(Method::Ngp, data);
    for (k, v) in [
        ("device", "cpu"),
        ("field.log2_size", "14"),
        ("field.finest", "128"),
        ("sampling.batch_samples", "16384"),
        ("sampling.occupancy_resolution", "64"),
    ] {
        c.set(k, v).unwrap();
    }
    c.run.steps = steps;
    let mut folder = RunFolder::create(&dir.path().join("run"), true).unwrap();
    let recipe::Trained { model, .. } = recipe::train(&c, &mut folder, false, None, &AtomicBool::new(false), &mut |_| {}).unwrap();
    assert!(model.samples > 0);
    let scores = evaluate::evaluate(&model, Split::Test, Quality::Full, &mut |_, _| Ok(())).unwrap();
    (scores.psnr, scores.psnr_mean_image.unwrap())
}

#[test]
fn more_steps_teach_more_than_the_mean_image_knows() {
    let ((few, mean), (many, _)) = (score(60), score(400));
    println!("mean image {mean:.2} dB, 60 steps {few:.2} dB, 400 steps {many:.2} dB");
    assert!(few > mean, "{few} dB after 60 steps, {mean} dB for the mean image");
    assert!(many > few + 2.0 && many > 20.0, "{many} dB after 400 steps, {few} after 60");
}
