//! Novel views: camera paths, layers, image sequences and video.

use super::model::ObjectModel;
use crate::error::{PipelineError, Result};
use diorama_data::camera_path_json::{self, CameraPath, PathCrop};
use diorama_data::depth::{DepthFormat, DepthSequence};
use diorama_data::film::Film;
use diorama_data::{DataError, photo};
use diorama_engine::renderers::volume::{Backdrop, Quality, View};
use diorama_engine::samplers::{RayBatch, pixels};
use diorama_geom::camera_path::{self, PathView};
use diorama_geom::capture::focus_point;
use diorama_geom::color::linear_from_srgb;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Image, ImageU8, Lens, OrientedBox, Pose};
use diorama_kernels::ops::march::{self, MarchConfig, MarchRays, Marched};
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

/// Where the camera goes.
#[derive(Clone, Debug, PartialEq)]
pub enum PathKind {
    Orbit,
    Spiral,
    Interpolate,
    /// nerfstudio's `camera_path.json`.
    File(PathBuf),
    /// The held-out cameras themselves.
    HeldOut,
}

impl std::str::FromStr for PathKind {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Self, String> {
        match s {
            "orbit" => Ok(PathKind::Orbit),
            "spiral" => Ok(PathKind::Spiral),
            "interpolate" => Ok(PathKind::Interpolate),
            "held-out" => Ok(PathKind::HeldOut),
            f if f.ends_with(".json") => Ok(PathKind::File(f.into())),
            _ => Err(format!("path {s:?}: expected orbit, spiral, interpolate, held-out or a camera_path.json")),
        }
    }
}

/// An image layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layer {
    Rgb,
    Depth,
    Normal,
    Opacity,
    /// How many steps of a ray lie in occupied cells.
    Occupancy,
}

impl Layer {
    /// Name of a frame's picture.
    fn file(self, i: usize) -> String {
        match self {
            Layer::Rgb => format!("{i:04}.png"),
            Layer::Depth => format!("depth_{i:04}.png"),
            Layer::Normal => format!("normal_{i:04}.png"),
            Layer::Opacity => format!("opacity_{i:04}.png"),
            Layer::Occupancy => format!("occupancy_{i:04}.png"),
        }
    }
}

impl std::str::FromStr for Layer {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Self, String> {
        match s {
            "rgb" => Ok(Layer::Rgb),
            "depth" => Ok(Layer::Depth),
            "normal" => Ok(Layer::Normal),
            "opacity" => Ok(Layer::Opacity),
            "occupancy" => Ok(Layer::Occupancy),
            _ => Err(format!("layer {s:?}: expected rgb, depth, normal, opacity or occupancy")),
        }
    }
}

/// What to render and where to put it.
#[derive(Clone, Debug)]
pub struct RenderOptions {
    pub path: PathKind,
    /// None: [`FRAMES`], or all that the path has.
    pub frames: Option<usize>,
    /// Width and height; none: those of the run, or of a path's file.
    pub size: Option<(u32, u32)>,
    /// Horizontal field of view in radians; none: that of the capture, or the vertical one of a path's file.
    pub fov: Option<f64>,
    pub layers: Vec<Layer>,
    /// Folder for PNG sequences, if any.
    pub images: Option<PathBuf>,
    /// Film of the first layer, if any, in the format that its name says.
    pub video: Option<PathBuf>,
    /// None: [`FPS`], or that of a path's file.
    pub fps: Option<u32>,
    /// Only what lies in this box (world) is shown.
    pub clip: Option<([f32; 3], [f32; 3])>,
    pub quality: Quality,
    /// How distances are kept beside the pictures of the depth layer.
    pub depth: DepthFormat,
    /// Meters per unit of the capture, where it is known.
    pub scale: Option<f64>,
}

/// Frames per second where nobody says.
pub const FPS: u32 = 30;

/// Frames of a path where nobody says.
pub const FRAMES: usize = 90;

