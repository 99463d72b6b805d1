//! Generated photographs of an object: path-traced views from all sides under one environment, with exact base color and shape, and the
//! held-out views under an environment that no photograph of training has.

use super::truth::{ObjectTruth, ViewTruth};
use crate::error::{PipelineError, Result};
use crate::relight::light::LightOptions;
use crate::relight::picture;
use diorama_data::gltf::{self, WriteOptions};
use diorama_data::{DataError, atomic, environment, model_file, photo};
use diorama_geom::daylight::Daylight;
use diorama_geom::environment::Environment;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Model, Pose};
use diorama_kernels::ops::denoise;
use diorama_kernels::ops::path_trace::{Film, Scene, Settings, View, cpu};
use diorama_scenes::{chair, still_life_model};
use serde_json::json;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

/// Horizontal field of view in radians, and the share of the picture that the object's bounding sphere fills.
const FOV: f64 = 0.6;
const FILLED: f64 = 0.92;
/// Every so many views, one is held out.
const HOLD_OUT: usize = 8;
/// Bounces of light.
const BOUNCES: u32 = 6;
/// Rows of a map that a sun is drawn into.
const SUN_ROWS: usize = 512;

/// Views that are metered, and the share of their pixels that one exposure of all leaves clipped: a color that is clipped is unknown.
const METERED: usize = 12;
const CLIPPED: f64 = 0.02;

/// What is generated.
#[derive(Clone, Debug)]
pub struct ObjectSynth {
    /// `chair`, `still-life`, or a file of a model.
    pub object: String,
    pub views: usize,
    pub size: (u32, u32),
    /// Samples per pixel.
    pub samples: u32,
    pub light: LightOptions,
    pub unseen: LightOptions,
    /// The photographs are opaque and show the light behind the object.
    pub shows_light: bool,
    pub seed: u64,
}

/// What was generated.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ObjectSynthesized {
    pub photographs: usize,
    pub held_out: usize,
    pub triangles: usize,
    pub interrupted: bool,
    /// What was mended in files or is missing there.
    pub notes: Vec<String>,
}

impl ObjectSynth {
    /// The model, and notes about what its file lacks.
    fn model(&self) -> Result<(Model, Vec<String>)> {
        match self.object.as_str() {
            "chair" => Ok((chair::model(self.seed), Vec::new())),
            "still-life" => Ok((still_life_model::model(), Vec::new())),
            file => {
                let path = Path::new(file);
                if !path.is_file() {
                    return Err(
                        DataError::input(path, "there is no such model; give chair, still-life, or a .glb, .gltf or .obj file").into()
                    );
                }
                let read = model_file::read(path)?;
                Ok((read.model, read.notes))
            }
        }
    }
}

/// Generates into a folder. `progress` gets the share that is done.
///
/// # Errors
/// When the folder exists and is not replaced by `force`, the object or a light cannot be read, or a file cannot be written.
pub fn generate(
    out: &Path,
    options: &ObjectSynth,
    force: bool,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(f64),
) -> Result<ObjectSynthesized> {
    if out.join("transforms_train.json").exists() && !force {
        return Err(PipelineError::Usage(format!("{}: holds a capture; give --force to replace it", out.display())));
    }
    if options.views < HOLD_OUT || options.samples == 0 {
        return Err(PipelineError::Usage(format!("an object needs at least {HOLD_OUT} views and one sample per pixel")));
    }
    let (model, more_notes) = options.model()?;
    let Some((low, high)) = model.bounds().map(|(l, h)| (DVec3::from(l), DVec3::from(h))) else {
        return Err(DataError::input(Path::new(&options.object), "holds no triangles").into());
    };
    let (mut notes, mut lights) = (Vec::new(), Vec::new());
    for of in [&options.light, &options.unseen] {
        let (light, more) = of.read()?;
        lights.push(light);
        notes.extend(more);
    }
    notes.extend(more_notes);
    for folder in ["images", "truth"] {
        let folder = out.join(folder);
        std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
    }
    let cameras = cameras(options, 0.5 * (low + high), 0.5 * (high - low).length());
    let mut scene = Scene::new(&model, &lights[0]);
    let lights: Vec<_> = lights.into_iter().map(|l| exposed(&mut scene, l, &cameras)).collect();
    let mut made = ObjectSynthesized { photographs: 0, held_out: 0, triangles: model.face_count(), interrupted: false, notes };
    let (mut frames, mut views) = ([Vec::new(), Vec::new()], Vec::new());
    for (v, (camera, pose)) in cameras.iter().enumerate() {
        let (name, is_held_out) = (format!("{v:03}"), v % HOLD_OUT == HOLD_OUT - 1);
        let view = View { camera: *camera, world_from_camera: *pose, lens: None };
        scene.set_light(&lights[0]);
        let film = traced(&scene, &view, options, (v as u64, options.shows_light));
        save(&out.join("images").join(format!("{name}.png")), &film, options.shows_light)?;
        if is_held_out {
            let truth =
                ViewTruth { photograph: name.clone(), unseen: format!("unseen_{name}.png"), base_color: format!("base_color_{name}.exr") };
            photo::save_exr(&ObjectTruth::file(out, &truth.base_color), &film.image(|p| p.albedo))?;
            scene.set_light(&lights[1]);
            save(&ObjectTruth::file(out, &truth.unseen), &traced(&scene, &view, options, ((options.views + v) as u64, false)), false)?;
            views.push(truth);
        }
        frames[is_held_out as usize].push(frame(&name, camera, pose));
        *(if is_held_out { &mut made.held_out } else { &mut made.photographs }) += 1;
        progress((v + 1) as f64 / cameras.len() as f64);
        if stop.load(Ordering::Relaxed) && v + 1 < cameras.len() {
            made.interrupted = true;
            return Ok(made);
        }
    }
    let truth = ObjectTruth { model: "model.glb".into(), light: "light.hdr".into(), unseen: "unseen.hdr".into(), views };
    gltf::save(&ObjectTruth::file(out, &truth.model), &model, WriteOptions::default())?;
    for (name, light) in [&truth.light, &truth.unseen].into_iter().zip(&lights) {
        environment::save_hdr(&ObjectTruth::file(out, name), &light.environment)?;
    }
    truth.save(out)?;
    for (name, frames) in ["transforms_train.json", "transforms_test.json"].into_iter().zip(frames) {
        let all = json!({ "camera_angle_x": 2.0 * (0.5 * options.size.0 as f64 / cameras[0].0.fx).atan(), "frames": frames });
        atomic::write(&out.join(name), &serde_json::to_vec_pretty(&all).expect("plain values"))?;
    }
    Ok(made)
}

