//! A model from all sides under one light.

use super::light::{LightOptions, require_file};
use super::path_tracer::PathTracer;
use super::picture::{self, Job};
use crate::error::{PipelineError, Result};
use diorama_data::film::Film as Video;
use diorama_data::{DataError, model_file, photo};
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Pose};
use diorama_kernels::ops::denoise;
use diorama_kernels::ops::path_trace::{Scene, Settings, View};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Share of the picture's smaller side that the model's bounding sphere fills.
const FILLED: f64 = 0.92;
/// Frames per second of videos.
const FPS: u32 = 24;

/// What to render and where to put it.
#[derive(Clone, Debug)]
pub struct TurntableOptions {
    pub light: LightOptions,
    pub frames: usize,
    pub size: (u32, u32),
    /// Samples per pixel.
    pub samples: u32,
    /// Height of the camera above the model's center, as an angle in radians.
    pub elevation: f64,
    /// Horizontal field of view in radians.
    pub fov: f64,
    /// Whether noise is filtered.
    pub denoise: bool,
    /// Whether the light is visible behind the model; else frames are transparent, and videos white there.
    pub background: bool,
    /// Whether the model turns under a light that stays, rather than the camera about both.
    pub turn_model: bool,
    /// Stops; none: such that the brightest twentieth of the first frame is nearly white.
    pub exposure: Option<f64>,
    /// Folder for PNG files, or the name of a video.
    pub out: PathBuf,
}

/// What was rendered.
#[derive(Clone, Debug, Serialize)]
pub struct Turntable {
    pub out: PathBuf,
    pub frames: usize,
    pub triangles: usize,
    pub exposure: f64,
    /// What traced the paths.
    pub device: String,
    pub interrupted: bool,
    #[serde(skip)]
    pub notes: Vec<String>,
}

/// Renders a turn; `progress` gets the share that is done. Frames that are in the folder already are kept unless `force`.
///
/// # Errors
/// When the model or the light cannot be read, the model is empty, a frame cannot be written, or a device that was named failed.
pub fn render(
    model: &Path,
    options: &TurntableOptions,
    tracer: &mut PathTracer,
    force: bool,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(f64),
) -> Result<Turntable> {
    require_file(model, "model")?;
    let model_file::LoadedModel { model: geometry, mut notes } = model_file::read(model)?;
    let (light, more) = options.light.read()?;
    notes.extend(more);
    let Some((low, high)) = geometry.bounds().map(|(l, h)| (DVec3::from(l), DVec3::from(h))) else {
        return Err(DataError::input(model, "holds no triangles").into());
    };
    let camera = Camera::pinhole(options.size.0, options.size.1, options.fov);
    picture::require_memory(&camera)?;
    let mut scene = Scene::new(&geometry, &light);
    tracer.load(&scene)?;
    let mut output = Output::open(&options.out, options.size, force)?;
    (0..options.frames).try_for_each(|i| output.check(i, options.size))?;
    let settings = Settings { shows_light: options.background, ..Settings::default() };
    let mut made = Turntable {
        out: options.out.clone(),
        frames: 0,
        triangles: geometry.face_count(),
        exposure: options.exposure.unwrap_or(0.0),
        device: String::new(),
        interrupted: false,
        notes,
    };
    let is_first_needed = options.exposure.is_none() && (0..options.frames).any(|i| !output.has(i));
    for i in 0..options.frames {
        let is_kept = output.has(i);
        let turn = i as f64 / options.frames as f64 * std::f64::consts::TAU;
        if options.turn_model {
            // Seen from a camera that moves, a light that moves along stands still.
            scene.set_light(&light.clone().turned(turn, 1.0));
            tracer.set_light(&scene)?;
        }
        // The first frame tells how much all are brightened, the ones that are missing too.
        let rgba = if is_kept && !(i == 0 && is_first_needed) {
            None
        } else {
            let view = View { camera, world_from_camera: orbit(&camera, [low, high], options.elevation, turn), lens: None };
            let job = Job { scene: &scene, view, settings, samples: options.samples, kept: None, key: String::new() };
            let (mut film, interrupted) = picture::render(&job, tracer, stop, &mut |s| progress((i as f64 + s) / options.frames as f64))?;
            if interrupted {
                made.interrupted = true;
                break;
            }
            if options.denoise {
                denoise::cpu::run(&mut film);
            }
            Some(film.image(|p| [p.color[0], p.color[1], p.color[2], if options.background { 1.0 } else { p.opacity }]))
        };
        if let Some(rgba) = rgba {
            if i == 0 && options.exposure.is_none() {
                made.exposure = picture::automatic_exposure(&rgba);
            }
            if !is_kept {
                output.push(i, &rgba, made.exposure)?;
            }
        }
        made.frames += 1;
        if stop.load(Ordering::Relaxed) && made.frames < options.frames {
            made.interrupted = true;
            break;
        }
    }
    output.finish(made.frames)?;
    made.device = tracer.name().into();
    progress(1.0);
    Ok(made)
}

