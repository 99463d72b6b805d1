//! Training of the scene model: draws pixels, describes each step, and updates the lights.

use super::model::SceneModel;
use super::shading::{LIGHT, SceneLoss, Weights};
use super::viewing::RunView;
use crate::error::Result;
use crate::run::device::Device;
use crate::run::photographs::StoredPhotographs;
use diorama_data::checkpoint;
use diorama_engine::fields::{DensitySlope, Normals};
use diorama_engine::samplers::RayBatch;
use diorama_engine::samplers::pixels::{self, DrawOptions};
use diorama_engine::samplers::placement::Placement;
use diorama_engine::step::{GivenRays, Loss, Probes, RaySource, Step, Trainees};
use diorama_engine::train::{Scalar, Scalars, StepReport, Trainee};
use diorama_geom::rng::Rng;
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::path::Path;
use std::sync::Mutex;

/// Streams of random numbers.
const PIXELS: u64 = 10;
const OCCUPANCY: u64 = 11;
const NOISE: u64 = 12;
/// Standard deviation of noise on the light that the shadow sees.
const LIGHT_NOISE: f32 = 0.01;
/// Steps during which an occupancy sample stands for a block of cells, and that block's edge.
const OCCUPANCY_WARMUP: (u64, usize) = (256, 2);
/// Distances at which densities are compared for normals, first and last, in inner cubes.
const TAPS: (f32, f32) = (1.0 / 64.0, 1.0 / 512.0);
/// Steps before robust weights and the shadow's freedom begin.
const SETTLED: u64 = 200;

/// A model in training.
pub(super) struct Trainer<'a> {
    pub model: SceneModel,
    photographs: StoredPhotographs,
    cameras: Vec<PosedCamera>,
    device: Device,
    batch: RayBatch,
    checkpoints: &'a Path,
    pub view: Option<&'a RunView>,
    recovered: bool,
}

