//! Generated benchmark: a street photographed in several lights by known cameras, with exact albedo, normals, depth, shadow and light.
//!
//! The folder is a capture (`transforms_train.json`, `transforms_test.json`, `images/`) with a `truth/` that training never reads.

use super::truth::{self, LightTruth, Truth, ViewTruth};
use crate::error::{PipelineError, Result};
use diorama_data::masks::{GLASS_CLASS, SKY_CLASS, STATIC_CLASS};
use diorama_data::{DataError, atomic, photo};
use diorama_geom::capture::SceneBox;
use diorama_geom::color::{luminance, srgb_from_linear};
use diorama_geom::daylight::Daylight;
use diorama_geom::environment::Environment;
use diorama_geom::glam::DVec3;
use diorama_geom::sky::Sky;
use diorama_geom::{Camera, Image, ImageU8, Model, Pose};
use diorama_kernels::ops::denoise;
use diorama_kernels::ops::path_trace::{Film, Scene, Settings, View, cpu};
use diorama_scenes::street;
use serde_json::json;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

/// Rows of the maps of the lights.
const ROWS: usize = 128;
/// Radiance that a white surface facing up sends to the cameras, by which photographs are exposed.
const EXPOSED: f64 = 1.1;
/// Cameras to choose from, per view.
const CANDIDATES: usize = 40;
/// Least distance in meters of what the center of a view shows.
const NEAREST: f64 = 5.0;
/// Pixels of each view by which the scene's cubes are chosen.
const PROBED: (u32, u32) = (24, 18);
/// Bounces of light.
const BOUNCES: u32 = 6;
/// Rays of a pixel along an axis by which masks are decided.
const FOOTPRINT: usize = 3;
/// How many times the samples of the others held-out views have: their noise would count as errors of what is measured.
const HELD_OUT_SAMPLES: u32 = 4;
/// Every so many views, one is held out.
const HOLD_OUT: usize = 5;

/// A place and the viewpoints from which it is photographed.
pub struct Place {
    pub model: Model,
    pub viewpoints: Vec<Viewpoint>,
}

/// A camera that stands somewhere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Viewpoint {
    pub camera: Camera,
    pub pose: Pose,
    /// The light of training in which it photographs; none: all of them.
    pub light: Option<usize>,
    /// Whether it is for scores only, in lights that are held out as well.
    pub is_held_out: bool,
}

impl Place {
    /// A place photographed in all lights from the same viewpoints, of which every fifth is held out.
    pub fn around(model: Model, cameras: Vec<(Camera, Pose)>) -> Place {
        let viewpoint = |(v, (camera, pose)): (usize, (Camera, Pose))| Viewpoint {
            camera,
            pose,
            light: None,
            is_held_out: v % HOLD_OUT == HOLD_OUT - 1,
        };
        Place { model, viewpoints: cameras.into_iter().enumerate().map(viewpoint).collect() }
    }

    /// The northern row of the procedural street. In each light, a photographer walks past it anew, so that no two photographs of training are
    /// from one viewpoint; those held out are photographed in all lights. What stands behind the photographer would cast shadows that no
    /// photograph explains.
    pub fn street(options: &SynthOptions) -> Place {
        let [w, h] = [options.size.0, options.size.1];
        let model = street::northern_row(options.seed);
        let held_out = options.views / HOLD_OUT;
        let count = held_out + options.lights * (options.views - held_out);
        let cameras = looking_at_one_place(&model, street::cameras(CANDIDATES * count, w, h, options.seed), count);
        // Along the street: one that is held out after the same number of others.
        let every = count.checked_div(held_out).unwrap_or(usize::MAX);
        let mut walked = 0;
        let viewpoint = |(v, (camera, pose)): (usize, (Camera, Pose))| {
            let is_held_out = v % every == every / 2 && v / every < held_out;
            walked += !is_held_out as usize;
            Viewpoint { camera, pose, light: (!is_held_out).then(|| walked % options.lights.max(1)), is_held_out }
        };
        Place { model, viewpoints: cameras.into_iter().enumerate().map(viewpoint).collect() }
    }
}

