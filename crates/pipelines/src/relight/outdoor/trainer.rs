//! Training of the scene model: draws pixels, describes each step, and updates the lights.

use super::config::Stage;
use super::model::SceneModel;
use super::normal_maps::NormalMaps;
use super::shading::SKY;
use super::stepper::Stepper;
use super::viewing::RunView;
use super::visibility::Ambient;
use crate::error::Result;
use crate::run::device::{Device, Pictures};
use crate::run::photographs::StoredPhotographs;
use diorama_data::checkpoint;
use diorama_engine::samplers::RayBatch;
use diorama_engine::samplers::pixels::{self, DrawOptions, Observation, PixelSource};
use diorama_engine::samplers::placement::Placement;
use diorama_engine::step::{Backdrop, GivenRays, Loss, Probes, RaySource, Step, Trainees};
use diorama_engine::train::{Event, Scalar, Scalars, StepReport, Trainee};
use diorama_geom::color::linear_from_srgb;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::photometric_loss::{ColorLoss, Terms};
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Streams of random numbers.
const PIXELS: u64 = 10;
const OCCUPANCY: u64 = 11;
const SKIES: u64 = 15;
const BACKGROUND: u64 = 16;
/// Rays of each light from whose highest ones the sky's first color comes, and their share.
const SKY_RAYS: usize = 4000;
const HIGHEST: usize = 10;
/// Steps during which an occupancy sample stands for a block of cells, and that block's edge.
const OCCUPANCY_WARMUP: (u64, usize) = (256, 2);
/// Factor of the wanted samples in the first steps, their number and their share of the surfaces' stage at most, and most rays of a step:
/// what is thin is found then or never, as space that is taken for empty is not looked at again.
const FIRST: (f64, u64, f32) = (8.0, 400, 0.15);
const MOST_RAYS: usize = 16_384;
/// How much longer a march's steps are at first, and until which step.
const MARCH_RAMP: (f32, u64) = (16.0, 1024);
/// Steps in which the distortion's weight grows.
const DISTORTION_RAMP: u64 = 2000;
/// Steps before robust weights begin, and normals bend.
const SETTLED: u64 = 200;

mod at_once;
mod distances;
mod light;

pub(super) use distances::Given;

/// A model in training.
pub(super) struct Trainer<'a> {
    pub model: SceneModel,
    photographs: StoredPhotographs,
    /// Pixels of known distance: those that were given, and those that are observed.
    given: Given,
    observations: Vec<Observation>,
    cameras: Vec<PosedCamera>,
    device: Device,
    batch: RayBatch,
    checkpoints: &'a Path,
    pub view: Option<&'a RunView>,
    recovered: bool,
    /// Normals of the surfaces, once they stay.
    normals: Option<NormalMaps>,
    /// Of the lights, where suns are apart.
    ambients: Vec<Ambient>,
    /// Where all is learned at once.
    stepper: Stepper,
}

/// Rays of a step as the losses read them.
struct Drawn {
    /// Light of each ray, `[R]`.
    light: Vec<u32>,
    /// `[R, 3]`
    target: Vec<f32>,
    counts: Vec<f32>,
}

