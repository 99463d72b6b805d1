//! Flies a camera around a trained field and writes the film as an animated GIF.
//!
//! `cargo run --release -p diorama-pipelines --example render_path -- [FOLDER]`

use diorama_data::film::Film;
use diorama_engine::renderers::volume::Quality;
use diorama_geom::Camera;
use diorama_geom::camera_path;
use diorama_geom::glam::DVec3;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::{quickstart, recipe};
use diorama_pipelines::run::RunFolder;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

const FRAMES: usize = 24;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let out = std::env::args().nth(1).map_or_else(|| std::env::temp_dir().join("diorama-render-path"), PathBuf::from);

    let data = out.join("capture");
    quickstart::write_capture(&data, 24, 96)?;
    let mut config = Config::new(Method::Ngp, data);
    (config.run.steps, config.run.seconds) = (150, 0.0);
    (config.field.log2_size, config.field.finest) = (15, 256);
    let mut run = RunFolder::create(&out.join("run"), true)?;
    // A model that was trained before is read with `run_folder::load_model(folder)`.
    let model = recipe::train(&config, &mut run, false, None, &AtomicBool::new(false), &mut |_| {})?.model;

    // One turn about the origin, as high as the training cameras are on average. Poses are in the world: z up.
    let cameras: Vec<_> = model.train.iter().map(|&i| model.capture.frames[i].world_from_camera).collect();
    let path = camera_path::orbit(&cameras, DVec3::ZERO, DVec3::Z, FRAMES);
    let camera = Camera::pinhole(160, 120, 50f64.to_radians());

    // `Quality::Fast` leaves out what is hardly seen. The file's name decides on the format: .gif or .mp4.
    let file = out.join("orbit.gif");
    let mut film = Film::create(&file, 160, 120, 12)?;
    let tracer = model.tracer(Quality::Fast);
    for pose in &path {
        let view = tracer.view(&model.to_model(camera, pose), &mut |_| {});
        film.push(&view.rgb.to_u8())?;
    }
    film.finish()?;
    println!("wrote {FRAMES} frames to {}", file.display());
    Ok(())
}