/// Of many cameras, `n` that look at places near each other, from as many sides as there are.
fn looking_at_one_place(model: &Model, candidates: Vec<(Camera, Pose)>, n: usize) -> Vec<(Camera, Pose)> {
    let scene = Scene::new(model, &light(0));
    let hit = |(_, pose): &(Camera, Pose)| cpu::first_hit(&scene, pose.translation, pose.rotation.z_axis).filter(|h| h.depth > NEAREST);
    let looks: Vec<(usize, DVec3)> = candidates.iter().enumerate().filter_map(|(i, c)| Some((i, hit(c)?.position))).collect();
    let near = |p: DVec3| {
        let mut near: Vec<(usize, f64)> = looks.iter().map(|(i, q)| (*i, (*q - p).length())).collect();
        near.sort_by(|a, b| a.1.total_cmp(&b.1));
        near.truncate(3 * n);
        near
    };
    // The place around which most cameras look.
    let best = looks.iter().step_by(looks.len().div_ceil(200).max(1)).map(|(_, p)| near(*p)).min_by(|a, b| {
        let farthest = |v: &Vec<(usize, f64)>| v.last().map_or(f64::MAX, |l| l.1);
        farthest(a).total_cmp(&farthest(b))
    });
    let mut chosen: Vec<usize> = best.unwrap_or_default().into_iter().map(|(i, _)| i).collect();
    let along = |i: &usize| candidates[*i].1.translation.x;
    chosen.sort_by(|a, b| along(a).total_cmp(&along(b)));
    let step = (chosen.len() as f64 / n as f64).max(1.0);
    (0..n.min(chosen.len())).map(|k| candidates[chosen[(k as f64 * step) as usize]]).collect()
}

/// Size of the benchmark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SynthOptions {
    /// Photographs in each light.
    pub views: usize,
    /// Lights of training, 1 to 4; a sun and a veiled sun are held out besides.
    pub lights: usize,
    pub size: (u32, u32),
    /// Samples per pixel.
    pub samples: u32,
    pub seed: u64,
}

impl SynthOptions {
    /// # Errors
    /// When the name is not that of a size.
    pub fn named(name: &str) -> Result<SynthOptions> {
        let of = |views, size, samples| SynthOptions { views, lights: 4, size, samples, seed: 0 };
        match name {
            "ci" => Ok(of(10, (64, 48), 64)),
            "middle" => Ok(of(60, (320, 180), 32)),
            "gpu" => Ok(of(88, (640, 360), 256)),
            _ => Err(PipelineError::Usage(format!("size {name:?}: expected ci, middle or gpu"))),
        }
    }
}

/// Dust of an ordinary summer's day over that of the clearest: a fifth of the light then comes from the sky.
const HAZE: f64 = 3.0;

/// Sharpness of the glow into which thin clouds spread a sun (a von Mises–Fisher lobe): 17 degrees to its inflection.
const VEIL: f64 = 12.0;

/// What stands above the street; suns by elevation and azimuth in degrees.
#[derive(Clone, Copy)]
enum Above {
    Sun(f64, f64),
    Overcast,
    /// A sun behind thin clouds.
    Veiled(f64, f64),
}

/// Lights with their names; the last [`HELD_OUT_LIGHTS`] are held out.
const LIGHTS: [(&str, Above); 6] = [
    ("morning", Above::Sun(30.0, 125.0)),
    ("noon", Above::Sun(58.0, 185.0)),
    ("evening", Above::Sun(20.0, 245.0)),
    ("overcast", Above::Overcast),
    ("unseen", Above::Sun(38.0, 215.0)),
    ("veiled", Above::Veiled(45.0, 150.0)),
];
const HELD_OUT_LIGHTS: usize = 2;

/// The light of a name in [`LIGHTS`], exposed.
fn light(index: usize) -> Daylight {
    let clear = |elevation: f64, azimuth: f64| {
        let clear = Sky::clear(elevation.to_radians(), azimuth.to_radians());
        Daylight::clear(&Sky { dust: HAZE, ..clear }, ROWS)
    };
    let light = match LIGHTS[index].1 {
        Above::Sun(elevation, azimuth) => clear(elevation, azimuth),
        // CIE overcast sky (Moon and Spencer 1942).
        Above::Overcast => Daylight::of(Environment::from_fn(ROWS, |d| {
            [0.95, 1.0, 1.05].map(|c| if d.z > 0.0 { c * (1.0 + 2.0 * d.z) / 3.0 } else { 0.0 })
        })),
        Above::Veiled(elevation, azimuth) => {
            let clear = clear(elevation, azimuth);
            let sun = clear.sun.expect("above the horizon");
            let lobe = |d: DVec3| VEIL / std::f64::consts::TAU * (VEIL * (d.dot(sun.direction) - 1.0)).exp();
            let sky = |d: DVec3| {
                let radiance = clear.environment.radiance(d);
                [0, 1, 2].map(|k| radiance[k] + if d.z > 0.0 { sun.irradiance[k] * lobe(d) } else { 0.0 })
            };
            Daylight::of(Environment::from_fn(ROWS, sky))
        }
    };
    let up = irradiance(&light, DVec3::Z);
    let gray = luminance(up);
    light.turned(0.0, EXPOSED * std::f64::consts::PI / gray)
}

