//! `diorama bench path-trace`

use super::median_seconds;
use crate::error::Result;
use crate::relight::light::{LightOptions, Source, require_file};
use crate::relight::synth::{Place, SynthOptions};
use crate::relight::{compose, scene_file, turntable};
use diorama_data::{DataError, model_file, photo};
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Image};
use diorama_kernels::ops::path_trace::{Film, Scene, Settings, View, cpu};
use diorama_kernels::simd;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// The light of models and of the generated street: a clear sky, and the strength that exposes it.
const SKY: (f64, f64, f64) = (35.0, 140.0, 0.02);

/// How a scene is measured.
#[derive(Clone, Debug)]
pub struct PathTraceOptions {
    /// None: that of the composition, else 640 × 360.
    pub size: Option<(u32, u32)>,
    /// Samples per pixel of each run.
    pub samples: u32,
    pub repeats: usize,
    /// Where the picture of the last run goes (.exr, linear light).
    pub save: Option<PathBuf>,
}

/// Speed of the path tracer on one scene.
#[derive(Clone, Debug, Serialize)]
pub struct PathTraceReport {
    pub scene: String,
    pub triangles: usize,
    pub size: [u32; 2],
    /// Samples per pixel.
    pub spp: u32,
    pub threads: usize,
    pub simd: &'static str,
    /// Median of the runs.
    pub seconds: f64,
    pub samples_per_s: f64,
    /// Of all kinds: from the camera, between surfaces, and toward the light.
    pub rays_per_s: f64,
}

struct Subject {
    name: String,
    scene: Scene,
    view: View,
    settings: Settings,
}

/// Renders a model, a composition (.toml), or without either the generated street, `repeats` times.
///
/// # Errors
/// When a file is missing or wrong, or the picture cannot be written.
pub fn run(input: Option<&Path>, options: &PathTraceOptions) -> Result<PathTraceReport> {
    let size = options.size.unwrap_or((640, 360));
    let Subject { name, scene, view, settings } = match input {
        None => street(size)?,
        Some(path) if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("toml")) => composition(path, options.size)?,
        Some(path) => model(path, size)?,
    };
    let (mut film, mut rays, mut seed) = (Film::new(&view.camera), 0, 0);
    let seconds = median_seconds(options.repeats, || {
        film = Film::new(&view.camera);
        rays = cpu::render(&scene, &view, &Settings { seed, ..settings }, options.samples, &mut film);
        seed += 1;
    });
    if let Some(path) = &options.save {
        photo::save_exr(path, &color(&film))?;
    }
    let samples = film.pixels.len() as f64 * options.samples as f64;
    Ok(PathTraceReport {
        scene: name,
        triangles: scene.triangles(),
        size: [view.camera.width, view.camera.height],
        spp: options.samples,
        threads: rayon::current_num_threads(),
        simd: simd::level().name(),
        seconds,
        samples_per_s: samples / seconds,
        rays_per_s: rays as f64 / seconds,
    })
}

fn color(film: &Film) -> Image {
    film.image(|p| p.color)
}

fn sky() -> Result<diorama_geom::daylight::Daylight> {
    let (elevation, rotation, strength) = SKY;
    Ok(LightOptions { strength, ..LightOptions::of(Source::Sky { elevation, rotation }) }.read()?.0)
}

fn street(size: (u32, u32)) -> Result<Subject> {
    let place = Place::street(&SynthOptions { size, ..SynthOptions::named("ci")? });
    let (camera, world_from_camera) = (place.viewpoints[0].camera, place.viewpoints[0].pose);
    let view = View { camera, world_from_camera, lens: None };
    Ok(Subject { name: "street".into(), scene: Scene::new(&place.model, &sky()?), view, settings: Settings::default() })
}

fn model(path: &Path, (width, height): (u32, u32)) -> Result<Subject> {
    require_file(path, "model")?;
    let model = model_file::read(path)?.model;
    let Some((low, high)) = model.bounds() else { return Err(DataError::input(path, "holds no triangles").into()) };
    let camera = Camera::pinhole(width, height, 35f64.to_radians());
    let world_from_camera = turntable::orbit(&camera, [DVec3::from(low), DVec3::from(high)], 20f64.to_radians(), 0.5);
    let view = View { camera, world_from_camera, lens: None };
    Ok(Subject { name: path.display().to_string(), scene: Scene::new(&model, &sky()?), view, settings: Settings::default() })
}

fn composition(path: &Path, size: Option<(u32, u32)>) -> Result<Subject> {
    let mut file = scene_file::read(path)?;
    size.iter().for_each(|(w, h)| file.render.size = Some([*w, *h]));
    let compose::Composition { scene, view, settings, .. } = compose::load(&file)?;
    Ok(Subject { name: path.display().to_string(), scene, view, settings })
}
