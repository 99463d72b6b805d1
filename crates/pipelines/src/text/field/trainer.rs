//! Training of the field and its classes: draws rays and describes each step.

use super::config::Stage;
use super::label_maps::{self, UNKNOWN};
use super::losses::{LabelLoss, SceneLoss};
use super::model::TextModel;
use crate::error::Result;
use crate::run::device::Device;
use crate::run::photographs::StoredPhotographs;
use diorama_data::checkpoint;
use diorama_engine::renderers::view::View;
use diorama_engine::samplers::RayBatch;
use diorama_engine::samplers::pixels::{self, DrawOptions, Observation, PixelSource};
use diorama_engine::samplers::placement::Placement;
use diorama_engine::step::{Figures, GivenRays, Loss, Probes, RaySource, Step, Trainees};
use diorama_engine::train::{Event, Scalar, Scalars, StepReport, Trainee};
use diorama_geom::rng::Rng;
use diorama_kernels::ops::ray_generation::PosedCamera;
use diorama_kernels::ops::s3im::{self, Tile};
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

/// Streams of random numbers.
const PIXELS: u64 = 10;
const OCCUPANCY: u64 = 11;
const BACKGROUND: u64 = 12;
const TILES: u64 = 13;
const LABELLED: u64 = 14;
/// Steps during which an occupancy sample stands for a block of cells, and that block's edge.
const OCCUPANCY_WARMUP: (u64, usize) = (256, 2);
/// How much longer a march's steps are at first, and the share of the stage in which that ends, at most 1024 steps.
const MARCH_RAMP: (f32, f32) = (16.0, 0.3);
/// Steps in which the distortion's weight grows from nothing.
const DISTORTION_RAMP: f32 = 0.1;

/// Share of a known distance before which nothing is.
const EMPTY: f32 = 0.9;
/// Every so many rays of labels, one is of text, which few pixels are: else the background alone is learned for long.
const TEXT_EVERY: usize = 4;
/// Share of the stage from which on rays weigh as if all pixels were drawn alike, so that outlines find their place.
const EVEN_FROM: f32 = 0.4;

/// Pixels of the training photographs with a class: image, column, row, class; those of text first, and their number.
#[derive(Default)]
struct Labelled {
    pixels: Vec<(u32, u32, u32, u8)>,
    text: usize,
}

impl Labelled {
    fn new(mut pixels: Vec<(u32, u32, u32, u8)>) -> Labelled {
        pixels.sort_by_key(|p| p.3 == 0);
        Labelled { text: pixels.iter().filter(|p| p.3 > 0).count(), pixels }
    }

    /// Chance that a ray draws any given pixel of text over that of all pixels alike, and the same of the background.
    fn chances(&self) -> [f32; 2] {
        let text = self.text as f32 / self.pixels.len().max(1) as f32;
        let every = if self.text > 0 { 1.0 / TEXT_EVERY as f32 } else { 0.0 };
        [every / text.max(f32::MIN_POSITIVE) + 1.0 - every, 1.0 - every]
    }

    /// Pixel of ray `r` for the random number `counter`.
    fn draw(&self, r: usize, rng: &Rng, counter: u64) -> (u32, u32, u32, u8) {
        let among = if self.text > 0 && r.is_multiple_of(TEXT_EVERY) { self.text } else { self.pixels.len() };
        self.pixels[rng.below(counter, among as u64) as usize]
    }
}

/// What a step minimizes and measures.
struct Described<'a> {
    loss: Loss<'a>,
    probes: Option<Probes>,
}

/// A model in training.
pub(super) struct Trainer<'a> {
    pub model: TextModel,
    photographs: StoredPhotographs,
    /// Pixels of known distance.
    observations: Vec<Observation>,
    cameras: Vec<PosedCamera>,
    device: Device,
    batch: RayBatch,
    /// Pixels that were labelled, and those that depth carried labels to; empty in the stage of the scene.
    labelled: [Labelled; 2],
    checkpoints: &'a Path,
    recovered: bool,
}

