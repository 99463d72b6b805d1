//! The four compositions of the thesis, ready to render: an object, synthetic or photographed, in a place, synthetic or photographed.
//!
//! What the user does not bring is generated: the street and its photograph stand for a place, the chair for an object.

use super::compose::Z_UP;
use super::light::{LightOptions, Source, require_file};
use super::path_tracer::PathTracer;
use super::picture::{self, Job};
use super::synth::{Place, SynthOptions};
use super::{compose, turntable};
use crate::error::{PipelineError, Result};
use diorama_data::gltf::{self, WriteOptions};
use diorama_data::{DataError, atomic, model_file, photo};
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Image, Model, Pose};
use diorama_kernels::ops::path_trace::{Scene, Settings, View, cpu};
use diorama_scenes::chair;
use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// The clear sky over generated places: elevation and rotation in degrees, and the strength that exposes it.
const SKY: (f64, f64, f64) = (32.0, 120.0, 0.02);
/// Share of the picture's height that an object of unknown size fills.
const FILLED: f64 = 0.3;
/// Horizontal field of view in degrees of places that the user brings without a frame.
const FOV: f64 = 50.0;
/// Directions in which an object needs room.
const AROUND: usize = 16;
/// Columns of the picture in which places are tried.
const TRIED: usize = 96;

/// One of the four compositions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Scenario {
    pub name: &'static str,
    /// What the thesis shows, and who has the data.
    pub thesis: &'static str,
    /// Whether the place is a photograph that the object is put into.
    is_photographed: bool,
}

/// All four.
pub const SCENARIOS: [Scenario; 4] = [
    Scenario {
        name: "synthetic-in-synthetic",
        thesis: "ficus and EgyptianChair in Bistro; bring the models with --site and --object",
        is_photographed: false,
    },
    Scenario {
        name: "synthetic-in-real",
        thesis: "Bob in Site 1 of NeRF-OSR; bring its mesh with --site and a run of its photographs with --frame",
        is_photographed: true,
    },
    Scenario {
        name: "real-in-synthetic",
        thesis: "head and cape in Bistro; bring an object made by `relight object` with --object",
        is_photographed: false,
    },
    Scenario {
        name: "real-in-real",
        thesis: "head and cape in sites of NeRF-OSR; bring --site, --frame and --object",
        is_photographed: true,
    },
];

impl Scenario {
    /// # Errors
    /// When no scenario has the name.
    pub fn named(name: &str) -> Result<Scenario> {
        let names = SCENARIOS.map(|s| s.name).join(", ");
        let found = SCENARIOS.into_iter().find(|s| s.name == name);
        found.ok_or_else(|| PipelineError::Usage(format!("scenario {name:?}: expected one of {names}")))
    }
}

/// What the user brings.
#[derive(Clone, Debug, Default)]
pub struct ScenarioOptions {
    /// Model of the place.
    pub site: Option<PathBuf>,
    /// Model of the object.
    pub object: Option<PathBuf>,
    /// `RUN:NUMBER`, a photograph of the place: the camera, and what is behind the object where the place is photographed.
    pub frame: Option<String>,
    pub hdri: Option<PathBuf>,
    pub rotate_deg: f64,
    /// None: 1 if place and object are generated, else such that the object fills a third of the picture's height.
    pub scale: Option<f64>,
    pub size: (u32, u32),
    /// Samples per pixel.
    pub samples: u32,
}

/// A camera in a place.
struct Framing {
    view: View,
    /// Lines of `[camera]`.
    camera: String,
}

