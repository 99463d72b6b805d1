//! Training of the scene model: draws pixels, describes each step, and updates the lights.

use super::model::SceneModel;
use super::shading::{CHANNELS, LIGHT, NORMAL, SKY, SceneGradients, SceneLoss, Suns, Weights, gray};
use super::sun::{self, Lit, SUN};
use super::viewing::RunView;
use super::visibility::Visibility;
use crate::error::Result;
use crate::run::device::Device;
use crate::run::photographs::StoredPhotographs;
use diorama_data::checkpoint;
use diorama_engine::fields::FieldBuffers;
use diorama_engine::renderers::volume::Quality;
use diorama_engine::samplers::RayBatch;
use diorama_engine::samplers::pixels::{self, DrawOptions};
use diorama_engine::samplers::placement::Placement;
use diorama_engine::step::{GivenRays, Loss, Probes, RaySource, Step, Trainees};
use diorama_engine::train::{Scalar, Scalars, StepReport, Trainee};
use diorama_geom::color::linear_from_srgb;
use diorama_geom::glam::Vec3;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::path::Path;
use std::sync::Mutex;

/// Streams of random numbers.
const PIXELS: u64 = 10;
const OCCUPANCY: u64 = 11;
const NOISE: u64 = 12;
const SUNS: u64 = 13;
const SKY_NOISE: u64 = 14;
const SKIES: u64 = 15;
/// Rays of each light from whose highest ones the sky's first color comes, and their share.
const SKY_RAYS: usize = 4000;
const HIGHEST: usize = 10;
/// Brightness of surfaces before anything is learned, under a light that is not scaled.
const FIRST_BRIGHTNESS: f32 = 0.4;
/// Pixels from which each sun is found, and the opacity from which one shows a surface.
const PIXELS_PER_SUN: usize = 4000;
const SURFACE: f32 = 0.9;
/// Standard deviation of noise on the light that the shadow sees.
const LIGHT_NOISE: f32 = 0.01;
/// Steps during which an occupancy sample stands for a block of cells, and that block's edge.
const OCCUPANCY_WARMUP: (u64, usize) = (256, 2);
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
        if model.origin.step == 0 {
            first_lights(&mut model, &photographs, &cameras);
        }
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

    /// Gray in place of the sky, `[R]`, while the sky does not learn.
    fn noise(&self, step: u64, progress: f32) -> Vec<f32> {
        let rng = Rng::new(self.model.config.seed ^ step.wrapping_mul(0x9e37_79b9), SKY_NOISE);
        let rays = if progress < self.model.config.optim.sky_from { self.batch.len() as u64 } else { 0 };
        (0..rays).map(|r| rng.uniform(r)).collect()
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
    /// Finds suns and what hides them anew if that is due.
    fn update_suns(&mut self, progress: f32) {
        let m = &mut self.model;
        let due = m.config.light.sun_updates_by(progress);
        if due <= m.sun_updates {
            return;
        }
        let visibility = Visibility::of(&m.field, &m.occupancy, m.shaded_cube(), m.config.light.sun_cells);
        let pixels = self.lit_pixels();
        let m = &mut self.model;
        for (l, pixels) in pixels.iter().enumerate() {
            let known = (m.sun_updates > 0).then(|| Vec3::from_slice(&m.suns.values[SUN * l..]));
            let found = sun::fit(pixels, &visibility, known);
            m.suns.values[SUN * l..][..SUN].copy_from_slice(&found.sun);
            m.lights.values[LIGHT * l..][..LIGHT].copy_from_slice(&found.sky);
        }
        (m.visibility, m.sun_updates) = (Some(visibility), due);
    }

    /// Training pixels that show surfaces, by light.
    fn lit_pixels(&self) -> Vec<Vec<Lit>> {
        let m = &self.model;
        let lights = m.lights.values.len() / LIGHT;
        let (near, cube, rng) = (m.config.sampling.near, m.cube(), Rng::new(m.config.seed, SUNS));
        let o = DrawOptions { cameras: &self.cameras, first: m.rays, rng, near, cube, error_map: None, observations: &[] };
        let mut batch = RayBatch::default();
        batch.resize(PIXELS_PER_SUN * lights);
        pixels::draw(&self.photographs, &o, &mut batch);
        let seen = m.tracer(Quality::Full).trace_layers(&mut batch, &[&[0.0; 9]], &mut FieldBuffers::default());
        let mut out = vec![Vec::new(); lights];
        for r in (0..batch.len()).filter(|r| batch.counts[*r] && seen.opacity[*r] > SURFACE) {
            let values = &seen.rgb[r * CHANNELS..][..CHANNELS];
            let at = |v: &[f32]| Vec3::from_slice(&v[3 * r..]);
            let point = at(&batch.origins) + at(&batch.dirs) * (seen.depth[r] / seen.opacity[r]);
            let target = Vec3::from_slice(&batch.target[4 * r..]);
            let lit = Lit {
                point,
                normal: Vec3::from_slice(&values[NORMAL..]).normalize_or(Vec3::Z),
                albedo: Vec3::from_slice(values) / seen.opacity[r],
                seen: Vec3::from(target.to_array().map(linear_from_srgb)),
            };
            out[m.light_of[batch.images[r] as usize] as usize].push(lit);
        }
        out
    }

    /// The loss's weights at a step.
    fn weights(&self, step: u64) -> Weights {
        let (c, settled) = (&self.model.config, step >= SETTLED);
        Weights {
            huber: c.loss.huber,
            robust: if settled { c.loss.robust * self.model.median } else { 0.0 },
            orientation: c.loss.orientation,
            shadow: if settled { c.loss.shadow } else { 1.0 },
            negative: c.loss.negative,
            distortion: c.loss.distortion,
            masked_sky: c.loss.masked_sky,
            likely_sky: c.loss.likely_sky,
            gauge: c.loss.gauge,
            tie: c.normals.tie,
            push: c.normals.push,
            lit: c.normals.lit,
        }
    }

    /// One optimizer step of lights, skies, gains and suns.
    fn update_lights(&mut self, step: u64, progress: f32, tables: &SceneGradients) {
        let m = &mut self.model;
        m.median = 0.95 * m.median + 0.05 * tables.median;
        let groups = [(&mut m.lights, &tables.lights), (&mut m.skies, &tables.skies), (&mut m.gains, &tables.gains)];
        for (group, d) in groups.into_iter().chain((!tables.suns.is_empty()).then_some((&mut m.suns, &tables.suns))) {
            group.grads.copy_from_slice(d);
            let waits = group.name == "skies" && progress < m.config.optim.sky_from;
            group.step(step as u32 + 1, if waits { 0.0 } else { group.schedule.scale(progress) * m.rate_scale });
        }
        // The direction has no gradient; light is not negative.
        m.suns.values.chunks_exact_mut(SUN).for_each(|s| s[3..].iter_mut().for_each(|v| *v = v.max(0.0)));
    }
}