/// Pose of a camera that sees a box as a whole from an elevation, `turn` from its front; angles in radians.
pub(crate) fn orbit(camera: &Camera, [low, high]: [DVec3; 2], elevation: f64, turn: f64) -> Pose {
    let (center, radius) = (0.5 * (low + high), 0.5 * (high - low).length());
    let narrow = (0.5 * camera.width.min(camera.height) as f64 / camera.fx).atan();
    let distance = radius / (FILLED * narrow).sin();
    // Without a turn, the camera looks along glTF's −z, at the front of the model.
    let ahead = turn - std::f64::consts::FRAC_PI_2;
    let (up, level) = elevation.sin_cos();
    Pose::look_at(center + distance * DVec3::new(level * ahead.cos(), level * ahead.sin(), up), center, DVec3::Z)
}

/// Extensions of files that no turn is written to.
const OTHER_FILES: [&str; 8] = ["avi", "mov", "mkv", "webm", "png", "jpg", "jpeg", "exr"];

enum Output {
    Folder { folder: PathBuf, force: bool },
    Video(Box<Video>),
}

impl Output {
    fn open(out: &Path, (width, height): (u32, u32), force: bool) -> Result<Output> {
        let is_video = out.extension().is_some_and(|e| e.eq_ignore_ascii_case("mp4") || e.eq_ignore_ascii_case("gif"));
        if is_video {
            if out.exists() && !force {
                return Err(PipelineError::Usage(format!("{}: exists; give --force to replace it", out.display())));
            }
            return Ok(Output::Video(Box::new(Video::create(out, width as usize, height as usize, FPS)?)));
        }
        if out.extension().is_some_and(|e| OTHER_FILES.iter().any(|o| e.eq_ignore_ascii_case(o))) {
            let what = "turns are .mp4, .gif, or a folder of pictures";
            return Err(PipelineError::Usage(format!("{}: {what}", out.display())));
        }
        std::fs::create_dir_all(out).map_err(DataError::io(out, "create"))?;
        Ok(Output::Folder { folder: out.to_path_buf(), force })
    }

    fn file(folder: &Path, i: usize) -> PathBuf {
        folder.join(format!("{i:04}.png"))
    }

    fn has(&self, i: usize) -> bool {
        matches!(self, Output::Folder { folder, force: false } if Output::file(folder, i).exists())
    }

    /// Refuses a frame of another turn.
    fn check(&self, i: usize, size: (u32, u32)) -> Result<()> {
        let Output::Folder { folder, .. } = self else { return Ok(()) };
        let file = Output::file(folder, i);
        let found = if self.has(i) { photo::load(&file)? } else { return Ok(()) };
        if (found.width as u32, found.height as u32) != size {
            let what = format!(
                "is of another turn, {}×{} pixels, not {}×{}; give --force to replace it",
                found.width, found.height, size.0, size.1
            );
            return Err(DataError::input(&file, what).into());
        }
        Ok(())
    }

    fn push(&mut self, i: usize, rgba: &diorama_geom::Image, exposure: f64) -> Result<()> {
        let frame = picture::develop(rgba, exposure);
        match self {
            Output::Folder { folder, .. } => photo::save_png(&Output::file(folder, i), &frame)?,
            Output::Video(video) => video.push(&on_white(&frame))?,
        }
        Ok(())
    }

    /// An interrupted video ends with its last whole frame; without any, nothing is written.
    fn finish(self, frames: usize) -> Result<()> {
        match self {
            Output::Video(video) if frames > 0 => Ok(video.finish()?),
            _ => Ok(()),
        }
    }
}

/// A frame without transparency.
fn on_white(frame: &diorama_geom::ImageU8) -> diorama_geom::ImageU8 {
    if frame.channels == 3 {
        return frame.clone();
    }
    let blend = |p: &[u8]| {
        let a = p[3] as u32;
        [p[0], p[1], p[2]].map(|v| ((v as u32 * a + 255 * (255 - a) + 127) / 255) as u8)
    };
    let data = frame.data.chunks_exact(4).flat_map(blend).collect();
    diorama_geom::ImageU8 { width: frame.width, height: frame.height, channels: 3, data }
}