/// Writes `scene.toml` and what it needs into a folder, and whether that was interrupted. A description that is there is kept unless `force`.
///
/// # Errors
/// When a file is missing or wrong, the object finds no free place, or a file cannot be written.
pub fn prepare(out: &Path, scenario: &Scenario, o: &ScenarioOptions, force: bool, stop: &AtomicBool) -> Result<(PathBuf, bool)> {
    let description = out.join("scene.toml");
    if description.exists() && !force {
        return Ok((description, false));
    }
    if scenario.is_photographed && o.site.is_some() && o.frame.is_none() {
        return Err(PipelineError::Usage(format!("{}: --site needs a photograph of it: --frame RUN:NUMBER", scenario.name)));
    }
    if o.frame.is_some() && o.site.is_none() {
        return Err(PipelineError::Usage("--frame: is for a place whose mesh --site gives".into()));
    }
    let object = match &o.object {
        Some(path) => {
            require_file(path, "--object")?;
            model_file::read(path)?.model
        }
        None => chair::model(0),
    };
    let (site, generated) = match &o.site {
        Some(path) => {
            require_file(path, "--site")?;
            (model_file::read(path)?.model, None)
        }
        None => {
            let place = Place::street(&SynthOptions { size: o.size, ..SynthOptions::named("ci")? });
            (place.model, Some(place.viewpoints.iter().map(|p| (p.camera, p.pose)).collect::<Vec<_>>()))
        }
    };
    let scene = Scene::new(&site, &LightOptions::of(Source::Uniform(1.0)).read()?.0);
    // The camera before which the object finds the best place.
    let mut best: Option<(Framing, Spot)> = None;
    for framing in framings(&site, generated.as_deref(), o)? {
        let found = spot(&scene, &framing.view, &object, o)?;
        if let Some(found) = found.filter(|f| best.as_ref().is_none_or(|b| f.cost < b.1.cost)) {
            best = Some((framing, found));
        }
    }
    let (framing, spot) = best.ok_or_else(|| {
        PipelineError::Usage("the object finds no level, free ground in the lower half of the picture; give a smaller --scale".into())
    })?;
    let light = light(o)?;
    std::fs::create_dir_all(out).map_err(DataError::io(out, "create"))?;
    if scenario.is_photographed && o.frame.is_none() && photograph(out, scene, &framing.view, o, stop)? {
        return Ok((description, true));
    }
    let mut text = String::new();
    for (heading, given, model, name) in [("[scene]", &o.site, &site, "site.glb"), ("[[object]]", &o.object, &object, "object.glb")] {
        let file = match given {
            Some(path) => std::path::absolute(path).map_err(DataError::io(path, "find"))?.display().to_string(),
            None => {
                gltf::save(&out.join(name), model, WriteOptions::default())?;
                name.to_string()
            }
        };
        let _ = writeln!(text, "{heading}\nmesh = {file:?}");
    }
    let at = (Z_UP.transpose() * spot.at).to_array();
    let _ = writeln!(text, "translate = {at:.4?}\nrotate_deg = [0, 25, 0]\nscale = {:.6}\nsnap = \"ground\"\noverlap = true", spot.scale);
    let backplate = if scenario.is_photographed { "photo" } else { "light" };
    let photograph = if scenario.is_photographed && o.frame.is_none() { "photograph = \"photograph.png\"\n" } else { "" };
    let (w, h) = o.size;
    let _ = write!(text, "[light]\n{light}[camera]\n{}{photograph}", framing.camera);
    let _ = writeln!(text, "[render]\nsize = [{w}, {h}]\nspp = {}\ndenoise = \"atrous\"\nbackplate = \"{backplate}\"", o.samples);
    atomic::write(&description, text.as_bytes())?;
    Ok((description, false))
}

/// Lines of `[light]`.
fn light(o: &ScenarioOptions) -> Result<String> {
    let source = match &o.hdri {
        Some(path) => {
            require_file(path, "--light")?;
            format!("hdri = {:?}", std::path::absolute(path).map_err(DataError::io(path, "find"))?.display().to_string())
        }
        None => format!("sky = {{ elevation = {}, rotation = {}, intensity = {} }}", SKY.0, SKY.1, SKY.2),
    };
    Ok(format!("{source}\nrotate_deg = {}\n", o.rotate_deg))
}

/// The camera of the frame, those of the generated street, or one that sees the whole place.
fn framings(site: &Model, generated: Option<&[(Camera, Pose)]>, o: &ScenarioOptions) -> Result<Vec<Framing>> {
    if let Some(frame) = &o.frame {
        let (camera, world_from_camera, _) = compose::frame_of_run(frame)?;
        let view = View { camera: camera.resized(o.size.0, o.size.1), world_from_camera, lens: None };
        let (run, which) = frame.rsplit_once(':').unwrap_or((frame, "0"));
        let run = std::path::absolute(run).map_err(DataError::io(Path::new(run), "find"))?;
        return Ok(vec![Framing { view, camera: format!("frame = {:?}\n", format!("{}:{which}", run.display())) }]);
    }
    let cameras = match (generated, site.bounds()) {
        (Some(cameras), _) => cameras.to_vec(),
        (None, Some((low, high))) => {
            let camera = Camera::pinhole(o.size.0, o.size.1, FOV.to_radians());
            vec![(camera, turntable::orbit(&camera, [DVec3::from(low), DVec3::from(high)], 15f64.to_radians(), 0.4))]
        }
        (None, None) => return Err(PipelineError::Usage("--site: holds no triangles".into())),
    };
    let framing = |(camera, pose): (Camera, Pose)| {
        let fov = 2.0 * (0.5 * camera.width as f64 / camera.fx).atan();
        let [eye, target] = [pose.translation, pose.point(DVec3::Z)].map(|p| (Z_UP.transpose() * p).to_array());
        // What is rendered is seen exactly as the description says.
        let world_from_camera = Pose::look_at(pose.translation, pose.point(DVec3::Z), DVec3::Z);
        let view = View { camera: Camera::pinhole(o.size.0, o.size.1, fov), world_from_camera, lens: None };
        Framing { view, camera: format!("eye = {eye:?}\ntarget = {target:?}\nfov_deg = {:?}\n", fov.to_degrees()) }
    };
    Ok(cameras.into_iter().map(framing).collect())
}

