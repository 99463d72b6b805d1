//! Training of the scene model: draws pixels, describes each step, and updates the lights.

use super::config::Stage;
use super::model::SceneModel;
use super::normal_maps::NormalMaps;
use super::shading::{CHANNELS, LIGHT, SKY, SceneGradients, SceneLoss, Suns, TracedLight, Weights, gray};
use super::sun::{self, Lit, SUN, Seen};
use super::viewing::RunView;
use super::visibility::Visibility;
use crate::error::Result;
use crate::run::device::{Device, Pictures};
use crate::run::photographs::StoredPhotographs;
use diorama_data::checkpoint;
use diorama_engine::fields::FieldBuffers;
use diorama_engine::renderers::traced::Traced;
use diorama_engine::renderers::volume::{Quality, Tracer};
use diorama_engine::samplers::RayBatch;
use diorama_engine::samplers::pixels::{self, DrawOptions, Observation};
use diorama_engine::samplers::placement::Placement;
use diorama_engine::step::{Backdrop, GivenRays, Loss, Probes, RaySource, Step, Trainees};
use diorama_engine::train::{Scalar, Scalars, StepReport, Trainee};
use diorama_geom::color::linear_from_srgb;
use diorama_geom::glam::Vec3;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::photometric_loss::{ColorLoss, Terms};
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::path::Path;
use std::sync::Mutex;

/// Streams of random numbers.
const PIXELS: u64 = 10;
const OCCUPANCY: u64 = 11;
const NOISE: u64 = 12;
const SUNS: u64 = 13;
const TAUGHT: u64 = 14;
const SKIES: u64 = 15;
const BACKGROUND: u64 = 16;
/// Rays of each light from whose highest ones the sky's first color comes, and their share.
const SKY_RAYS: usize = 4000;
const HIGHEST: usize = 10;
/// Pixels from which the light of all lights together is told apart: most in all, least and most for each light.
const TELLING: (usize, usize, usize) = (40_000, 1000, 6000);
/// Pixels from which a sun is found anew.
const PIXELS_PER_SUN: usize = 4000;
/// Opacity from which a pixel shows a surface.
const SURFACE: f32 = 0.9;
/// Standard deviation of noise on the light that the shadow sees.
const LIGHT_NOISE: f32 = 0.01;
/// Every so many rays, one teaches the shadow of a sun that no photograph has.
const TAUGHT_RAYS: usize = 3;
/// Steps during which an occupancy sample stands for a block of cells, and that block's edge.
const OCCUPANCY_WARMUP: (u64, usize) = (256, 2);
/// Distance in inner cubes within which samples learn more slowly, so that no fog gathers at the cameras.
const NEAR: f32 = 1.0;
/// Steps between which the number of rays grows to what is wanted, and their number at most.
const BATCH_RAMP: (u64, u64) = (256, 1024);
const MOST_RAYS: usize = 16_384;
/// How much longer a march's steps are at first, and until which step.
const MARCH_RAMP: (f32, u64) = (16.0, 1024);
/// Steps in which the distortion's weight grows.
const DISTORTION_RAMP: u64 = 2000;
/// Steps before robust weights begin.
const SETTLED: u64 = 200;

