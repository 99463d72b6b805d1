//! The light's stage of training: what is told apart at its beginning, and its steps.

use super::super::model::Around;
use super::super::normal_maps::NormalMaps;
use super::super::shading::{LIGHT, SceneGradients, SceneLoss, Suns, TracedLight, Weights};
use super::super::sun::{self, SUN, Seen, gray};
use super::super::sunlit::sun_code;
use super::super::visibility::Visibility;
use super::{SETTLED, Trainer, WithoutGlass};
use crate::error::{PipelineError, Result};
use diorama_engine::fields::FieldBuffers;
use diorama_engine::renderers::traced::Traced;
use diorama_engine::renderers::volume::{Quality, Tracer};
use diorama_engine::samplers::RayBatch;
use diorama_engine::samplers::pixels::{self, DrawOptions, PixelSource};
use diorama_engine::step::{GivenRays, Loss, Trainees};
use diorama_engine::train::{Event, StepReport};
use diorama_geom::color::linear_from_srgb;
use diorama_geom::glam::Vec3;
use diorama_geom::rng::Rng;
use rayon::prelude::*;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};

/// Streams of random numbers.
const NOISE: u64 = 12;
const SUNS: u64 = 13;
const TAUGHT: u64 = 14;
/// Pixels from which the light of all lights together is told apart: most in all, least and most for each light, and one in how many of the
/// photographs' at most.
const TELLING: (usize, usize, usize) = (40_000, 1000, 6000);
const TELLS: usize = 4;
/// Rate of suns and lights apart over that of lights that hold suns: these begin with little.
const APART: f32 = 0.1;
/// Weight of shadows that are traced in a sun apart over that of learned ones: most are a little off.
const APART_SHADOW: f32 = 1.0 / 30.0;
/// Steps after which what surfaces send is found anew.
const SENT_EVERY: u64 = 100;
/// Opacity from which a pixel shows a surface.
const SURFACE: f32 = 0.9;
/// Standard deviation of noise on the light that the shadow sees.
const LIGHT_NOISE: f32 = 0.01;
/// The same on the direction of a sun apart, and share of the rays whose shadow reads none.
const SUN_NOISE: f32 = 0.25;
const UNREAD: f32 = 0.25;
/// Every so many rays, one teaches the shadow of a sun that no photograph has.
const TAUGHT_RAYS: usize = 3;

/// Light that shadows are traced in, ray by ray, and what the shadow's head reads of it.
#[derive(Default)]
struct Taught {
    /// `[R, 6]`, `[R, 9, 3]` and `[R, 9]`
    suns: Vec<f32>,
    skies: Vec<f32>,
    codes: Vec<f32>,
}