/// Where an object stands.
struct Spot {
    at: DVec3,
    scale: f64,
    /// How far it is from where and as large as it should be in the picture.
    cost: f64,
}

/// The best place on level, free ground in the lower middle of the picture.
fn spot(scene: &Scene, view: &View, object: &Model, o: &ScenarioOptions) -> Result<Option<Spot>> {
    let Some((low, high)) = object.bounds().map(|(l, h)| (DVec3::from(l), DVec3::from(h))) else {
        return Err(PipelineError::Usage("--object: holds no triangles".into()));
    };
    let extent = high - low;
    let [w, h] = [TRIED, (TRIED * o.size.1 as usize / o.size.0 as usize).max(8)];
    let camera = view.camera.resized(w as u32, h as u32);
    let hits = cpu::first_hits(scene, &View { camera, ..*view }, true);
    let is_generated = o.site.is_none() && o.object.is_none();
    let mut best: Option<Spot> = None;
    for (y, x) in (h / 2..h).flat_map(|y| (w / 8..7 * w / 8).map(move |x| (y, x))) {
        let Some(hit) = hits[y * w + x] else { continue };
        let fitting = FILLED * h as f64 * hit.depth / (camera.fy * extent.z.max(1e-9));
        let scale = o.scale.unwrap_or(if is_generated { 1.0 } else { fitting });
        let (dx, dy) = ((x as f64 / w as f64 - 0.5) * 2.0, y as f64 / h as f64 - 0.75);
        let cost = dx * dx + 4.0 * dy * dy + 0.3 * (scale / fitting).ln().powi(2);
        if best.as_ref().is_none_or(|b| cost < b.cost) && is_free(scene, hit.position, scale * extent) {
            // The center of the object's box comes over the place; `snap` finds the height.
            let center = 0.5 * (low + high) * DVec3::new(1.0, 1.0, 0.0);
            let at = hit.position - scale * center + DVec3::Z * (scale * (extent.z - low.z));
            best = Some(Spot { at, scale, cost });
        }
    }
    Ok(best)
}

/// Whether the ground around a point is level, and nothing stands or hangs where an object of an extent would be.
fn is_free(scene: &Scene, at: DVec3, extent: DVec3) -> bool {
    let radius = 0.55 * extent.truncate().length();
    let lift = DVec3::Z * (0.15 * extent.z).max(1e-6);
    (0..AROUND).all(|i| {
        let angle = TAU * i as f64 / AROUND as f64;
        let side = radius * DVec3::new(angle.cos(), angle.sin(), 0.0);
        let ground = cpu::first_hit(scene, at + side + lift, DVec3::NEG_Z);
        let is_level = ground.is_some_and(|g| (g.position.z - at.z).abs() < 0.04 * extent.z);
        let top = at + DVec3::Z * extent.z;
        is_level && !cpu::is_between(scene, at + lift, at + lift + side) && !cpu::is_between(scene, at + side + lift, top + side)
    })
}

/// Renders the photograph of a generated place, and whether that was interrupted.
fn photograph(out: &Path, mut scene: Scene, view: &View, o: &ScenarioOptions, stop: &AtomicBool) -> Result<bool> {
    let source = match &o.hdri {
        Some(path) => LightOptions::of(Source::File(path.clone())),
        None => LightOptions { strength: SKY.2, ..LightOptions::of(Source::Sky { elevation: SKY.0, rotation: SKY.1 }) },
    };
    scene.set_light(&LightOptions { rotate_deg: o.rotate_deg, ..source }.read()?.0);
    let settings = Settings { bounces: 8, seed: 1, ..Settings::default() };
    let job = Job { scene: &scene, view: *view, settings, samples: o.samples, kept: None, key: String::new() };
    let (mut film, interrupted) = picture::render(&job, &mut PathTracer::cpu(), stop, &mut |_| {})?;
    if interrupted {
        return Ok(true);
    }
    diorama_kernels::ops::denoise::cpu::run(&mut film);
    let rgba: Image = film.image(|p| [p.color[0], p.color[1], p.color[2], 1.0]);
    photo::save_png(&out.join("photograph.png"), &picture::develop(&rgba, picture::automatic_exposure(&rgba)))?;
    Ok(false)
}