impl<'a> Trainer<'a> {
    pub fn new(mut model: SceneModel, photographs: StoredPhotographs, given: Given, checkpoints: &'a Path) -> Result<Trainer<'a>> {
        let (cameras, scene) = (model.cameras(), model.scene());
        if model.origin.step == 0 {
            first_skies(&mut model, &photographs, &cameras);
        }
        let normals = surface_normals(&model, &cameras);
        let ambients = if model.stage == Stage::Light { model.ambients() } else { Vec::new() };
        let mut device = Device::cpu(None);
        let occupancy = Some(&mut model.occupancy);
        device.begin(&Trainees { occupancy, ..Trainees::of(&mut model.field) }, scene, None)?;
        let mut trainer = Trainer {
            model,
            photographs,
            given,
            observations: Vec::new(),
            cameras,
            device,
            batch: RayBatch::default(),
            checkpoints,
            view: None,
            recovered: false,
            normals,
            ambients,
            stepper: Stepper::default(),
        };
        trainer.observe();
        Ok(trainer)
    }

    /// Shows the model in the viewer.
    pub fn show(&self) {
        self.view.into_iter().for_each(|v| v.show_model(self.model.for_rendering()));
    }

    /// Rays of a step: as many as give about the wanted number of samples, times a factor.
    fn rays(&self, factor: f64) -> usize {
        let s = &self.model.config.sampling;
        if s.rays > 0 {
            return s.rays;
        }
        let n = factor * s.batch_samples as f64 / self.model.samples_per_ray.max(1.0);
        (n as usize).clamp(64, MOST_RAYS).next_multiple_of(64)
    }

    /// Fills the batch with random training pixels.
    fn draw(&mut self) {
        let rays = self.rays(1.0);
        let m = &self.model;
        let rng = Rng::new(m.config.seed, PIXELS);
        let (near, cube) = (m.config.sampling.near, m.cube());
        let o = DrawOptions { cameras: &self.cameras, first: m.rays, rng, near, cube, error_map: None, observations: &[] };
        self.batch.resize(rays);
        pixels::draw(&WithoutGlass(&self.photographs), &o, &mut self.batch);
    }

    /// What the losses read of the drawn rays.
    fn drawn(&self) -> Drawn {
        let b = &self.batch;
        Drawn {
            light: b.images.iter().map(|i| self.model.light_of[*i as usize]).collect(),
            target: b.target.chunks_exact(4).flat_map(|t| [t[0], t[1], t[2]]).collect(),
            counts: b.counts.iter().map(|c| *c as u32 as f32).collect(),
        }
    }

    /// Random numbers of a step.
    fn rng(&self, stream: u64, step: u64) -> Rng {
        Rng::new(self.model.config.seed ^ step.wrapping_mul(0x9e37_79b9), stream)
    }

    /// Figures of a step of `n` rays.
    fn scalars(&self, mse: f64, n: usize, samples: f64) -> Scalars {
        Scalars::from([
            Scalar::new("mse", mse).logged_only(),
            Scalar::psnr("psnr", mse),
            Scalar::count("rays", self.model.rays),
            Scalar::rate("rays_per_s", n as f64),
            Scalar::new("samples_per_ray", samples / n as f64).logged_only(),
        ])
    }
}

impl Trainer<'_> {
    /// One step of the surfaces' stage.
    fn look(&mut self, step: u64, share: f32) -> Result<StepReport> {
        let (m, of) = (&self.model, |stream| Rng::new(self.model.config.seed, stream));
        let s = &m.config.sampling;
        let (most, until) = MARCH_RAMP;
        let stretch = most.powf(1.0 - step.min(until) as f32 / until as f32);
        let march = m.occupancy.march_config(s.max_samples).stretched(stretch);
        let is_probed = step > 0 && step.is_multiple_of(s.occupancy_every);
        let (until, block) = OCCUPANCY_WARMUP;
        let terms = Terms {
            color: ColorLoss::Huber(m.config.loss.huber),
            distortion: m.config.loss.distortion * (step as f32 / DISTORTION_RAMP as f32).min(1.0),
            depth: if self.observations.is_empty() { 0.0 } else { m.config.loss.depth },
            alpha: 0.0,
        };
        let (more, steps, at_most) = FIRST;
        let count = self.rays(if step < steps && share < at_most { more } else { 1.0 });
        let rays = RaySource::Photographs { count, rng: of(PIXELS) };
        let placement = Placement::Occupancy { march, pruning: m.pruning() };
        let described = Step {
            backdrop: Backdrop::Random(of(BACKGROUND)),
            probes: is_probed.then(|| Probes {
                rng: of(OCCUPANCY),
                points: s.occupancy_points,
                block: if step <= until { block } else { 1 },
            }),
            near_scaling: m.config.loss.near_scaling,
            progress: share,
            rate_scale: m.rate_scale,
            ..Step::new(step, m.rays, rays, placement, Loss::Photometric(terms))
        };
        let pictures = Pictures { photographs: &self.photographs, observations: &self.observations };
        let (field, occupancy) = (&mut self.model.field, Some(&mut self.model.occupancy));
        let done = self.device.step(&mut Trainees { occupancy, ..Trainees::of(field) }, Some(pictures), &described, 1)?;
        let f = done.shown;
        if f.loss.is_finite() {
            self.model.count(f.rays as usize, f.trained);
        }
        Ok(StepReport { loss: f.loss, scalars: self.scalars(f.mse, f.rays as usize, f.trained) })
    }

    /// A step of given rays.
    fn described<'b>(&self, step: u64, share: f32, given: GivenRays<'b>, loss: Loss<'b>) -> Step<'b> {
        let m = &self.model;
        let march = m.occupancy.march_config(m.config.sampling.max_samples);
        let placement = Placement::Occupancy { march, pruning: m.pruning() };
        Step { progress: share, rate_scale: m.rate_scale, ..Step::new(step, m.rays, RaySource::Given(given), placement, loss) }
    }
}

/// Normals of surfaces that stay; none before that, and where all is learned at once.
fn surface_normals(model: &SceneModel, cameras: &[PosedCamera]) -> Option<NormalMaps> {
    (model.stage == Stage::Light && model.joint.is_none()).then(|| NormalMaps::of(model, cameras))
}