impl<'a> Trainer<'a> {
    pub fn new(
        model: TextModel,
        (photographs, observations): (StoredPhotographs, Vec<Observation>),
        device: Device,
        checkpoints: &'a Path,
    ) -> Result<Trainer<'a>> {
        let cameras = model.cameras();
        let mut trainer = Trainer {
            model,
            photographs,
            observations,
            cameras,
            device,
            batch: RayBatch::default(),
            labelled: Default::default(),
            checkpoints,
            recovered: false,
        };
        trainer.begin()?;
        Ok(trainer)
    }

    fn trainees(model: &mut TextModel) -> Trainees<'_> {
        let field = match &mut model.classes {
            Some(classes) => classes,
            None => &mut model.field,
        };
        Trainees { occupancy: Some(&mut model.occupancy), ..Trainees::of(field) }
    }

    /// Uploads what is trained in the present stage.
    fn begin(&mut self) -> Result<()> {
        let scene = self.model.scene();
        self.device.begin(&Trainer::trainees(&mut self.model), scene, None)
    }

    fn rng(&self, stream: u64) -> Rng {
        Rng::new(self.model.config.seed, stream)
    }

    /// Carries out a step of the batch's rays over `background` `[R, C]`; they end at distances `far`, where these are given.
    fn carry_out(&mut self, (step, share): (u64, f32), (far, background): (&[f32], &[f32]), described: Described) -> Result<Figures> {
        let Described { loss, probes } = described;
        let m = &self.model;
        let b = &self.batch;
        let given = GivenRays {
            images: &b.images,
            origins: &b.origins,
            dirs: &b.dirs,
            far,
            jitter: &b.jitter,
            target: &[],
            background,
            codes: &[],
        };
        let (most, until) = MARCH_RAMP;
        let ended = match m.stage {
            Stage::Scene => (share / until).min(1.0),
            Stage::Labels => 1.0,
        };
        let march = m.occupancy.march_config(m.config.sampling.max_samples).stretched(most.powf(1.0 - ended));
        let placement = Placement::Occupancy { march, pruning: m.pruning() };
        let described = Step {
            probes,
            progress: share,
            rate_scale: m.rate_scale,
            near_scaling: m.config.loss.near_scaling,
            ..Step::new(step, m.rays, RaySource::Given(given), placement, loss)
        };
        let done = self.device.step(&mut Trainer::trainees(&mut self.model), None, &described, 1)?;
        if done.shown.loss.is_finite() {
            self.model.rays += b.len() as u64;
        }
        Ok(done.shown)
    }

    /// Adds the batch's rays of known distance once more, up to what is empty before it; returns where all rays end.
    fn add_empty(&mut self) -> Vec<f32> {
        let b = &mut self.batch;
        let known: Vec<usize> = (0..b.len()).filter(|r| b.distance[*r] > 0.0).collect();
        let mut far = vec![f32::MAX; b.len()];
        let first = b.len();
        b.resize(first + known.len());
        for (i, r) in known.into_iter().enumerate() {
            let to = first + i;
            (b.images[to], b.jitter[to], b.distance[to]) = (b.images[r], b.jitter[r], 0.0);
            b.origins.copy_within(3 * r..3 * r + 3, 3 * to);
            b.dirs.copy_within(3 * r..3 * r + 3, 3 * to);
            far.push(EMPTY * b.distance[r]);
        }
        far
    }

    /// One step of the scene's stage.
    fn look(&mut self, step: u64, share: f32) -> Result<StepReport> {
        let c = self.model.config.clone();
        let (n, first) = (c.sampling.rays, self.model.rays);
        self.batch.resize(n);
        let (near, cube, rng) = (c.sampling.near, self.model.cube(), self.rng(PIXELS));
        let o = DrawOptions { cameras: &self.cameras, first, rng, near, cube, error_map: None, observations: &self.observations };
        pixels::draw(&self.photographs, &o, &mut self.batch);
        let far = if c.loss.empty > 0.0 { self.add_empty() } else { Vec::new() };
        let rng = self.rng(BACKGROUND);
        let background: Vec<f32> = (0..3 * self.batch.len()).map(|i| rng.uniform(3 * first + i as u64)).collect();
        let targets = self.batch.target.chunks_exact(4).zip(background.chunks_exact(3)).take(n);
        let target: Vec<f32> = targets.flat_map(|(t, b)| [0, 1, 2].map(|k| t[k] * t[3] + b[k] * (1.0 - t[3]))).collect();
        let (m, [height, width]) = (s3im::ARRANGEMENTS, c.loss.tile);
        let arrangements = match c.loss.s3im > 0.0 {
            true => s3im::arrangements(n, m, &self.rng(TILES), step * s3im::draws(n, m)),
            false => Vec::new(),
        };
        let (counts, distance) = (self.batch.counts[..n].to_vec(), self.batch.distance[..n].to_vec());
        let loss = SceneLoss {
            target: &target,
            counts: &counts,
            tile: Tile { height, width },
            arrangements: &arrangements,
            s3im: c.loss.s3im,
            distortion: c.loss.distortion * (share / DISTORTION_RAMP).min(1.0),
            opacity: c.loss.opacity,
            distance: &distance,
            depth: c.loss.depth,
            empty: c.loss.empty,
            mse: Mutex::default(),
        };
        let is_probed = step > 0 && step.is_multiple_of(c.sampling.occupancy_every);
        let (until, block) = OCCUPANCY_WARMUP;
        let block = if step <= until { block } else { 1 };
        let probes = is_probed.then(|| Probes { rng: self.rng(OCCUPANCY), points: c.sampling.occupancy_points, block });
        let f = self.carry_out((step, share), (&far, &background), Described { loss: Loss::Batch(&loss), probes })?;
        let mse = loss.mse.into_inner().expect("no other thread holds it");
        Ok(StepReport { loss: f.loss, scalars: self.scalars([Scalar::psnr("psnr", mse)], n, f.trained) })
    }

    /// One step of the labels' stage: half of its rays are labelled, half have labels by depth.
    fn label(&mut self, step: u64, share: f32) -> Result<StepReport> {
        let c = self.model.config.clone();
        let (n, classes, first) = (c.sampling.rays, self.model.labels.count(), self.model.rays);
        let weight = if self.labelled[1].pixels.is_empty() { 0.0 } else { c.loss.proxy };
        let half = if weight > 0.0 { n / 2 } else { n };
        self.batch.resize(n);
        let (rng, at) = (self.rng(LABELLED), |r: usize| 2 * (first + r as u64));
        let chances = self.labelled.each_ref().map(Labelled::chances);
        let mut labels = Vec::with_capacity(n);
        for r in 0..n {
            let (of, weight) = if r < half { (0, 1.0 / half as f32) } else { (1, weight / (n - half) as f32) };
            let (image, x, y, class) = self.labelled[of].draw(r, &rng, at(r));
            let b = &mut self.batch;
            b.images[r] = image;
            b.pixels[2 * r..2 * r + 2].copy_from_slice(&[x as f32 + 0.5, y as f32 + 0.5]);
            b.jitter[r] = rng.uniform(at(r) + 1);
            let chance = chances[of][(class == 0) as usize];
            labels.push((class, if share < EVEN_FROM { weight } else { weight / chance }));
        }
        pixels::rays(&self.cameras, c.sampling.near, self.model.cube(), &mut self.batch);
        // What nothing hides is background.
        let background: Vec<f32> = (0..n * classes).map(|i| if i % classes == 0 { 1.0 } else { 0.0 }).collect();
        let loss = LabelLoss { classes, labels: &labels };
        let f = self.carry_out((step, share), (&[], &background), Described { loss: Loss::Batch(&loss), probes: None })?;
        Ok(StepReport { loss: f.loss, scalars: self.scalars([Scalar::new("cross_entropy", f.loss)], n, f.trained) })
    }

    fn scalars(&self, first: [Scalar; 1], n: usize, samples: f64) -> Scalars {
        let [first] = first;
        Scalars::from([
            first,
            Scalar::count("rays", self.model.rays),
            Scalar::rate("rays_per_s", n as f64),
            Scalar::new("samples_per_ray", samples / n as f64).logged_only(),
        ])
    }

    /// Labels of all pixels that have one, from the depth as it is; false after an interrupt.
    fn find_labels(&mut self, interrupt: &AtomicBool, events: &mut dyn FnMut(&Event)) -> Result<bool> {
        let m = &self.model;
        let n = self.cameras.len();
        let mut views: Vec<View> = Vec::with_capacity(n);
        for (i, camera) in self.cameras.iter().enumerate() {
            if interrupt.load(Ordering::Relaxed) {
                return Ok(false);
            }
            events(&Event::Preparing { what: "carrying labels to other photographs", share: i as f64 / n as f64 });
            views.push(m.surface_view(camera));
        }
        let given: Vec<Option<Vec<u8>>> = m
            .train
            .iter()
            .zip(&self.cameras)
            .map(|(frame, camera)| {
                let (own, of) = (&camera.camera, &m.capture.frames[*frame].camera);
                let image = m.labels.of_frame[*frame].as_ref()?;
                Some(m.labels.map(image, (own.width, own.height), (of.width, of.height)))
            })
            .collect();
        let proxies = label_maps::proxies(&self.cameras, &views, &given, m.labels.count());
        let known: Vec<Vec<u8>> = given.into_iter().map(|g| g.unwrap_or_default()).collect();
        label_maps::check(&known)?;
        let listed = |maps: &[Vec<u8>]| -> Labelled {
            let of = |(image, map): (usize, &Vec<u8>)| {
                let w = self.cameras[image].camera.width;
                let at = |(i, class): (usize, &u8)| (image as u32, i as u32 % w, i as u32 / w, *class);
                map.iter().enumerate().filter(|(_, c)| **c != UNKNOWN).map(at).collect::<Vec<_>>()
            };
            let counts = |p: &(u32, u32, u32, u8)| self.photographs.counts(p.0 as usize, p.1, p.2);
            Labelled::new(maps.iter().enumerate().flat_map(of).filter(counts).collect())
        };
        self.labelled = [listed(&known), listed(&proxies)];
        let [own, carried] = self.labelled.each_ref().map(|l| l.pixels.len());
        events(&Event::Note(format!("{own} pixels are labelled, and depth carries labels to {carried} more")));
        Ok(true)
    }
}

