//! Scores of the object model: held-out photographs, and, of generated objects, an unseen light, the shape and the base color.
//!
//! Pictures are compared before white in sRGB. Brightness is shared between base color and light by chance; the unseen light is therefore also
//! scored after one factor per channel of linear light over all views, and base color only so.

use super::capture::{ObjectCapture, ObjectPhoto};
use super::export;
use super::model::{ObjectModel, Stage, joined};
use super::placement::Placement;
use super::probe::Probe;
use super::truth::ObjectTruth;
use crate::error::{PipelineError, Result};
use diorama_data::{environment, model_file, photo};
use diorama_geom::capture::Split;
use diorama_geom::color::{linear_from_srgb, srgb_from_linear};
use diorama_geom::daylight::Daylight;
use diorama_geom::environment::Environment;
use diorama_geom::glam::DVec3;
use diorama_geom::{ImageU8, Model};
use diorama_kernels::ops::path_trace::{Film, Scene, Settings, View, cpu};
use diorama_mesh::closest_point::TriangleTree;
use rayon::prelude::*;
use serde::Serialize;
use std::path::Path;

/// Views from which the shapes are compared.
const SHAPE_VIEWS: usize = 24;
/// Bounces of light.
const BOUNCES: u32 = 6;

/// Scores in dB, and shares.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ObjectScores {
    /// Held-out photographs in their own light, drawn and path-traced.
    pub object_psnr: f64,
    pub object_traced_psnr: f64,
    /// Held-out views under the unseen light; absent without truth, as what follows.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth: Option<TruthScores>,
    pub views: usize,
    pub faces: usize,
}

/// Scores against what is exact.
#[derive(Clone, Debug, Default, Serialize)]
pub struct TruthScores {
    pub object_relight_psnr: f64,
    pub object_relight_traced_psnr: f64,
    /// After one factor per channel.
    pub object_relight_scaled_psnr: f64,
    pub object_relight_traced_scaled_psnr: f64,
    pub base_color_psnr: f64,
    /// Mean distance between what the cameras see of both surfaces, over the diagonal of the object's box.
    pub chamfer: f64,
}

/// Mean squared error of two pictures `[H, W, 4]`, linear light times opacity, before white.
pub fn squared_error(a: &[f32], b: &[f32]) -> f64 {
    let on_white = |p: &[f32; 4], k: usize| srgb_from_linear((p[k] + 1.0 - p[3]).clamp(0.0, 1.0)) as f64;
    let pairs = a.as_chunks::<4>().0.par_iter().zip(b.as_chunks::<4>().0);
    let sum: Vec<f64> = pairs.map(|(a, b)| (0..3).map(|k| (on_white(a, k) - on_white(b, k)).powi(2)).sum::<f64>()).collect();
    sum.iter().sum::<f64>() / (3 * sum.len()).max(1) as f64
}

fn psnr(errors: &[f64]) -> f64 {
    -10.0 * (errors.iter().sum::<f64>() / errors.len().max(1) as f64).log10()
}

/// Pairs of pictures, ours and the right one.
#[derive(Default)]
struct Pairs(Vec<(Vec<f32>, Vec<f32>)>);

impl Pairs {
    fn psnr(&self) -> f64 {
        psnr(&self.0.iter().map(|(a, b)| squared_error(a, b)).collect::<Vec<_>>())
    }

    /// After the factor per channel that fits best.
    fn scaled_psnr(&self) -> f64 {
        let factors = factors(
            self.0
                .iter()
                .flat_map(|(a, b)| a.as_chunks::<4>().0.iter().zip(b.as_chunks::<4>().0))
                .map(|(a, b)| ([a[0], a[1], a[2]], [b[0], b[1], b[2]])),
        );
        let scaled = |a: &[f32]| -> Vec<f32> {
            a.as_chunks::<4>().0.iter().flat_map(|p| [p[0] * factors[0], p[1] * factors[1], p[2] * factors[2], p[3]]).collect()
        };
        psnr(&self.0.iter().map(|(a, b)| squared_error(&scaled(a), b)).collect::<Vec<_>>())
    }
}

/// Factors by channel that bring the first colors nearest to the second ones.
fn factors(pairs: impl Iterator<Item = ([f32; 3], [f32; 3])>) -> [f32; 3] {
    let mut sums = [[0.0f64; 2]; 3];
    for (a, b) in pairs {
        for k in 0..3 {
            sums[k][0] += (a[k] * b[k]) as f64;
            sums[k][1] += (a[k] * a[k]) as f64;
        }
    }
    sums.map(|[both, own]| (both / own.max(1e-12)) as f32)
}