/// Gives each light the brightness of its photographs, and each sky the color of what is bright and blue among the highest rays.
fn first_lights(model: &mut SceneModel, photographs: &StoredPhotographs, cameras: &[PosedCamera]) {
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
        let brightness = of.iter().map(|r| gray(&linear(*r))).sum::<f32>() / of.len() as f32;
        model.lights.values[LIGHT * l..][..LIGHT].iter_mut().for_each(|v| *v *= brightness / FIRST_BRIGHTNESS);
        of.sort_by(|a, b| batch.dirs[3 * b + 2].total_cmp(&batch.dirs[3 * a + 2]));
        of.truncate(of.len().div_ceil(HIGHEST));
        of.sort_by(|a, b| batch.target[4 * a + 2].total_cmp(&batch.target[4 * b + 2]));
        let sky = linear(of[of.len() * 3 / 4]);
        // The first basis function is 0.2821.
        (0..3).for_each(|k| model.skies.values[l * SKY + k] = sky[k] / 0.282_094_8);
    }
}

/// Scales what depends on the direction: all but the first coefficient of each light.
fn scale_directed(lights: &mut [f32], by: f32) {
    lights.chunks_exact_mut(LIGHT).for_each(|l| l[3..].iter_mut().for_each(|v| *v *= by));
}

impl Trainee for Trainer<'_> {
    type Error = crate::error::PipelineError;

    fn step(&mut self, step: u64, progress: f64) -> Result<StepReport> {
        if self.view.is_some_and(RunView::wants_update) {
            self.show();
        }
        self.update_suns(progress as f32);
        self.draw();
        let n = self.batch.len();
        let c = self.model.config.clone();
        let light: Vec<u32> = self.batch.images.iter().map(|i| self.model.light_of[*i as usize]).collect();
        let codes = self.gray(&light, step);
        let target: Vec<f32> = self.batch.target.chunks_exact(4).flat_map(|t| [t[0], t[1], t[2]]).collect();
        let alpha: Vec<f32> = self.batch.target.iter().skip(3).step_by(4).copied().collect();
        let noise = self.noise(step, progress as f32);
        let counts: Vec<f32> = self.batch.counts.iter().map(|c| *c as u32 as f32).collect();
        self.model.field.normals = Some(c.normals.of(progress as f32));
        let directed = c.optim.directed(progress as f32);
        let mut lights = self.model.lights.values.clone();
        scale_directed(&mut lights, directed);
        let suns = self.model.suns.values.clone();
        // Taken out of the model, whose field the step changes.
        let visibility = self.model.visibility.take();
        let loss = SceneLoss {
            weights: self.weights(step),
            target: &target,
            alpha: &alpha,
            noise: &noise,
            counts: &counts,
            dirs: &self.batch.dirs,
            light: &light,
            image: &self.batch.images,
            lights: &lights,
            skies: &self.model.skies.values,
            gains: &self.model.gains.values,
            suns: visibility.as_ref().map(|visibility| Suns { values: &suns, visibility, origins: &self.batch.origins }),
            out: Mutex::default(),
        };
        let background: Vec<f32> = (0..n).flat_map(|_| [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]).collect();
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
        let done = self.device.step(&mut Trainees { occupancy, ..Trainees::of(field) }, None, &described, 1);
        let mut tables = loss.out.into_inner().expect("the step is over");
        self.model.visibility = visibility;
        let done = done?;
        scale_directed(&mut tables.lights, directed);
        if done.shown.loss.is_finite() {
            self.model.rays += n as u64;
            self.update_lights(step, progress as f32, &tables);
        }
        let scalars = self.scalars(tables.mse, n, done.shown.trained);
        Ok(StepReport { loss: done.shown.loss, scalars })
    }

    fn save(&mut self, step: u64, seconds: f64) -> Result<bool> {
        if self.model.params().is_broken() {
            return Ok(false);
        }
        (self.model.origin.step, self.model.origin.seconds) = (step, seconds);
        let solid = self.model.visibility.as_ref().map_or(Vec::new(), Visibility::numbers);
        let (entries, metadata) = self.model.entries(&solid);
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