impl Trainee for Trainer<'_> {
    type Error = crate::error::PipelineError;

    fn prepare(&mut self, _: u64, progress: f64, interrupt: &AtomicBool, events: &mut dyn FnMut(&Event)) -> Result<()> {
        let is_due = self.model.stage == Stage::Labels || self.model.config.stage(progress as f32).0 == Stage::Labels;
        if !is_due || !self.labelled[0].pixels.is_empty() {
            return Ok(());
        }
        if self.model.stage == Stage::Scene {
            self.device.download(&mut Trainer::trainees(&mut self.model))?;
        }
        if self.find_labels(interrupt, events)? && self.model.stage == Stage::Scene {
            self.model.begin_labels();
            self.begin()?;
        }
        Ok(())
    }

    fn step(&mut self, step: u64, progress: f64) -> Result<StepReport> {
        // A longer run that goes on from labels keeps to them.
        match (self.model.stage, self.model.config.stage(progress as f32)) {
            (Stage::Scene, (Stage::Scene, share)) => self.look(step, share),
            (Stage::Scene, (Stage::Labels, _)) => self.look(step, 1.0),
            (Stage::Labels, (Stage::Scene, _)) => self.label(step, 0.0),
            (Stage::Labels, (Stage::Labels, share)) => self.label(step, share),
        }
    }

    fn save(&mut self, step: u64, seconds: f64) -> Result<bool> {
        self.device.download(&mut Trainer::trainees(&mut self.model))?;
        if self.model.is_broken() {
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
        let m = &self.model;
        let mut fresh = TextModel::new(m.config.clone(), m.capture.clone(), m.labels.clone())?;
        if checkpoint::exists(self.checkpoints) {
            let (c, _) = checkpoint::load(self.checkpoints)?;
            fresh.restore(c, &checkpoint::latest(self.checkpoints))?;
        }
        fresh.rate_scale = 0.3 * self.model.rate_scale;
        (self.model, self.labelled) = (fresh, Default::default());
        self.begin()?;
        Ok(Some((self.model.origin.step, "the loss was not finite; the rate is lowered".into())))
    }
}