impl<'a> Trainer<'a> {
    pub fn new(mut model: SceneModel, photographs: StoredPhotographs, checkpoints: &'a Path) -> Result<Trainer<'a>> {
        let (cameras, scene) = (model.cameras(), model.scene());
        let mut device = Device::cpu(None);
        let occupancy = Some(&mut model.occupancy);
        device.begin(&Trainees { occupancy, ..Trainees::of(&mut model.field) }, scene, None)?;
        Ok(Trainer { model, photographs, cameras, device, batch: RayBatch::default(), checkpoints, view: None, recovered: false })
    }

    /// Shows the model in the viewer.
    pub fn show(&self) {
        self.view.into_iter().for_each(|v| v.show_model(self.model.for_rendering()));
    }

    /// Fills the batch with random training pixels.
    fn draw(&mut self) {
        let m = &self.model;
        let rng = Rng::new(m.config.seed, PIXELS);
        let (near, cube) = (m.config.sampling.near, m.cube());
        let o = DrawOptions { cameras: &self.cameras, first: m.rays, rng, near, cube, error_map: None, observations: &[] };
        self.batch.resize(m.config.sampling.rays);
        pixels::draw(&self.photographs, &o, &mut self.batch);
    }

    /// Gray light of each ray, a little noisy, which the shadow reads, `[R, 9]`.
    fn gray(&self, light: &[u32], step: u64) -> Vec<f32> {
        let rng = Rng::new(self.model.config.seed ^ step.wrapping_mul(0x9e37_79b9), NOISE);
        let code = |(r, l): (usize, &u32)| {
            let l = &self.model.lights.values[*l as usize * LIGHT..][..LIGHT];
            (0..9).map(move |i| gray(&l[3 * i..]) + LIGHT_NOISE * rng.normal((9 * r + i) as u64))
        };
        light.iter().enumerate().flat_map(code).collect()
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

/// Scales what depends on the direction: all but the first coefficient of each light.
fn scale_directed(lights: &mut [f32], by: f32) {
    lights.chunks_exact_mut(LIGHT).for_each(|l| l[3..].iter_mut().for_each(|v| *v *= by));
}

/// Luminance of a coefficient.
pub(super) fn gray(c: &[f32]) -> f32 {
    0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]
}

impl Trainee for Trainer<'_> {
    type Error = crate::error::PipelineError;

    fn step(&mut self, step: u64, progress: f64) -> Result<StepReport> {
        if self.view.is_some_and(RunView::wants_update) {
            self.show();
        }
        self.draw();
        let n = self.batch.len();
        let c = self.model.config.clone();
        let light: Vec<u32> = self.batch.images.iter().map(|i| self.model.light_of[*i as usize]).collect();
        let codes = self.gray(&light, step);
        let target: Vec<f32> = self.batch.target.chunks_exact(4).flat_map(|t| [t[0], t[1], t[2]]).collect();
        let counts: Vec<f32> = self.batch.counts.iter().map(|c| *c as u32 as f32).collect();
        let share = (progress as f32 / c.optim.anneal.max(1e-6)).min(1.0);
        let slope = if c.optim.anneal > 0.0 { DensitySlope::annealed(share, TAPS.0, TAPS.1) } else { DensitySlope::Exact };
        self.model.field.normals = Some(Normals { slope, ..Normals::default() });
        let settled = step >= SETTLED;
        let directed = ((progress as f32 - c.optim.even_until) / (c.optim.directed_from - c.optim.even_until).max(1e-6)).clamp(0.0, 1.0);
        let mut lights = self.model.lights.values.clone();
        scale_directed(&mut lights, directed);
        let loss = SceneLoss {
            weights: Weights {
                huber: c.loss.huber,
                robust: if settled { c.loss.robust * self.model.median } else { 0.0 },
                orientation: c.loss.orientation,
                shadow: if settled { c.loss.shadow } else { 1.0 },
                negative: c.loss.negative,
                distortion: c.loss.distortion,
            },
            target: &target,
            counts: &counts,
            dirs: &self.batch.dirs,
            light: &light,
            image: &self.batch.images,
            lights: &lights,
            skies: &self.model.skies.values,
            gains: &self.model.gains.values,
            out: Mutex::default(),
        };
        let background: Vec<f32> = (0..n).flat_map(|_| [0.0, 0.0, 0.0, 1.0]).collect();
        let given = GivenRays {
            images: &self.batch.images,
            origins: &self.batch.origins,
            dirs: &self.batch.dirs,
            jitter: &self.batch.jitter,
            target: &[],
            background: &background,
            codes: &[&codes],
        };
        let march = self.model.occupancy.march_config(c.sampling.max_samples);
        let placement = Placement::Occupancy { march, pruning: self.model.pruning() };
        let (until, block) = OCCUPANCY_WARMUP;
        let block = if step <= until { block } else { 1 };
        let probes = (step > 0 && step.is_multiple_of(c.sampling.occupancy_every)).then(|| Probes {
            rng: Rng::new(c.seed, OCCUPANCY),
            points: c.sampling.occupancy_points,
            block,
        });
        let described = Step {
            probes,
            progress: progress as f32,
            rate_scale: self.model.rate_scale,
            ..Step::new(step, self.model.rays, RaySource::Given(given), placement, Loss::Batch(&loss))
        };
        let (field, occupancy) = (&mut self.model.field, Some(&mut self.model.occupancy));
        let done = self.device.step(&mut Trainees { occupancy, ..Trainees::of(field) }, None, &described, 1)?;
        let mut tables = loss.out.into_inner().expect("the step is over");
        scale_directed(&mut tables.lights, directed);
        if done.shown.loss.is_finite() {
            let m = &mut self.model;
            m.rays += n as u64;
            m.median = 0.95 * m.median + 0.05 * tables.median;
            for (group, d) in [(&mut m.lights, &tables.lights), (&mut m.skies, &tables.skies), (&mut m.gains, &tables.gains)] {
                group.grads.copy_from_slice(d);
                group.step(step as u32 + 1, group.schedule.scale(progress as f32) * m.rate_scale);
            }
        }
        let scalars = self.scalars(tables.mse, n, done.shown.trained);
        Ok(StepReport { loss: done.shown.loss, scalars })
    }

    fn save(&mut self, step: u64, seconds: f64) -> Result<bool> {
        if self.model.params().is_broken() {
            return Ok(false);
        }
        (self.model.origin.step, self.model.origin.seconds) = (step, seconds);
        let (entries, metadata) = self.model.entries();
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
        Ok(Some((self.model.origin.step, "the loss was not finite; the rate is lowered".into())))
    }
}