impl Trainer<'_> {
    /// Goes on to the stage of light: suns, skies and what hides them are found on the surfaces as they are.
    /// After an interrupt, nothing has changed.
    pub(super) fn begin_light(&mut self, step: u64, interrupt: &AtomicBool, events: &mut dyn FnMut(&Event)) -> Result<()> {
        let mut progress = |share: f64| events(&Event::Preparing { what: "telling light from albedo", share });
        progress(0.0);
        let m = &self.model;
        let normals = NormalMaps::of(m, &self.cameras);
        let (cube, cells) = (m.shaded_cube(), m.config.light.sun_cells);
        let mut visibility = Visibility::within(&m.field, &m.occupancy, cube, cells, &self.cameras);
        let seen = self.seen(&normals);
        if seen.is_empty() {
            let what = format!("after {step} steps, no surface is opaque: there is nothing to tell light from; give more --steps");
            return Err(PipelineError::Usage(what));
        }
        visibility.lift_from(&seen.iter().map(|s| (s.point, s.normal)).collect::<Vec<_>>());
        let Some((fitted, surfaces)) = sun::tell_apart(&seen, &visibility, interrupt, &mut progress) else { return Ok(()) };
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
        (m.surroundings, self.normals) = (Some(Arc::new(Around { visibility: Arc::new(visibility), surfaces })), Some(normals));
        m.begin_light()?;
        self.ambients = m.ambients();
        (m.began, m.median) = (step, 0.1);
        let scene = m.scene();
        let trainees = Trainees { occupancy: Some(&mut m.occupancy), ..Trainees::of(&mut m.field) };
        self.device.begin(&trainees, scene, None)
    }

    /// Random surface points of the photographs as they look in every light.
    fn seen(&self, normals: &NormalMaps) -> Vec<Seen> {
        let m = &self.model;
        let (field, lights) = (m.with_shared_codes(), m.light_count());
        let (all, least, most) = TELLING;
        let pixels: usize = (0..self.photographs.images()).map(|i| self.photographs.size(i)).map(|(w, h)| (w * h) as usize).sum();
        let mut batch = self.pixels((all / lights.max(1)).min(pixels / TELLS).clamp(least, most));
        let mut out: Vec<Seen> = Vec::new();
        for l in 0..lights {
            let tracer = Tracer { field: &field, appearance: Some(l as u32), ..m.tracer(Quality::Full) };
            let traced = tracer.trace_layers(&mut batch, &[], &mut FieldBuffers::default());
            let pixel = |r: usize| (batch.images[r] as usize, batch.pixels[2 * r], batch.pixels[2 * r + 1]);
            let shown = (0..batch.len()).filter(|r| batch.counts[*r]).filter_map(|r| {
                let (image, x, y) = pixel(r);
                let normal = normals.at(image, x, y);
                (traced.opacity[r] > SURFACE && normal != Vec3::ZERO).then_some((r, normal))
            });
            for (i, (r, normal)) in shown.enumerate() {
                if l == 0 {
                    let (image, x, y) = pixel(r);
                    let is_flat = normals.is_flat(image, x, y);
                    out.push(Seen { point: point(&batch, &traced, r), normal, colors: Vec::new(), shown: Vec::new(), is_flat });
                }
                let color = [0, 1, 2].map(|k| linear_from_srgb((traced.rgb[3 * r + k] / traced.opacity[r]).clamp(0.0, 1.0)));
                out[i].colors.push(Vec3::from(color));
            }
        }
        let lit_by = |l: usize| m.light_of.iter().enumerate().filter(move |(_, of)| **of as usize == l).map(|(image, _)| image);
        out.par_iter_mut().for_each(|s| s.shown = (0..lights).map(|l| lit_by(l).any(|image| normals.shows(image, s.point))).collect());
        out
    }

    /// Random training pixels, apart from those that steps draw.
    fn pixels(&self, n: usize) -> RayBatch {
        let m = &self.model;
        let (near, cube, rng) = (m.config.sampling.near, m.cube(), Rng::new(m.config.seed, SUNS));
        let o = DrawOptions { cameras: &self.cameras, first: m.rays, rng, near, cube, error_map: None, observations: &[] };
        let mut batch = RayBatch::default();
        batch.resize(n);
        pixels::draw(&WithoutGlass(&self.photographs), &o, &mut batch);
        batch
    }

    /// Replaces every second ray by one through a neighbor of the pixel before, to its right or below.
    fn pair(&mut self) {
        let (source, b) = (WithoutGlass(&self.photographs), &mut self.batch);
        let stride = source.stride();
        for r in (1..b.len()).step_by(2) {
            let (image, at) = (b.images[r - 1], [0, 1].map(|k| b.pixels[2 * (r - 1) + k] as u32));
            let size: [u32; 2] = source.size(image as usize).into();
            let (axis, mut to) = (r / 2 % 2, at);
            to[axis] = if at[axis] + stride < size[axis] { at[axis] + stride } else { at[axis].saturating_sub(stride) };
            let (x, y) = source.snap(image as usize, to[0], to[1]);
            b.images[r] = image;
            b.pixels[2 * r..2 * r + 2].copy_from_slice(&[x as f32 + 0.5, y as f32 + 0.5]);
            b.target[4 * r..4 * r + 4].copy_from_slice(&source.rgba(image as usize, x, y));
            b.counts[r] = source.counts(image as usize, x, y);
        }
        pixels::rays(&self.cameras, self.model.config.sampling.near, self.model.cube(), &mut self.batch);
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
            sky.iter_mut().zip(sun::harmonics(&sun)).for_each(|(v, s)| *v -= s);
            if r % TAUGHT_RAYS == 0 {
                let at = |k: u64| rng.uniform(4 * r as u64 + k);
                let (z, turn) = (0.05 + 0.95 * at(0), std::f32::consts::TAU * at(1));
                let across = (1.0 - z * z).max(0.0).sqrt();
                sun[..3].copy_from_slice(&[across * turn.cos(), across * turn.sin(), z]);
                let (power, clear) = (2.0 * at(2), 0.3 + at(3));
                sun[3..].iter_mut().for_each(|v| *v *= power);
                sky.iter_mut().for_each(|v| *v *= clear);
                all = sky;
                all.iter_mut().zip(sun::harmonics(&sun)).for_each(|(v, s)| *v += s);
            }
            out.suns.extend(sun);
            out.skies.extend(sky);
            out.codes.extend((0..9).map(|i| gray(&all[3 * i..]) + LIGHT_NOISE * noise.normal((9 * r + i) as u64)));
        }
        out
    }

    /// What shadows read of the rays' suns: as of any sun, with noise, and of some rays nothing, as where there is no sun; and as they are.
    fn sun_codes(&self, light: &[u32], step: u64) -> [Vec<f32>; 2] {
        let (noise, rng) = (self.rng(NOISE, step), self.rng(TAUGHT, step));
        let exact = |l: &u32| sun_code(&self.model.suns.values[SUN * *l as usize..][..SUN]);
        let of_ray = |(r, l): (usize, &u32)| {
            let mut code = exact(l);
            let is_read = code != [0.0; 9] && rng.uniform(r as u64) > UNREAD;
            (0..3).for_each(|i| code[i] = if is_read { code[i] + SUN_NOISE * noise.normal((3 * r + i) as u64) } else { 0.0 });
            code
        };
        [light.iter().enumerate().flat_map(of_ray).collect(), light.iter().flat_map(exact).collect()]
    }

    /// One step of the light's stage.
    pub(super) fn relight(&mut self, step: u64, share: f32) -> Result<StepReport> {
        self.draw();
        let c = self.model.config.clone();
        if c.loss.retinex > 0.0 {
            self.pair();
        }
        let (n, mut drawn) = (self.batch.len(), self.drawn());
        let is_apart = c.light.has_sun();
        // Where suns are apart, shadows are traced and not learned.
        let taught = if is_apart { Taught::default() } else { self.taught(&drawn.light, step) };
        if !is_apart {
            drawn.counts.iter_mut().step_by(TAUGHT_RAYS).for_each(|c| *c = 0.0);
        }
        let maps = self.normals.as_ref().expect("the light's stage");
        let normal = |r: usize| maps.at(self.batch.images[r] as usize, self.batch.pixels[2 * r], self.batch.pixels[2 * r + 1]);
        let normals: Vec<f32> = (0..n).flat_map(|r| normal(r).to_array()).collect();
        let (lights, suns) = (self.model.lights.values.clone(), self.model.suns.values.clone());
        // Apart from the model, whose field the step changes.
        let around = self.model.surroundings.clone().expect("the light's stage");
        let (visibility, ambients) = (&around.visibility, &self.ambients[..]);
        let origins = &self.batch.origins[..];
        let settled = step >= self.model.began + SETTLED;
        let loss = SceneLoss {
            weights: Weights {
                huber: c.loss.huber,
                robust: if settled { c.loss.robust * self.model.median } else { 0.0 },
                shadow: if is_apart { APART_SHADOW * c.loss.shadow } else { c.loss.shadow },
                traced: c.loss.traced,
                negative: c.loss.negative,
                gauge: c.loss.gauge,
                tie: c.loss.normal,
                retinex: c.loss.retinex,
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
            suns: is_apart.then_some(Suns { values: &suns, ambients, visibility, origins, seed: step as u32 }),
            bends: is_apart && settled,
            traced: (!is_apart).then_some(TracedLight { suns: &taught.suns, skies: &taught.skies, visibility, origins, seed: step as u32 }),
            out: Mutex::default(),
        };
        let of_suns = if is_apart { self.sun_codes(&drawn.light, step) } else { [Vec::new(), Vec::new()] };
        let codes = if is_apart { vec![&of_suns[0][..], &of_suns[1]] } else { vec![&taught.codes[..]] };
        let background = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0][..self.model.field.channels()].repeat(n);
        let given = given(&self.batch, &drawn.light, &background, &codes);
        let described = self.described(step - self.model.began, share, given, Loss::Batch(&loss));
        let (field, occupancy) = (&mut self.model.field, Some(&mut self.model.occupancy));
        let done = self.device.step(&mut Trainees { occupancy, ..Trainees::of(field) }, None, &described, 1);
        let tables = loss.out.into_inner().expect("the step is over");
        let done = done?;
        if done.shown.loss.is_finite() {
            self.model.count(n, done.shown.trained);
            self.update_lights(step - self.model.began, share, &tables);
        }
        Ok(StepReport { loss: done.shown.loss, scalars: self.scalars(tables.mse, n, done.shown.trained) })
    }

    /// One optimizer step of lights, skies and gains; where suns are apart, of their power, too, and what surfaces send follows.
    fn update_lights(&mut self, step: u64, share: f32, tables: &SceneGradients) {
        let m = &mut self.model;
        m.median = 0.95 * m.median + 0.05 * tables.median;
        let is_apart = m.config.light.has_sun();
        let (slow, suns) = if is_apart { (APART, Some((&mut m.suns, &tables.suns, APART))) } else { (1.0, None) };
        let all = [(&mut m.skies, &tables.skies, 1.0), (&mut m.gains, &tables.gains, 1.0), (&mut m.lights, &tables.lights, slow)];
        for (group, d, by) in all.into_iter().chain(suns) {
            group.grads.copy_from_slice(d);
            group.step(step as u32 + 1, by * group.schedule.scale(share) * m.rate_scale);
        }
        if !is_apart {
            return;
        }
        m.suns.values.chunks_exact_mut(SUN).flat_map(|s| &mut s[3..]).for_each(|v| *v = v.max(0.0));
        if step > 0 && step.is_multiple_of(SENT_EVERY) {
            m.send_again();
            self.ambients = m.ambients();
        }
        let skies = m.lights.values.chunks_exact(LIGHT);
        self.ambients.iter_mut().zip(skies).for_each(|(a, sky)| a.sky.copy_from_slice(sky));
    }
}

/// Where a ray of a batch meets its surface.
fn point(batch: &RayBatch, traced: &Traced, r: usize) -> Vec3 {
    let at = |v: &[f32]| Vec3::from_slice(&v[3 * r..]);
    at(&batch.origins) + at(&batch.dirs) * (traced.depth[r] / traced.opacity[r])
}

/// The rays of a batch with their codes, before a background `[R, C]`.
fn given<'b>(batch: &'b RayBatch, light: &'b [u32], background: &'b [f32], codes: &'b [&'b [f32]]) -> GivenRays<'b> {
    GivenRays { images: light, origins: &batch.origins, dirs: &batch.dirs, far: &[], jitter: &batch.jitter, target: &[], background, codes }
}