/// Judges a trained model. `look` receives names and pictures `[ours | right]`; paths have `samples` per pixel.
///
/// # Errors
/// When training has not reached the second stage, nothing is held out, or files are missing.
pub fn judge(
    model: &ObjectModel,
    capture: &ObjectCapture,
    samples: u32,
    look: &mut dyn FnMut(&str, &ImageU8) -> Result<()>,
) -> Result<ObjectScores> {
    let Stage::Textured(textured) = &model.stage else {
        return Err(PipelineError::Usage("training has not reached the stage with textures; go on with --resume".into()));
    };
    let held_out: Vec<&ObjectPhoto> = capture.indices(Split::Test).into_iter().map(|i| &capture.photos[i]).collect();
    if held_out.is_empty() {
        return Err(PipelineError::Usage("no photographs were held out: there is nothing to score on".into()));
    }
    let exported = export::model(textured, &model.placement, "object");
    let mut tracer = Traced::new(&exported, model, samples);
    let (mut drawn, mut traced) = (Pairs::default(), Pairs::default());
    tracer.light(&model.probe.environment());
    for p in &held_out {
        let [ours, _] = textured.picture(&p.view, &model.probe);
        look(&format!("{}_own", name(p)), &beside(&ours, &p.rgba.data, p))?;
        drawn.0.push((ours, p.rgba.data.clone()));
        let path_traced = tracer.view(p);
        look(&format!("{}_own_traced", name(p)), &beside(&path_traced, &p.rgba.data, p))?;
        traced.0.push((path_traced, p.rgba.data.clone()));
    }
    let data = &model.config.data.path;
    let truth = match ObjectTruth::read(data)? {
        Some(truth) => Some(against_truth(model, &held_out, capture, &truth, &mut tracer, look)?),
        None => None,
    };
    Ok(ObjectScores {
        object_psnr: drawn.psnr(),
        object_traced_psnr: traced.psnr(),
        truth,
        views: held_out.len(),
        faces: textured.layout.faces.len(),
    })
}

fn against_truth(
    model: &ObjectModel,
    held_out: &[&ObjectPhoto],
    capture: &ObjectCapture,
    truth: &ObjectTruth,
    tracer: &mut Traced,
    look: &mut dyn FnMut(&str, &ImageU8) -> Result<()>,
) -> Result<TruthScores> {
    let Stage::Textured(textured) = &model.stage else { return Ok(TruthScores::default()) };
    let data = &model.config.data.path;
    let unseen = environment::read(&ObjectTruth::file(data, &truth.unseen))?.environment;
    let probe = Probe::given(model.config.light.cube, &unseen);
    tracer.light(&unseen);
    let (mut drawn, mut traced, mut colors) = (Pairs::default(), Pairs::default(), Vec::new());
    for p in held_out {
        let Some(view) = truth.views.iter().find(|v| name(p) == v.photograph) else { continue };
        let right = opaque(&ObjectTruth::file(data, &view.unseen))?;
        let [ours, base] = textured.picture(&p.view, &probe);
        look(&format!("{}_unseen", name(p)), &beside(&ours, &right, p))?;
        drawn.0.push((ours, right.clone()));
        let path_traced = tracer.view(p);
        look(&format!("{}_unseen_traced", name(p)), &beside(&path_traced, &right, p))?;
        traced.0.push((path_traced, right));
        let exact = photo::load_full(&ObjectTruth::file(data, &view.base_color))?;
        let photo::Photo::Linear(exact) = exact else { continue };
        let exact_rgba: Vec<f32> = exact
            .data
            .chunks_exact(exact.channels)
            .zip(p.rgba.data.as_chunks::<4>().0)
            .flat_map(|(c, p)| [c[0], c[1], c[2], p[3]])
            .collect();
        look(&format!("{}_base_color", name(p)), &beside(&base, &exact_rgba, p))?;
        let both = base.as_chunks::<4>().0.iter().zip(exact_rgba.as_chunks::<4>().0).filter(|(a, b)| a[3] > 0.99 && b[3] > 0.99);
        colors.extend(both.map(|(a, b)| ([a[0], a[1], a[2]], [b[0], b[1], b[2]])));
    }
    let by = factors(colors.iter().copied());
    let off = colors.iter().map(|(a, b)| (0..3).map(|k| ((by[k] * a[k] - b[k]) as f64).powi(2)).sum::<f64>() / 3.0);
    let exact = model_file::read(&ObjectTruth::file(data, &truth.model))?.model;
    Ok(TruthScores {
        object_relight_psnr: drawn.psnr(),
        object_relight_traced_psnr: traced.psnr(),
        object_relight_scaled_psnr: drawn.scaled_psnr(),
        object_relight_traced_scaled_psnr: traced.scaled_psnr(),
        base_color_psnr: psnr(&off.collect::<Vec<_>>()),
        chamfer: chamfer(&tracer.model, &exact, &capture.photos, model),
    })
}