/// Irradiance of a surface without shadows.
pub fn irradiance(light: &Daylight, normal: DVec3) -> [f64; 3] {
    let mut sum = light.environment.irradiance(normal);
    if let Some(sun) = light.sun {
        (0..3).for_each(|k| sum[k] += sun.irradiance[k] * sun.direction.dot(normal).max(0.0));
    }
    sum
}

/// What was generated.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Synthesized {
    pub photographs: usize,
    pub held_out: usize,
    pub triangles: usize,
    pub interrupted: bool,
}

/// Generates the benchmark into a folder. `progress` gets the share that is done.
///
/// # Errors
/// When the folder exists and is not replaced by `force`, or a file cannot be written.
pub fn generate(
    out: &Path,
    place: &Place,
    options: &SynthOptions,
    force: bool,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(f64),
) -> Result<Synthesized> {
    if out.join("transforms_train.json").exists() && !force {
        return Err(PipelineError::Usage(format!("{}: holds a capture; give --force to replace it", out.display())));
    }
    let most = LIGHTS.len() - HELD_OUT_LIGHTS;
    if !(1..=most).contains(&options.lights) || place.viewpoints.len() < HOLD_OUT {
        return Err(PipelineError::Usage(format!("a benchmark has 1 to {most} lights and at least {HOLD_OUT} views")));
    }
    for folder in ["images", "masks", "truth"] {
        let folder = out.join(folder);
        std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
    }
    let (model, viewpoints) = (&place.model, &place.viewpoints);
    let lights: Vec<usize> = (0..options.lights).chain(most..LIGHTS.len()).collect();
    let daylights: Vec<Daylight> = lights.iter().map(|l| light(*l)).collect();
    let mut scene = Scene::new(model, &daylights[0]);
    let mut made = Synthesized { photographs: 0, held_out: 0, triangles: model.face_count(), interrupted: false };
    let (mut frames, mut views) = ([Vec::new(), Vec::new()], Vec::new());
    let is_in = |p: &Viewpoint, l: usize| p.light.is_none_or(|of| of == l) && (l < options.lights || p.is_held_out);
    let total = viewpoints.iter().map(|p| (0..lights.len()).filter(|l| is_in(p, *l)).count()).sum::<usize>() as f64;
    for (v, viewpoint) in viewpoints.iter().enumerate() {
        let Viewpoint { camera, pose, is_held_out, .. } = viewpoint;
        let view = View { camera: *camera, world_from_camera: *pose, lens: None };
        let mut is_first = true;
        for (l, daylight) in daylights.iter().enumerate().filter(|(l, _)| is_in(viewpoint, *l)) {
            scene.set_light(daylight);
            let mut film = Film::new(camera);
            let settings = Settings {
                seed: options.seed + (v * lights.len() + l) as u64,
                bounces: BOUNCES,
                light_layers: true,
                ..Settings::default()
            };
            let samples = options.samples * if *is_held_out { HELD_OUT_SAMPLES } else { 1 };
            cpu::render(&scene, &view, &settings, samples, &mut film);
            denoise::cpu::run(&mut film);
            let name = format!("v{v:03}_{}", LIGHTS[lights[l]].0);
            save_photograph(&out.join("images").join(format!("{name}.png")), &film)?;
            truth::save_shadow(out, &name, &film)?;
            let mask = format!("masks/v{v:03}.png");
            if std::mem::take(&mut is_first) {
                let classes = classes(&scene, &view, model);
                let is_valid = valid_pixels(&classes, &film);
                truth::save_view(out, &format!("v{v:03}"), &film, &is_valid)?;
                photo::save_png(&out.join(&mask), &classes)?;
            }
            frames[*is_held_out as usize].push(frame(&name, &mask, camera, pose, l));
            views.push(ViewTruth { photograph: name, view: format!("v{v:03}"), light: l, held_out: *is_held_out });
            *(if *is_held_out { &mut made.held_out } else { &mut made.photographs }) += 1;
            progress((made.photographs + made.held_out) as f64 / total);
            if stop.load(Ordering::Relaxed) {
                made.interrupted = true;
                return Ok(made);
            }
        }
    }
    let of_light = |l: usize| LightTruth::of(LIGHTS[lights[l]].0, &daylights[l]);
    let truth =
        Truth { lights: (0..lights.len()).map(of_light).collect(), views, unseen: options.lights, veiled: Some(options.lights + 1) };
    for (l, daylight) in daylights.iter().enumerate() {
        truth::save_light(out, &truth.lights[l].name, daylight)?;
    }
    truth.save(out)?;
    for (name, frames) in ["transforms_train.json", "transforms_test.json"].into_iter().zip(frames) {
        atomic::write(&out.join(name), &serde_json::to_vec_pretty(&capture(frames, &scene, viewpoints)).expect("plain values"))?;
    }
    Ok(made)
}