/// The views of a path in the world.
///
/// # Errors
/// When the path's file is malformed, there are no held-out views, or something is asked that such a path has of its own.
pub fn path_views(model: &ObjectModel, o: &RenderOptions) -> Result<CameraPath> {
    let frames = &model.capture.frames;
    let poses: Vec<Pose> = model.train.iter().map(|&i| frames[i].world_from_camera).collect();
    let (center, _) = focus_point(&poses);
    let base = frames[model.train[0]].camera.reduced(model.config.reduction());
    let camera = view_camera(&base, o.size, o.fov);
    let n = o.frames.unwrap_or(FRAMES).max(1);
    let views = |poses: Vec<Pose>| poses.into_iter().map(|p| PathView { camera, world_from_camera: p }).collect();
    let (up, fps) = (DVec3::Z, o.fps.unwrap_or(FPS) as f64);
    Ok(match &o.path {
        PathKind::Orbit => CameraPath { views: views(camera_path::orbit(&poses, center, up, n)), fps, crop: None },
        PathKind::Spiral => CameraPath { views: views(camera_path::spiral(&poses, center, up, n)), fps, crop: None },
        PathKind::Interpolate => CameraPath { views: views(camera_path::interpolate(&poses, n)), fps, crop: None },
        PathKind::File(f) => {
            if o.frames.is_some() {
                return Err(PipelineError::Usage(format!("--frames: {} says how many; leave it out", f.display())));
            }
            let mut path = camera_path_json::read(f, &model.capture.world_from_capture)?;
            path.fps = o.fps.map_or(path.fps, f64::from);
            if o.size.is_some() || o.fov.is_some() {
                for v in &mut path.views {
                    v.camera = other_size(&v.camera, o.size, o.fov)?;
                }
            }
            path
        }
        PathKind::HeldOut => {
            let held = super::held_out::frames(&model.capture, diorama_geom::capture::Split::Test);
            if held.is_empty() {
                return Err(PipelineError::Usage("the run holds no views out; choose another --path".into()));
            }
            if o.size.is_some() || o.fov.is_some() {
                return Err(PipelineError::Usage("--size and --fov: held-out views have those of their photographs".into()));
            }
            let held = super::held_out::spread(&held, o.frames.unwrap_or(held.len()));
            let views =
                held.iter().map(|&i| PathView { camera: model.posed(i).camera, world_from_camera: frames[i].world_from_camera }).collect();
            CameraPath { views, fps, crop: None }
        }
    })
}

/// The capture's camera without distortion, at another size and field of view.
fn view_camera(base: &Camera, size: Option<(u32, u32)>, fov: Option<f64>) -> Camera {
    let (w, h) = size.unwrap_or((base.width, base.height));
    // What sees a hemisphere or more gives no flat picture.
    let own = match base.lens {
        Lens::Equirectangular => WIDEST,
        _ => (2.0 * (0.5 * base.width as f64 / base.fx).atan()).min(WIDEST),
    };
    Camera::pinhole(w, h, fov.unwrap_or(own))
}

/// Widest field of view of pictures where nobody asks for more, in radians.
const WIDEST: f64 = 1.75;

/// A path's camera at another size, where its vertical field of view stays, or with another horizontal one.
fn other_size(c: &Camera, size: Option<(u32, u32)>, fov: Option<f64>) -> Result<Camera> {
    let (w, h) = size.unwrap_or((c.width, c.height));
    if fov.is_some() && c.lens != Lens::Pinhole {
        return Err(PipelineError::Usage("--fov: the path's camera_type is not perspective; set fov in its file".into()));
    }
    Ok(match c.lens {
        Lens::Pinhole => {
            let same_height = 2.0 * (0.5 * w as f64 / (c.fy * h as f64 / c.height as f64)).atan();
            Camera::pinhole(w, h, fov.unwrap_or(same_height))
        }
        Lens::Equirectangular => Camera::equirectangular(w, h),
        lens => {
            let f = c.fy * h as f64 / c.height as f64;
            Camera { width: w, height: h, fx: f, fy: f, cx: 0.5 * w as f64, cy: 0.5 * h as f64, lens }
        }
    })
}