/// Name of a photograph without folder and extension.
fn name(p: &ObjectPhoto) -> &str {
    let last = p.name.rsplit('/').next().unwrap_or(&p.name);
    last.strip_suffix(".png").unwrap_or(last)
}

/// Linear light times opacity of a picture.
fn opaque(path: &Path) -> Result<Vec<f32>> {
    let image = photo::load_full(path)?.into_srgb();
    let of = |p: &[f32]| {
        let a = p.get(3).copied().unwrap_or(1.0);
        [linear_from_srgb(p[0]) * a, linear_from_srgb(p[1]) * a, linear_from_srgb(p[2]) * a, a]
    };
    Ok(image.data.chunks_exact(image.channels).flat_map(of).collect())
}

/// Two pictures side by side before white.
fn beside(a: &[f32], b: &[f32], p: &ObjectPhoto) -> ImageU8 {
    let (w, h) = (p.rgba.width, p.rgba.height);
    let row = |rgba: &[f32], y: usize| -> Vec<u8> {
        let pixels = rgba[4 * y * w..4 * (y + 1) * w].as_chunks::<4>().0;
        pixels
            .iter()
            .flat_map(|p| [0, 1, 2].map(|k| diorama_geom::color::u8_from_unit(srgb_from_linear((p[k] + 1.0 - p[3]).clamp(0.0, 1.0)))))
            .collect()
    };
    let data = (0..h).flat_map(|y| [row(a, y), row(b, y)].concat()).collect();
    ImageU8 { width: 2 * w, height: h, channels: 3, data }
}

/// The exported model under a light, path-traced.
struct Traced {
    model: Model,
    scene: Scene,
    placement: Placement,
    samples: u32,
}

impl Traced {
    fn new(exported: &Model, model: &ObjectModel, samples: u32) -> Traced {
        let scene = Scene::new(exported, &Daylight::of(Environment::uniform([0.0; 3], 4)));
        Traced { model: exported.clone(), scene, placement: model.placement, samples }
    }

    fn light(&mut self, environment: &Environment) {
        self.scene.set_light(&Daylight::of(environment.clone()));
    }

    fn view(&self, p: &ObjectPhoto) -> Vec<f32> {
        let view = View { camera: p.view.camera, world_from_camera: self.placement.pose_in_world(&p.view.pose), lens: None };
        let mut film = Film::new(&p.view.camera);
        let settings = Settings { bounces: BOUNCES, shows_light: false, ..Settings::default() };
        cpu::render(&self.scene, &view, &settings, self.samples, &mut film);
        film.image(|p| [p.color[0], p.color[1], p.color[2], p.opacity]).data
    }
}

/// Mean of the mean distances, in both directions, from the points that cameras see of one surface to the other one, over the diagonal.
fn chamfer(ours: &Model, exact: &Model, photos: &[ObjectPhoto], model: &ObjectModel) -> f64 {
    let dark = Daylight::of(Environment::uniform([0.0; 3], 4));
    let scenes = [ours, exact].map(|m| Scene::new(m, &dark));
    let trees = [ours, exact].map(|m| TriangleTree::new(&joined(m)));
    let step = photos.len().div_ceil(SHAPE_VIEWS);
    let mut sums = [0.0; 2];
    for (i, scene) in scenes.iter().enumerate() {
        let (mut sum, mut n) = (0.0, 0usize);
        for p in photos.iter().step_by(step) {
            let view = View { camera: p.view.camera, world_from_camera: model.placement.pose_in_world(&p.view.pose), lens: None };
            let points: Vec<DVec3> = cpu::first_hits(scene, &view, false).into_iter().flatten().map(|h| h.position).collect();
            let away = |p: &DVec3| (trees[1 - i].nearest(p.as_vec3().to_array()).squared_distance as f64).sqrt();
            sum += points.par_iter().map(away).collect::<Vec<_>>().iter().sum::<f64>();
            n += points.len();
        }
        sums[i] = if n > 0 { sum / n as f64 } else { f64::INFINITY };
    }
    let diagonal = exact.bounds().map_or(1.0, |(l, h)| (DVec3::from(h) - DVec3::from(l)).length());
    0.5 * (sums[0] + sums[1]) / diagonal
}
