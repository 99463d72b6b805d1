//! Trains a field on a capture, scores it on views that training never saw, and saves one of them.
//!
//! `cargo run --release -p diorama-pipelines --example train_from_code -- [FOLDER]`

use diorama_data::photo;
use diorama_engine::renderers::volume::Quality;
use diorama_engine::train::Event;
use diorama_geom::capture::Split;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::{evaluate, quickstart, recipe};
use diorama_pipelines::run::RunFolder;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let out = std::env::args().nth(1).map_or_else(|| std::env::temp_dir().join("diorama-train-from-code"), PathBuf::from);

    // A generated capture; any folder that `diorama train` reads will do.
    let data = out.join("capture");
    quickstart::write_capture(&data, 24, 96)?;

    // Every key of `config.toml` is a field of this struct.
    let mut config = Config::new(Method::Ngp, data);
    (config.run.steps, config.run.seconds) = (150, 0.0);
    (config.field.log2_size, config.field.finest) = (15, 256);

    // Setting the flag would stop the training cleanly.
    let stop = AtomicBool::new(false);
    let mut run = RunFolder::create(&out.join("run"), true)?;
    let trained = recipe::train(&config, &mut run, false, None, &stop, &mut |event| {
        if let Event::Progress { step, scalars, .. } = event {
            println!("step {step}: {:.1} dB on training rays", scalars.get("psnr").unwrap_or(f64::NAN));
        }
    })?;
    let model = trained.model;

    let report = evaluate::evaluate(&model, Split::Test, Quality::Full, &mut |_, _| Ok(()))?;
    println!("{:.1} dB, SSIM {:.3} on {} held-out views", report.psnr, report.ssim, report.views);

    let held_out = model.capture.indices(Split::Test)[0];
    let view = model.tracer(Quality::Full).view(&model.posed(held_out), &mut |_| {});
    let file = out.join("view.png");
    photo::save_png(&file, &view.rgb.to_u8())?;
    println!("wrote {} and the run {}", file.display(), run.path().display());
    Ok(())
}