/// Renders a path; returns the number of frames and whether it was interrupted: then the film has the frames until there,
/// and there is none without any. `progress` receives (frame, of).
pub fn render(
    model: &ObjectModel,
    o: &RenderOptions,
    interrupt: &AtomicBool,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<(usize, bool)> {
    let path = path_views(model, o)?;
    if let Some(folder) = &o.images {
        std::fs::create_dir_all(folder).map_err(DataError::io(folder, "create"))?;
    }
    let mut video = match (&o.video, path.views.first()) {
        (Some(file), Some(v)) => {
            Some(Film::create(file, v.camera.width as usize, v.camera.height as usize, path.fps.round().max(1.0) as u32)?)
        }
        _ => None,
    };
    let mut distances = o.images.as_ref().map(|folder| DepthSequence::new(folder, o.depth, o.scale.is_some()));
    let total = path.views.len();
    let mut done = 0;
    for (i, v) in path.views.iter().enumerate() {
        if interrupt.load(Ordering::Relaxed) {
            break;
        }
        let posed = model.to_model(v.camera, &v.world_from_camera);
        let view = trace(model, &posed, o.clip, path.crop.as_ref(), o.quality);
        for (k, layer) in o.layers.iter().enumerate() {
            let image = draw_layer(model, &posed, &view, *layer);
            model.check_device()?;
            if let Some(folder) = &o.images {
                photo::save_png(&folder.join(layer.file(i)), &image)?;
                if model.is_linear() && *layer == Layer::Rgb {
                    // Beside the picture, all of its light.
                    let mut light = view.rgb.clone();
                    light.data.iter_mut().for_each(|v| *v = model.config.data.white * linear_from_srgb(*v));
                    photo::save_exr(&folder.join(layer.file(i)).with_extension("exr"), &light)?;
                }
            }
            if let (Layer::Depth, Some(distances)) = (layer, &mut distances) {
                distances.push(&distance_map(model, &view, o.scale))?;
            }
            if let (0, Some(video)) = (k, &mut video) {
                video.push(&image)?;
            }
        }
        done = i + 1;
        progress(done, total);
    }
    if let Some(v) = video.filter(|_| done > 0) {
        v.finish()?;
    }
    Ok((done, done < total))
}

fn trace(model: &ObjectModel, camera: &PosedCamera, clip: Option<([f32; 3], [f32; 3])>, crop: Option<&PathCrop>, quality: Quality) -> View {
    let mut tracer = model.tracer(quality);
    if let Some(c) = crop {
        let place = model.model_from_world.pose(&c.within.place);
        tracer.crop = Some(OrientedBox { place, sides: c.within.sides * model.model_from_world.scale });
        if let Some(color) = c.background_srgb {
            let own = |v: f32| if model.is_linear() { linear_from_srgb(v) } else { v };
            tracer.backdrop = Backdrop::Color(color.map(own));
        }
    }
    tracer.clip = clip.map(|(lo, hi)| {
        let to = |p: [f32; 3]| model.model_from_world.point(DVec3::new(p[0] as f64, p[1] as f64, p[2] as f64)).as_vec3().to_array();
        (to(lo), to(hi))
    });
    tracer.view(camera, &mut |_| {})
}

/// Distance along the ray of a view's first pixel (in the model's space) at which it meets matter; none where it meets hardly any.
pub fn depth_of_pixel(model: &ObjectModel, camera: &PosedCamera, clip: Option<([f32; 3], [f32; 3])>) -> Option<f32> {
    let view = trace(model, camera, clip, None, Quality::Full);
    (view.opacity.data[0] > 0.3).then_some(view.depth.data[0])
}

/// One layer of a view, `[H, W, 3]`, of what lies in `clip` (world).
pub fn picture(model: &ObjectModel, camera: &PosedCamera, layer: Layer, clip: Option<([f32; 3], [f32; 3])>, quality: Quality) -> ImageU8 {
    if layer == Layer::Occupancy {
        // The densities are not needed.
        let (w, h) = (camera.camera.width as usize, camera.camera.height as usize);
        let none = View { rgb: Image::zeros(w, h, 3), opacity: Image::zeros(w, h, 1), depth: Image::zeros(w, h, 1) };
        return draw_layer(model, camera, &none, layer);
    }
    draw_layer(model, camera, &trace(model, camera, clip, None, quality), layer)
}

/// Steps of each pixel's ray that lie in occupied cells, as a share of the most that any ray has.
fn occupied(model: &ObjectModel, camera: &PosedCamera) -> Vec<f32> {
    const STEPS: f32 = 256.0;
    let (w, h) = (camera.camera.width as usize, camera.camera.height as usize);
    let Some(grid) = &model.occupancy else { return vec![0.0; w * h] };
    let mut batch = RayBatch::default();
    batch.resize(w * h);
    for i in 0..w * h {
        (batch.pixels[i * 2], batch.pixels[i * 2 + 1]) = ((i % w) as f32 + 0.5, (i / w) as f32 + 0.5);
        (batch.images[i], batch.jitter[i]) = (0, 0.5);
    }
    pixels::rays(std::slice::from_ref(camera), model.config.sampling.near, model.cube(), &mut batch);
    let rays = MarchRays { origins: &batch.origins, dirs: &batch.dirs, near_far: &batch.near_far, jitter: &batch.jitter, resumed: false };
    let config =
        MarchConfig { cone: 0.0, dt_min: 1.0 / STEPS, dt_max: 1.0 / STEPS, max_samples: 4 * STEPS as usize, ..MarchConfig::default() };
    let mut marched = Marched::default();
    march::cpu::march(grid.bits(), &rays, &config, &mut march::cpu::MarchScratch::default(), &mut marched);
    let counts: Vec<u32> = marched.offsets.windows(2).map(|o| o[1] - o[0]).collect();
    let most = counts.iter().max().copied().unwrap_or(0).max(1) as f32;
    counts.iter().map(|n| *n as f32 / most).collect()
}

/// A layer as it is shown: depth from near (bright) to far, normals as colours.
fn draw_layer(model: &ObjectModel, camera: &PosedCamera, view: &View, layer: Layer) -> ImageU8 {
    let (w, h) = (view.rgb.width, view.rgb.height);
    let mut out = Image::zeros(w, h, 3);
    let fill = |out: &mut Image, f: &dyn Fn(usize) -> [f32; 3]| {
        out.data.chunks_exact_mut(3).enumerate().for_each(|(i, o)| o.copy_from_slice(&f(i)));
    };
    match layer {
        Layer::Rgb => return view.rgb.to_u8(),
        Layer::Opacity => fill(&mut out, &|i| [view.opacity.data[i]; 3]),
        Layer::Occupancy => {
            let occupied = occupied(model, camera);
            fill(&mut out, &|i| [occupied[i]; 3]);
        }
        Layer::Depth => {
            let seen: Vec<f32> = view.depth.data.iter().copied().filter(|d| *d > 0.0).collect();
            let (lo, hi) = seen.iter().fold((f32::MAX, f32::MIN), |(a, b), d| (a.min(*d), b.max(*d)));
            let range = (hi - lo).max(1e-6);
            fill(&mut out, &|i| [if view.depth.data[i] > 0.0 { 1.0 - 0.9 * (view.depth.data[i] - lo) / range } else { 0.0 }; 3]);
        }
        Layer::Normal => {
            let normals = normals(model, camera, view);
            fill(&mut out, &|i| if view.opacity.data[i] > 0.5 { normals[i].map(|n| 0.5 + 0.5 * n) } else { [0.0; 3] });
        }
    }
    out.to_u8()
}

/// World normals `−∇σ / ‖∇σ‖` at the expected depth, by central differences of the density.
fn normals(model: &ObjectModel, camera: &PosedCamera, view: &View) -> Vec<[f32; 3]> {
    let w = view.rgb.width;
    let h = 1.0 / 512.0;
    let mut points = Vec::with_capacity(view.depth.data.len() * 18);
    for (i, depth) in view.depth.data.iter().enumerate() {
        let d = camera.camera.direction((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
        let p = (camera.pose.translation + camera.pose.rotation * d * *depth as f64).as_vec3().to_array();
        for k in 0..3 {
            for s in [h, -h] {
                let mut q = p;
                q[k] += s;
                points.extend(q);
            }
        }
    }
    let mut sigma = vec![0.0; points.len() / 3];
    model.model_density(&points, &mut sigma);
    sigma
        .chunks_exact(6)
        .map(|s| {
            let g = [s[1] - s[0], s[3] - s[2], s[5] - s[4]];
            let l = (g[0] * g[0] + g[1] * g[1] + g[2] * g[2]).sqrt().max(1e-12);
            g.map(|v| v / l)
        })
        .collect()
}

/// Distances along the rays in meters, or in units of the capture where its scale is unknown; 0 where nothing is met.
fn distance_map(model: &ObjectModel, view: &View, scale: Option<f64>) -> Image {
    let capture_from_model = 1.0 / (model.model_from_world.scale * model.capture.world_from_capture.scale);
    let mut out = view.depth.clone();
    out.data.iter_mut().for_each(|d| *d = (*d as f64 * capture_from_model * scale.unwrap_or(1.0)) as f32);
    out
}