/// sRGB of a film.
fn save_photograph(path: &Path, film: &Film) -> Result<()> {
    let srgb = film.image(|p| p.color.map(|v| srgb_from_linear(v.clamp(0.0, 1.0))));
    Ok(photo::save_png(path, &srgb.to_u8())?)
}

/// The mask of a view: glass where any of [`FOOTPRINT`]² rays of a pixel meets some, else what the middle one meets.
fn classes(scene: &Scene, view: &View, model: &Model) -> ImageU8 {
    let (w, h, n) = (view.camera.width as usize, view.camera.height as usize, FOOTPRINT);
    let is_glass = |i: u32| model.materials[model.parts[model.instances[i as usize].part].material].transmission > 0.0;
    let fine = View { camera: view.camera.resized((n * w) as u32, (n * h) as u32), ..*view };
    let hits = cpu::first_hits(scene, &fine, true);
    let class_of = |x: usize, y: usize| match &hits[y * n * w + x] {
        None => SKY_CLASS,
        Some(h) if is_glass(h.instance) => GLASS_CLASS,
        Some(_) => STATIC_CLASS,
    };
    let of_pixel = |i: usize| {
        let (x, y) = (n * (i % w), n * (i / w));
        let shows_glass = (0..n * n).any(|k| class_of(x + k % n, y + k / n) == GLASS_CLASS);
        if shows_glass { GLASS_CLASS } else { class_of(x + n / 2, y + n / 2) }
    };
    ImageU8 { width: w, height: h, channels: 1, data: (0..w * h).map(of_pixel).collect() }
}

/// Where a pixel shows an opaque surface: neither sky nor glass.
fn valid_pixels(classes: &ImageU8, film: &Film) -> Image {
    let valid = classes.data.iter().zip(&film.pixels).map(|(class, p)| (p.opacity > 0.99 && *class == STATIC_CLASS) as u32 as f32);
    Image { width: film.width, height: film.height, channels: 1, data: valid.collect() }
}

/// A frame of `transforms.json`: poses have y up and look along −z there.
fn frame(name: &str, mask: &str, camera: &Camera, pose: &Pose, session: usize) -> serde_json::Value {
    let p = pose.flip_y_z();
    let row = |i: usize| [p.rotation.x_axis[i], p.rotation.y_axis[i], p.rotation.z_axis[i], p.translation[i]];
    json!({
        "file_path": format!("images/{name}.png"),
        "mask_path": mask,
        "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
        "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": camera.width, "h": camera.height,
        "session": session,
    })
}

/// `transforms.json` whose inner cube holds the cameras and most of what they see, and whose outer cube all of it.
fn capture(frames: Vec<serde_json::Value>, scene: &Scene, viewpoints: &[Viewpoint]) -> serde_json::Value {
    let mut seen: Vec<DVec3> = Vec::new();
    for Viewpoint { camera, pose, .. } in viewpoints {
        let view = View { camera: camera.resized(PROBED.0, PROBED.1), world_from_camera: *pose, lens: None };
        seen.extend(cpu::first_hits(scene, &view, true).into_iter().flatten().map(|h| h.position));
    }
    let eyes: Vec<DVec3> = viewpoints.iter().map(|p| p.pose.translation).collect();
    let cube = SceneBox::holding(&eyes, &seen);
    let scale = 0.5 / cube.half;
    let offset = DVec3::splat(0.5) - scale * cube.center;
    json!({ "aabb_scale": cube.aabb_scale, "scale": scale, "offset": [offset.x, offset.y, offset.z], "mask_meaning": "classes", "frames": frames })
}