/// A model in training.
pub(super) struct Trainer<'a> {
    pub model: SceneModel,
    photographs: StoredPhotographs,
    observations: Vec<Observation>,
    cameras: Vec<PosedCamera>,
    device: Device,
    batch: RayBatch,
    checkpoints: &'a Path,
    pub view: Option<&'a RunView>,
    recovered: bool,
    /// Normals of the surfaces, once they stay.
    normals: Option<NormalMaps>,
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
    pub fn new(
        mut model: SceneModel,
        photographs: StoredPhotographs,
        observations: Vec<Observation>,
        checkpoints: &'a Path,
    ) -> Result<Trainer<'a>> {
        let (cameras, scene) = (model.cameras(), model.scene());
        if model.origin.step == 0 {
            first_skies(&mut model, &photographs, &cameras);
        }
        let normals = (model.stage == Stage::Light).then(|| NormalMaps::of(&model, &cameras));
        let mut device = Device::cpu(None);
        let occupancy = Some(&mut model.occupancy);
        device.begin(&Trainees { occupancy, ..Trainees::of(&mut model.field) }, scene, None)?;
        Ok(Trainer {
            model,
            photographs,
            observations,
            cameras,
            device,
            batch: RayBatch::default(),
            checkpoints,
            view: None,
            recovered: false,
            normals,
        })
    }

    /// Shows the model in the viewer.
    pub fn show(&self) {
        self.view.into_iter().for_each(|v| v.show_model(self.model.for_rendering()));
    }

    /// Rays of a step: as many as give about the wanted number of samples, fewer at first.
    fn rays(&self, step: u64) -> usize {
        let s = &self.model.config.sampling;
        if s.rays > 0 {
            return s.rays;
        }
        let (from, until) = BATCH_RAMP;
        let grown = step.saturating_sub(from) as f64 / (until - from) as f64;
        let n = s.batch_samples as f64 * (0.25 + 0.75 * grown.min(1.0)) / self.model.samples_per_ray.max(1.0);
        (n as usize).clamp(64, MOST_RAYS).next_multiple_of(64)
    }

    /// Fills the batch with random training pixels.
    fn draw(&mut self, step: u64) {
        let rays = self.rays(step);
        let m = &self.model;
        let rng = Rng::new(m.config.seed, PIXELS);
        let (near, cube) = (m.config.sampling.near, m.cube());
        let o = DrawOptions { cameras: &self.cameras, first: m.rays, rng, near, cube, error_map: None, observations: &[] };
        self.batch.resize(rays);
        pixels::draw(&self.photographs, &o, &mut self.batch);
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

/// Light that shadows are traced in, ray by ray, and what the shadow's head reads of it.
struct Taught {
    /// `[R, 9]`, `[R, 9, 3]` and `[R, 9]`
    suns: Vec<f32>,
    skies: Vec<f32>,
    codes: Vec<f32>,
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
            depth: m.config.loss.depth,
            alpha: 0.0,
        };
        let rays = RaySource::Photographs { count: self.rays(step), rng: of(PIXELS) };
        let placement = Placement::Occupancy { march, pruning: m.pruning() };
        let described = Step {
            backdrop: Backdrop::Random(of(BACKGROUND)),
            probes: is_probed.then(|| Probes {
                rng: of(OCCUPANCY),
                points: s.occupancy_points,
                block: if step <= until { block } else { 1 },
            }),
            near_scaling: NEAR,
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

    /// Goes on to the stage of light: suns, skies and what hides them are found on the surfaces as they are.
    fn begin_light(&mut self, step: u64) -> Result<()> {
        let m = &self.model;
        let normals = NormalMaps::of(m, &self.cameras);
        let visibility = Visibility::of(&m.field, &m.occupancy, m.shaded_cube(), m.config.light.sun_cells);
        self.model.share_codes();
        let (fitted, _) = sun::tell_apart(&self.seen(&normals), &visibility);
        let m = &mut self.model;
        let is_apart = m.config.light.has_sun();
        for (l, found) in fitted.iter().enumerate() {
            m.suns.values[SUN * l..][..SUN].copy_from_slice(&found.sun);
            m.lights.values[LIGHT * l..][..LIGHT].copy_from_slice(&found.sky);
            if !is_apart {
                let light = &mut m.lights.values[LIGHT * l..][..LIGHT];
                light.iter_mut().zip(sun::harmonics(&found.sun)).for_each(|(v, s)| *v += s);
            }
        }
        (m.visibility, self.normals) = (Some(visibility), Some(normals));
        m.begin_light()?;
        (m.began, m.median) = (step, 0.1);
        let scene = m.scene();
        let trainees = Trainees { occupancy: Some(&mut m.occupancy), ..Trainees::of(&mut m.field) };
        self.device.begin(&trainees, scene, None)
    }

    /// Random surface points of the photographs as they look in every light.
    fn seen(&self, normals: &NormalMaps) -> Vec<Seen> {
        let m = &self.model;
        let lights = m.light_count();
        let (all, least, most) = TELLING;
        let mut batch = self.pixels((all / lights.max(1)).clamp(least, most));
        let mut out: Vec<Seen> = Vec::new();
        for l in 0..lights {
            let tracer = Tracer { appearance: Some(l as u32), ..m.tracer(Quality::Full) };
            let traced = tracer.trace_layers(&mut batch, &[], &mut FieldBuffers::default());
            let shown = (0..batch.len()).filter(|r| batch.counts[*r]).filter_map(|r| {
                let normal = normals.at(batch.images[r] as usize, batch.pixels[2 * r], batch.pixels[2 * r + 1]);
                (traced.opacity[r] > SURFACE && normal != Vec3::ZERO).then_some((r, normal))
            });
            for (i, (r, normal)) in shown.enumerate() {
                if l == 0 {
                    out.push(Seen { point: point(&batch, &traced, r), normal, colors: Vec::new() });
                }
                let color = [0, 1, 2].map(|k| linear_from_srgb((traced.rgb[3 * r + k] / traced.opacity[r]).clamp(0.0, 1.0)));
                out[i].colors.push(Vec3::from(color));
            }
        }
        out
    }

    /// Random training pixels, apart from those that steps draw.
    fn pixels(&self, n: usize) -> RayBatch {
        let m = &self.model;
        let (near, cube, rng) = (m.config.sampling.near, m.cube(), Rng::new(m.config.seed, SUNS));
        let o = DrawOptions { cameras: &self.cameras, first: m.rays, rng, near, cube, error_map: None, observations: &[] };
        let mut batch = RayBatch::default();
        batch.resize(n);
        pixels::draw(&self.photographs, &o, &mut batch);
        batch
    }

    /// Finds suns anew if that is due.
    fn update_suns(&mut self, share: f32) {
        let due = self.model.config.light.sun_updates_by(share);
        if due <= self.model.sun_updates {
            return;
        }
        let pixels = self.lit_pixels();
        let m = &mut self.model;
        m.sun_updates = due;
        let visibility = m.visibility.as_ref().expect("the light's stage");
        for (l, pixels) in pixels.iter().enumerate() {
            let known = Vec3::from_slice(&m.suns.values[SUN * l..]);
            let found = sun::fit(pixels, visibility, Some(known));
            m.suns.values[SUN * l..][..SUN].copy_from_slice(&found.sun);
            m.lights.values[LIGHT * l..][..LIGHT].copy_from_slice(&found.sky);
        }
    }

    /// Training pixels that show surfaces, by light.
    fn lit_pixels(&self) -> Vec<Vec<Lit>> {
        let (m, normals) = (&self.model, self.normals.as_ref().expect("the light's stage"));
        let lights = m.light_count();
        let mut batch = self.pixels(PIXELS_PER_SUN * lights);
        let seen = m.tracer(Quality::Full).trace_layers(&mut batch, &[&[0.0; 9]], &mut FieldBuffers::default());
        let mut out = vec![Vec::new(); lights];
        for r in (0..batch.len()).filter(|r| batch.counts[*r] && seen.opacity[*r] > SURFACE) {
            let normal = normals.at(batch.images[r] as usize, batch.pixels[2 * r], batch.pixels[2 * r + 1]);
            if normal == Vec3::ZERO {
                continue;
            }
            let albedo = Vec3::from_slice(&seen.rgb[r * CHANNELS..]) / seen.opacity[r];
            let target = [0, 1, 2].map(|k| linear_from_srgb(batch.target[4 * r + k]));
            let lit = Lit { point: point(&batch, &seen, r), normal, albedo, seen: Vec3::from(target) };
            out[m.light_of[batch.images[r] as usize] as usize].push(lit);
        }
        out
    }

    /// The lights of the rays; every [`TAUGHT_RAYS`]th ray has a sun of its own. Shadows read a little noise besides.
    fn taught(&self, light: &[u32], step: u64) -> Taught {
        let (m, rng, noise) = (&self.model, self.rng(TAUGHT, step), self.rng(NOISE, step));
        let mut out = Taught { suns: Vec::new(), skies: Vec::new(), codes: Vec::new() };
        for (r, l) in light.iter().enumerate() {
            let l = *l as usize;
            let mut sun: [f32; SUN] = std::array::from_fn(|i| m.suns.values[SUN * l + i]);
            let mut all: [f32; LIGHT] = std::array::from_fn(|i| m.lights.values[LIGHT * l + i]);
            let mut sky = all;
            match m.config.light.has_sun() {
                true => all.iter_mut().zip(sun::harmonics(&sun)).for_each(|(v, s)| *v += s),
                false => sky.iter_mut().zip(sun::harmonics(&sun)).for_each(|(v, s)| *v -= s),
            }
            if r % TAUGHT_RAYS == 0 {
                let at = |k: u64| rng.uniform(4 * r as u64 + k);
                let (z, turn) = (0.05 + 0.95 * at(0), std::f32::consts::TAU * at(1));
                let across = (1.0 - z * z).max(0.0).sqrt();
                sun[..3].copy_from_slice(&[across * turn.cos(), across * turn.sin(), z]);
                let (power, clear) = (2.0 * at(2), 0.3 + at(3));
                sun[3..6].iter_mut().for_each(|v| *v *= power);
                sun[6..].iter_mut().chain(&mut sky).for_each(|v| *v *= clear);
                all = sky;
                all.iter_mut().zip(sun::harmonics(&sun)).for_each(|(v, s)| *v += s);
            }
            out.suns.extend(sun);
            out.skies.extend(sky);
            out.codes.extend((0..9).map(|i| gray(&all[3 * i..]) + LIGHT_NOISE * noise.normal((9 * r + i) as u64)));
        }
        out
    }

    /// One step of the light's stage.
    fn relight(&mut self, step: u64, share: f32) -> Result<StepReport> {
        self.update_suns(share);
        self.draw(step);
        let (n, mut drawn, c) = (self.batch.len(), self.drawn(), self.model.config.clone());
        let taught = self.taught(&drawn.light, step);
        let is_apart = c.light.has_sun();
        if !is_apart {
            drawn.counts.iter_mut().step_by(TAUGHT_RAYS).for_each(|c| *c = 0.0);
        }
        let maps = self.normals.as_ref().expect("the light's stage");
        let normal = |r: usize| maps.at(self.batch.images[r] as usize, self.batch.pixels[2 * r], self.batch.pixels[2 * r + 1]);
        let normals: Vec<f32> = (0..n).flat_map(|r| normal(r).to_array()).collect();
        let (lights, suns) = (self.model.lights.values.clone(), self.model.suns.values.clone());
        // Taken out of the model, whose field the step changes.
        let visibility = self.model.visibility.take().expect("the light's stage");
        let origins = &self.batch.origins[..];
        let settled = step >= self.model.began + SETTLED;
        let loss = SceneLoss {
            weights: Weights {
                huber: c.loss.huber,
                robust: if settled { c.loss.robust * self.model.median } else { 0.0 },
                shadow: c.loss.shadow,
                traced: c.loss.traced,
                negative: c.loss.negative,
                gauge: c.loss.gauge,
                tie: c.loss.normal,
            },
            target: &drawn.target,
            counts: &drawn.counts,
            normals: &normals,
            dirs: &self.batch.dirs,
            light: &drawn.light,
            image: &self.batch.images,
            lights: &lights,
            skies: &self.model.skies.values,
            gains: &self.model.gains.values,
            suns: is_apart.then_some(Suns { values: &suns, visibility: &visibility, origins }),
            traced: (!is_apart).then_some(TracedLight { suns: &taught.suns, skies: &taught.skies, visibility: &visibility, origins }),
            out: Mutex::default(),
        };
        let codes = [&taught.codes[..]];
        let background = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0].repeat(n);
        let given = given(&self.batch, &drawn.light, &background, &codes);
        let described = self.described(step - self.model.began, share, given, Loss::Batch(&loss));
        let (field, occupancy) = (&mut self.model.field, Some(&mut self.model.occupancy));
        let done = self.device.step(&mut Trainees { occupancy, ..Trainees::of(field) }, None, &described, 1);
        let tables = loss.out.into_inner().expect("the step is over");
        self.model.visibility = Some(visibility);
        let done = done?;
        if done.shown.loss.is_finite() {
            self.model.count(n, done.shown.trained);
            self.update_lights(step - self.model.began, share, &tables);
        }
        Ok(StepReport { loss: done.shown.loss, scalars: self.scalars(tables.mse, n, done.shown.trained) })
    }

    /// One optimizer step of lights, skies, gains and suns.
    fn update_lights(&mut self, step: u64, share: f32, tables: &SceneGradients) {
        let m = &mut self.model;
        m.median = 0.95 * m.median + 0.05 * tables.median;
        let groups = [(&mut m.lights, &tables.lights), (&mut m.skies, &tables.skies), (&mut m.gains, &tables.gains)];
        for (group, d) in groups.into_iter().chain((!tables.suns.is_empty()).then_some((&mut m.suns, &tables.suns))) {
            group.grads.copy_from_slice(d);
            group.step(step as u32 + 1, group.schedule.scale(share) * m.rate_scale);
        }
        // The direction has no gradient; light is not negative.
        for (sun, sky) in m.suns.values.chunks_exact_mut(SUN).zip(m.lights.values.chunks_exact(LIGHT)) {
            sun[3..6].iter_mut().for_each(|v| *v = v.max(0.0));
            if !tables.suns.is_empty() {
                sun::set_bounced(sun, sky);
            }
        }
    }
}

/// Where a ray of a batch meets its surface.
fn point(batch: &RayBatch, traced: &Traced, r: usize) -> Vec3 {
    let at = |v: &[f32]| Vec3::from_slice(&v[3 * r..]);
    at(&batch.origins) + at(&batch.dirs) * (traced.depth[r] / traced.opacity[r])
}

/// The rays of a batch with their codes, before a background `[R, C]`.
fn given<'b>(batch: &'b RayBatch, light: &'b [u32], background: &'b [f32], codes: &'b [&'b [f32]]) -> GivenRays<'b> {
    GivenRays { images: light, origins: &batch.origins, dirs: &batch.dirs, jitter: &batch.jitter, target: &[], background, codes }
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

    fn step(&mut self, step: u64, progress: f64) -> Result<StepReport> {
        if self.view.is_some_and(RunView::wants_update) {
            self.show();
        }
        match self.model.config.light.stage(progress as f32) {
            (Stage::Surfaces, share) => self.look(step, share),
            (Stage::Light, share) => {
                if self.model.stage == Stage::Surfaces {
                    self.begin_light(step)?;
                }
                self.relight(step, share)
            }
        }
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