/// Cameras spread evenly over a sphere around the object, from below its middle to almost straight above.
fn cameras(options: &ObjectSynth, center: DVec3, radius: f64) -> Vec<(Camera, Pose)> {
    let camera = Camera::pinhole(options.size.0, options.size.1, FOV);
    let narrow = (options.size.0.min(options.size.1) as f64 / options.size.0 as f64 * (0.5 * FOV).tan()).atan();
    let distance = radius / (FILLED * narrow).sin();
    // Neighbors in this order are far apart, so that held-out views are spread as well.
    let pose = |i: usize| {
        let z = -0.5 + 1.45 * ((i as f64 + 0.5) * 0.618_033_988_749_895).fract();
        let (r, angle) = ((1.0 - z * z).sqrt(), std::f64::consts::TAU * (i as f64 + 0.5) / options.views as f64);
        (camera, Pose::look_at(center + distance * DVec3::new(r * angle.cos(), r * angle.sin(), z), center, DVec3::Z))
    };
    (0..options.views).map(pose).collect()
}

/// A light as one map, scaled to one exposure of all photographs: [`CLIPPED`] of the object's pixels are brighter than white in any channel.
fn exposed(scene: &mut Scene, light: Daylight, cameras: &[(Camera, Pose)]) -> Daylight {
    let environment = match light.sun {
        None => light.environment,
        Some(sun) => {
            let mut map = Environment::from_fn(SUN_ROWS, |d| light.environment.radiance(d));
            map.add_disc(sun.direction, sun.diameter, sun.irradiance);
            map
        }
    };
    let light = Daylight::of(environment);
    scene.set_light(&light);
    let mut brightest = Vec::new();
    for (camera, pose) in cameras.iter().step_by(cameras.len().div_ceil(METERED)) {
        let view = View { camera: *camera, world_from_camera: *pose, lens: None };
        let mut film = Film::new(camera);
        cpu::render(scene, &view, &Settings { bounces: BOUNCES, shows_light: false, ..Settings::default() }, 16, &mut film);
        denoise::cpu::run(&mut film);
        let pixels = film.image(|p| [p.color[0], p.color[1], p.color[2], p.opacity]);
        brightest.extend(pixels.data.as_chunks::<4>().0.iter().filter(|p| p[3] > 0.5).map(|p| p[0].max(p[1]).max(p[2]) / p[3]));
    }
    light.turned(0.0, gain(&mut brightest))
}

/// Gain that leaves [`CLIPPED`] of the values above 1.
fn gain(values: &mut [f32]) -> f64 {
    let Some(last) = values.len().checked_sub(1) else { return 1.0 };
    let (_, white, _) = values.select_nth_unstable_by(((1.0 - CLIPPED) * last as f64).round() as usize, f32::total_cmp);
    if *white > 0.0 { 1.0 / *white as f64 } else { 1.0 }
}

/// A view by its number, with the light behind the object where it is shown.
fn traced(scene: &Scene, view: &View, options: &ObjectSynth, (number, shows_light): (u64, bool)) -> Film {
    let mut film = Film::new(&view.camera);
    let seed = options.seed.wrapping_mul(100_003).wrapping_add(number);
    let settings = Settings { seed, bounces: BOUNCES, shows_light, ..Settings::default() };
    cpu::render(scene, view, &settings, options.samples, &mut film);
    denoise::cpu::run(&mut film);
    film
}

/// RGBA of a film, straight, in sRGB; RGB where the film is opaque.
fn save(path: &Path, film: &Film, is_opaque: bool) -> Result<()> {
    let opacity = |own: f32| if is_opaque { 1.0 } else { own };
    Ok(photo::save_png(path, &picture::develop(&film.image(|p| [p.color[0], p.color[1], p.color[2], opacity(p.opacity)]), 0.0))?)
}

/// A frame of `transforms_*.json`: poses look along −z there.
fn frame(name: &str, camera: &Camera, pose: &Pose) -> serde_json::Value {
    let p = pose.flip_y_z();
    let row = |i: usize| [p.rotation.x_axis[i], p.rotation.y_axis[i], p.rotation.z_axis[i], p.translation[i]];
    json!({
        "file_path": format!("images/{name}.png"),
        "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
        "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": camera.width, "h": camera.height,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_exposure_leaves_a_fiftieth_of_the_pixels_clipped() {
        let values: Vec<f32> = (1..=1000).map(|i| 0.004 * i as f32).collect();
        let by = gain(&mut values.clone());
        let clipped = values.iter().filter(|v| **v as f64 * by > 1.0 + 1e-6).count();
        assert!((19..=21).contains(&clipped), "{clipped} at {by}");
        assert_eq!((gain(&mut [0.0; 5]), gain(&mut [])), (1.0, 1.0));
    }
}
