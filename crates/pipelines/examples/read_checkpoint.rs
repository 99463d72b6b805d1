//! Reads a checkpoint: what it holds as named tensors, then the model that it belongs to, asked for density and color.
//!
//! `cargo run --release -p diorama-pipelines --example read_checkpoint -- [RUN]`, where RUN is a run folder; where there is none yet,
//! a short run is trained into it.

use diorama_geom::field_query::FieldQuery;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::{quickstart, recipe, run_folder};
use diorama_pipelines::run::{RunFolder, folder};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let run = std::env::args().nth(1).map_or_else(|| std::env::temp_dir().join("diorama-read-checkpoint"), PathBuf::from);
    if !run.join("config.toml").exists() {
        train(&run)?;
    }

    // Checkpoints are safetensors files: any reader of that format opens them.
    let (checkpoint, file, note) = folder::last_checkpoint(&run)?;
    println!("{}", file.display());
    note.into_iter().for_each(|n| println!("note: {n}"));
    for key in ["version", "method", "step", "rays"] {
        println!("{key:>28}  {}", checkpoint.metadata.get(key).map_or("-", |v| v));
    }
    for (name, shape, values) in &checkpoint.tensors {
        let largest = values.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        println!("{name:>28}  {shape:?}, at most {largest:.3e}");
    }

    // The run's configuration and capture say how these numbers become a field.
    let (model, _) = run_folder::load_model(&run)?;
    let points_in_world = [[0.0, 0.0, -0.4], [0.0, 0.0, 0.9]];
    let (mut sigma, mut rgb) = ([0.0; 2], [[0.0; 3]; 2]);
    model.density(&points_in_world, &mut sigma);
    model.color(&points_in_world, &[[0.0, 0.0, -1.0]; 2], &mut rgb);
    for ((p, sigma), rgb) in points_in_world.iter().zip(sigma).zip(rgb) {
        println!("at {p:?}: density {sigma:.2} per world unit, color {rgb:.2?} from above");
    }
    Ok(())
}

fn train(run: &Path) -> Result<(), Box<dyn std::error::Error>> {
    let data = run.with_extension("capture");
    quickstart::write_capture(&data, 16, 64)?;
    let mut config = Config::new(Method::Ngp, data);
    (config.run.steps, config.run.seconds) = (100, 0.0);
    (config.field.log2_size, config.field.finest) = (14, 128);
    recipe::train(&config, &mut RunFolder::create(run, true)?, false, None, &AtomicBool::new(false), &mut |_| {})?;
    Ok(())
}