/// Pixels that do not show glass: what glass mirrors tells nothing about its albedo, shadow and light.
struct WithoutGlass<'a>(&'a StoredPhotographs);

impl PixelSource for WithoutGlass<'_> {
    fn images(&self) -> usize {
        self.0.images()
    }
    fn size(&self, image: usize) -> (u32, u32) {
        self.0.size(image)
    }
    fn snap(&self, image: usize, x: u32, y: u32) -> (u32, u32) {
        self.0.snap(image, x, y)
    }
    fn stride(&self) -> u32 {
        self.0.stride()
    }
    fn rgba(&self, image: usize, x: u32, y: u32) -> [f32; 4] {
        self.0.rgba(image, x, y)
    }
    fn counts(&self, image: usize, x: u32, y: u32) -> bool {
        self.0.counts(image, x, y) && !self.0.store().is_glass(image, x, y)
    }
}

/// Gives each sky the color of what is bright and blue among the highest rays.
fn first_skies(model: &mut SceneModel, photographs: &StoredPhotographs, cameras: &[PosedCamera]) {
    let lights = model.skies.values.len() / SKY;
    let (near, cube, rng) = (model.config.sampling.near, model.cube(), Rng::new(model.config.seed, SKIES));
    let o = DrawOptions { cameras, first: 0, rng, near, cube, error_map: None, observations: &[] };
    let mut batch = RayBatch::default();
    batch.resize(SKY_RAYS * lights);
    pixels::draw(photographs, &o, &mut batch);
    let linear = |r: usize| [0, 1, 2].map(|k| linear_from_srgb(batch.target[4 * r + k]));
    for l in 0..lights {
        let mut of: Vec<usize> =
            (0..batch.len()).filter(|r| batch.counts[*r] && model.light_of[batch.images[*r] as usize] as usize == l).collect();
        if of.is_empty() {
            continue;
        }
        of.sort_by(|a, b| batch.dirs[3 * b + 2].total_cmp(&batch.dirs[3 * a + 2]));
        of.truncate(of.len().div_ceil(HIGHEST));
        of.sort_by(|a, b| batch.target[4 * a + 2].total_cmp(&batch.target[4 * b + 2]));
        let sky = linear(of[of.len() * 3 / 4]);
        // The first basis function is 0.2821.
        (0..3).for_each(|k| model.skies.values[l * SKY + k] = sky[k] / 0.282_094_8);
    }
}

impl Trainee for Trainer<'_> {
    type Error = crate::error::PipelineError;

    fn prepare(&mut self, step: u64, progress: f64, interrupt: &AtomicBool, events: &mut dyn FnMut(&Event)) -> Result<()> {
        if self.model.joint.is_some() {
            return Ok(());
        }
        match self.model.config.light.stage(progress as f32) {
            (Stage::Surfaces, share) => self.flatten(share, events),
            (Stage::Light, _) if self.model.stage == Stage::Surfaces => self.begin_light(step, interrupt, events)?,
            (Stage::Light, _) => {}
        }
        Ok(())
    }

    fn step(&mut self, step: u64, progress: f64) -> Result<StepReport> {
        if self.view.is_some_and(RunView::wants_update) {
            self.show();
        }
        if self.model.joint.is_some() {
            return Ok(self.learn_at_once(step, progress as f32));
        }
        match self.model.config.light.stage(progress as f32) {
            (Stage::Surfaces, share) => self.look(step, share),
            (Stage::Light, share) => self.relight(step, share),
        }
    }

    fn save(&mut self, step: u64, seconds: f64) -> Result<bool> {
        if self.model.params().is_broken() {
            return Ok(false);
        }
        (self.model.origin.step, self.model.origin.seconds) = (step, seconds);
        let around = self.model.around();
        let (entries, metadata) = self.model.entries(&around);
        checkpoint::save(self.checkpoints, &entries, metadata)?;
        Ok(true)
    }

    fn recover(&mut self) -> Result<Option<(u64, String)>> {
        if self.recovered {
            return Ok(None);
        }
        self.recovered = true;
        let mut fresh = SceneModel::new(self.model.config.clone(), self.model.capture.clone())?;
        if checkpoint::exists(self.checkpoints) {
            let (c, _) = checkpoint::load(self.checkpoints)?;
            fresh.restore(c, &checkpoint::latest(self.checkpoints))?;
        }
        fresh.rate_scale = 0.3 * self.model.rate_scale;
        self.model = fresh;
        self.observe();
        self.ambients = self.model.ambients();
        self.normals = surface_normals(&self.model, &self.cameras);
        Ok(Some((self.model.origin.step, "the loss was not finite; the rate is lowered".into())))
    }
}
