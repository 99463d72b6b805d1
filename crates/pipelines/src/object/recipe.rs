//! Training, from top to bottom.

use super::config::{Background, Config, Method};
use super::device::{self, Aftermath, Drawing, Opened};
use super::exposure_spread;
use super::held_out::{self, HeldOutPixels};
pub use super::loading::load_capture;
use super::memory;
use super::model::{ObjectModel, Terms, is_linear};
use super::nearest;
use super::observations;
use super::run_folder::{RunSummary, SparsePoints as _};
use super::viewing::RunView;
use crate::error::{PipelineError, Result};
use crate::run::RunFolder;
use crate::run::profile::{StageFigure, TrainReport};
use diorama_data::checkpoint;
use diorama_data::photo_check;
use diorama_data::pixel_store::{PixelStore, StoreOptions};
use diorama_engine::fields::{Batch, Field, FieldBuffers, Loss, Pruning, VisibleSamples};
use diorama_engine::losses::{self, Photometric};
use diorama_engine::params::Schedule;
use diorama_engine::samplers::pixels::{self, DrawOptions, Observation, PixelSource};
use diorama_engine::samplers::{RayBatch, stratified};
use diorama_engine::stages::Stages;
use diorama_engine::train::{self, Event, HeldOut, RunError, RunOptions, StepReport, Summary, Trainee};
use diorama_geom::Capture;
use diorama_geom::capture::Split;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::distortion;
use diorama_kernels::ops::linear::Activation;
use diorama_kernels::ops::march::{self, MarchRays};
use diorama_kernels::ops::pixel_gather;
use diorama_kernels::ops::ray_generation::{self, CORRECTION, PosedCamera};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Streams of random numbers.
const PIXELS: u64 = 10;
const OCCUPANCY: u64 = 11;
const BACKGROUND: u64 = 12;
const COARSE: u64 = 13;
const FINE: u64 = 14;

/// Steps between which draws go by the same errors.
const ERROR_REFRESH: u64 = 16;

/// Steps during which an occupancy sample stands for a block of cells, and that block's edge.
const OCCUPANCY_WARMUP: (u64, usize) = (256, 2);

/// Steps between which the samples per step grow from a quarter to all.
const BATCH_RAMP: (u64, u64) = (256, 1024);

/// How much longer the steps of a march are at first, and the training step from which they have their own length:
/// what a scene is roughly like is learned from few samples per ray and so from many rays.
const MARCH_RAMP: (f32, u64) = (16.0, 1024);

/// The device that a configuration will train on, in words.
///
/// # Errors
/// When it is not part of the build, absent, or cannot train the configuration.
pub fn device(config: &Config) -> Result<String> {
    let opened = device::open(config)?;
    Ok(if opened.is_gpu() { opened.name() } else { device::cpu_name() })
}

/// What training gives.
pub struct Trained {
    pub model: ObjectModel,
    pub summary: Summary,
    /// `cpu`, or what the GPU calls itself.
    pub device: String,
}

/// Trains into `folder`, from the start or from its checkpoint.
///
/// Capture → pixels → model → loop of steps → checkpoint; `events` hears of all of it, and `view` sees it.
pub fn train(
    config: &Config,
    folder: &mut RunFolder,
    resume: bool,
    view: Option<&RunView>,
    interrupt: &AtomicBool,
    events: &mut dyn FnMut(&Event),
) -> Result<Trained> {
    let opened = device::open(config)?;
    opened.note().into_iter().for_each(|n| events(&Event::Note(n)));
    let capture = if resume { folder.capture_with_points()? } else { load_capture(config)? };
    for note in &capture.notes {
        events(&Event::Note(note.clone()));
    }
    let config = &resolved(config, &capture)?;
    if config.data.white > 0.0 {
        let white = config.data.white;
        events(&Event::Note(format!("the photographs hold linear light: {white} is shown as white (--set data.white={white})")));
    }
    memory::check_training(config, &capture)?.into_iter().for_each(|n| events(&Event::Note(n)));
    let (store, budget) = load_pixels(config, &capture, &opened)?;
    if let n @ 2.. = store.stride() {
        let limit = if budget < config.data.memory_budget { "what the device holds in one piece" } else { "data.memory_budget" };
        events(&Event::Note(format!("the photographs exceed {limit} ({} MiB): one pixel of each {n} x {n} is trained on", budget >> 20)));
    }
    let has_alpha = store.has_alpha;
    let mut model = ObjectModel::new(config.clone(), capture, has_alpha)?;
    let mut photographs = Photographs(store);
    let (observations, source) = observations::find(&mut model, &photographs, interrupt, &mut |n| events(&Event::Note(n)));
    observations::note(&model, observations.len(), source).into_iter().for_each(|n| events(&Event::Note(n)));
    let (mut model, note) = settle_exposure(model, &mut photographs, &observations)?;
    note.into_iter().for_each(|n| events(&Event::Note(n)));
    let held_out = HeldOutPixels::draw(&model)?;
    if resume {
        if checkpoint::exists(&folder.checkpoints()) {
            let (c, note) = checkpoint::load(&folder.checkpoints())?;
            model.restore(c, &checkpoint::latest(&folder.checkpoints()))?;
            note.into_iter().for_each(|n| events(&Event::Note(n)));
        } else {
            events(&Event::Note("the run was stopped before its first checkpoint: it begins again".into()));
        }
        folder.cut_metrics(model.origin.step)?;
    } else {
        folder.write_description(&model.config, &model.capture)?;
    }
    let options = RunOptions { held_out_rays: held_out.as_ref().map_or(0, |h| h.rays() as u64), ..run_options(config) };
    let origin = model.origin;
    let checkpoints = folder.checkpoints();
    let mut trainer = Trainer { view, held_out, ..Trainer::new(model, photographs, observations, &checkpoints, opened)? };
    let (mut log_error, mut judged) = (None, HeldOut::default());
    let result = train::run(&options, origin, &mut trainer, interrupt, &mut |e| {
        if let Err(e) = folder.log(e) {
            log_error.get_or_insert(e);
        }
        if let Event::Evaluated { views, .. } = e {
            judged.views.clone_from(views);
        }
        view.into_iter().for_each(|v| v.hear(e));
        events(e);
    });
    if let Some(e) = log_error {
        return Err(e);
    }
    let summary = result.map_err(|e| match e {
        RunError::Failed(e) => e,
        RunError::Diverged { first, again } => PipelineError::Diverged { first, again, kept: kept(&checkpoints) },
    })?;
    trainer.show()?;
    folder.draw_curves()?;
    let name = |i: usize| trainer.model.capture.frames[i].name.clone();
    if resume && summary.step == origin.step {
        // What the run came to stays in its summary.
        let (steps, seconds) = (origin.step, origin.seconds);
        events(&Event::Note(format!(
            "the run has its {steps} steps and {seconds:.0} s already; --steps and --seconds are of the whole run"
        )));
        return Ok(Trained { device: trainer.device.name(), model: trainer.model, summary });
    }
    folder.write_summary(&RunSummary {
        steps: summary.step,
        seconds: summary.seconds,
        device: trainer.device.name(),
        psnr_train: Some(summary.psnr).filter(|p| p.is_finite()),
        psnr_held_out: summary.held_out,
        behind_fog: held_out::far_below(&judged.views, summary.psnr).into_iter().map(name).collect(),
        peak_memory_bytes: diorama_data::memory::peak_of_process(),
    })?;
    Ok(Trained { device: trainer.device.name(), model: trainer.model, summary })
}

/// What a run that ended with an error leaves, in words.
fn kept(checkpoints: &Path) -> String {
    if checkpoint::exists(checkpoints) {
        format!("{} is the last good checkpoint", checkpoint::latest(checkpoints).display())
    } else {
        "there was no checkpoint yet".into()
    }
}

/// What the first steps came to.
pub struct Beginning {
    /// Per step.
    pub losses: Vec<f64>,
    /// Of the cameras, where they are refined: how far their corrections went, and the mean of its gradient that the
    /// optimiser keeps.
    pub cameras: Option<[Vec<f32>; 2]>,
}

/// Trains the first `steps` steps, from cameras a little wrong where they are refined; writes nothing.
pub fn begin(config: &Config, steps: u64) -> Result<Beginning> {
    let mut trainer = scratch_trainer(config, true)?;
    let from = trainer.model.corrections.as_ref().map(|g| g.values.clone()).unwrap_or_default();
    let losses = (0..steps).map(|step| Ok(trainer.step(step, step as f64 / steps as f64)?.loss)).collect::<Result<_>>()?;
    if trainer.model.corrections.is_some() {
        trainer.device.download(&mut trainer.model)?;
    }
    let went = |to: &[f32]| to.iter().zip(&from).map(|(to, from)| to - from).collect();
    let cameras = trainer.model.corrections.map(|g| [went(&g.values), g.moment1]);
    Ok(Beginning { losses, cameras })
}

/// Where a step's time goes: `warmup` steps, then `steps` measured ones; writes nothing.
pub fn profile(config: &Config, warmup: u64, steps: u64) -> Result<TrainReport> {
    let mut trainer = scratch_trainer(config, false)?;
    for step in 0..warmup {
        trainer.step(step, 0.0)?;
    }
    trainer.settle()?;
    trainer.buffers.field.stages = Stages::default();
    let before = (trainer.model.origin, trainer.marched);
    let begin = Instant::now();
    for step in warmup..warmup + steps {
        trainer.step(step, 0.0)?;
    }
    trainer.settle()?;
    let seconds = begin.elapsed().as_secs_f64();
    let (o, marched) = (trainer.model.origin, trainer.marched - before.1);
    let (rays, trained) = ((o.rays - before.0.rays) as f64, (o.samples - before.0.samples) as f64);
    let stages = &trainer.buffers.field.stages.seconds;
    let total: f64 = stages.iter().map(|s| s.1).sum();
    Ok(TrainReport {
        threads: rayon::current_num_threads(),
        simd: diorama_kernels::simd::level().name(),
        device: trainer.device.name(),
        steps,
        seconds,
        rays_per_s: rays / seconds,
        marched_per_s: marched as f64 / seconds,
        trained_per_s: trained / seconds,
        marched_per_ray: marched as f64 / rays,
        trained_per_ray: trained / rays,
        occupied: trainer.model.occupancy.as_ref().map(|o| o.bits.fill()),
        stages: stages.iter().map(|s| StageFigure { stage: s.0, share: s.1 / total, ms: s.1 * 1e3 / steps as f64 }).collect(),
    })
}

/// How wrong cameras are made at most, in radians and lengths of the model.
const WRONG: f32 = 0.01;

/// A trainer whose run is not kept.
fn scratch_trainer(config: &Config, wrong_cameras: bool) -> Result<Trainer<'static>> {
    let capture = load_capture(config)?;
    let config = &resolved(config, &capture)?;
    let device = device::open(config)?;
    let (store, _) = load_pixels(config, &capture, &device)?;
    let has_alpha = store.has_alpha;
    let mut model = ObjectModel::new(config.clone(), capture, has_alpha)?;
    let mut photographs = Photographs(store);
    let (observations, _) = observations::find(&mut model, &photographs, &AtomicBool::new(false), &mut |_| {});
    let (mut model, _) = settle_exposure(model, &mut photographs, &observations)?;
    if let (true, Some(group)) = (wrong_cameras, &mut model.corrections) {
        let rng = Rng::new(config.seed, 0);
        for (i, v) in group.values.iter_mut().enumerate() {
            let moves = config.camera.refine_focal || i % CORRECTION != 6;
            *v = if moves { WRONG * (2.0 * rng.uniform(i as u64) - 1.0) } else { 0.0 };
        }
    }
    Trainer::new(model, photographs, observations, Path::new(""), device)
}

/// Gives photographs appearance codes where their light differs, and those that wear one the mean exposure.
fn settle_exposure(model: ObjectModel, photographs: &mut Photographs, known: &[Observation]) -> Result<(ObjectModel, Option<String>)> {
    let gains = exposure_spread::measure(photographs, &model, known);
    let (model, note) = exposure_spread::settle_codes(model, gains.as_deref())?;
    let Some(gains) = gains.filter(|_| model.field.codes.appearance.is_some()) else {
        return Ok((model, note));
    };
    exposure_spread::to_the_mean(&gains).into_iter().enumerate().for_each(|(i, by)| photographs.0.brighten(i, by));
    Ok((model, note))
}

/// The configuration with what the capture says where it leaves it open: white, and how near matter may be.
fn resolved(config: &Config, capture: &Capture) -> Result<Config> {
    let mut config = config.clone();
    if !is_linear(capture) {
        config.data.white = 0.0;
    } else if config.data.white == 0.0 {
        let train: Vec<_> = capture.frames.iter().filter(|f| f.split == Split::Train).collect();
        config.data.white = photo_check::white(&train)?;
    }
    if config.sampling.near == 0.0 {
        config.sampling.near = nearest::of_points(capture).unwrap_or(0.0);
    }
    Ok(config)
}

/// The training pixels, and the bytes that they might take.
fn load_pixels(config: &Config, capture: &Capture, device: &Opened) -> Result<(PixelStore, u64)> {
    let train = capture.indices(Split::Train);
    let frames: Vec<_> = train.iter().map(|&i| &capture.frames[i]).collect();
    let budget = config.data.memory_budget.min(device.most_bytes());
    let options = StoreOptions { reduction: config.reduction(), budget, masks: capture.masks, white: config.data.white };
    Ok((PixelStore::load(&frames, &options, &|| {})?, budget))
}

fn run_options(config: &Config) -> RunOptions {
    let r = &config.run;
    let positive = |n: u64| (n > 0).then_some(n);
    RunOptions {
        steps: positive(r.steps),
        seconds: (r.seconds > 0.0).then_some(r.seconds),
        log_every: r.log_every,
        save_every_seconds: r.save_every_seconds,
        save_every_steps: positive(r.save_every_steps),
        evaluate_every: positive(r.evaluate_every),
        held_out_rays: 0,
    }
}

/// The training photographs.
pub(super) struct Photographs(PixelStore);

impl Photographs {
    pub fn new(store: PixelStore) -> Self {
        Photographs(store)
    }

    #[cfg(feature = "gpu")]
    pub fn store(&self) -> &PixelStore {
        &self.0
    }
}

impl PixelSource for Photographs {
    fn images(&self) -> usize {
        self.0.len()
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
        pixel_gather::cpu::convert(self.0.format(), self.0.pixel(image, x, y))
    }
    fn counts(&self, image: usize, x: u32, y: u32) -> bool {
        self.0.counts(image, x, y)
    }
}

/// Buffers that steps reuse.
#[derive(Default)]
struct Buffers {
    batch: RayBatch,
    background: Vec<f32>,
    visible: VisibleSamples,
    guide: VisibleSamples,
    d_positions: Vec<f32>,
    field: FieldBuffers,
}

/// A device's failure that training survives; why, in words.
enum Setback {
    /// The CPU goes on from what the host holds.
    Lost(String),
    /// The device goes on from the last checkpoint, with a smaller batch.
    Full(String),
}

struct Trainer<'a> {
    model: ObjectModel,
    photographs: Photographs,
    cameras: Vec<PosedCamera>,
    checkpoints: &'a Path,
    buffers: Buffers,
    schedule: Schedule,
    recovered: bool,
    /// Samples before any were left out.
    marched: u64,
    /// Pixels of known distance; none where they do not count.
    observations: Vec<Observation>,
    device: Opened,
    /// How a device failed, and what was made of it.
    setback: Option<Setback>,
    held_out: Option<HeldOutPixels>,
    /// Who looks on.
    view: Option<&'a RunView>,
}

impl<'a> Trainer<'a> {
    fn new(
        model: ObjectModel,
        photographs: Photographs,
        observations: Vec<Observation>,
        checkpoints: &'a Path,
        mut device: Opened,
    ) -> Result<Self> {
        let o = &model.config.optim;
        let schedule = Schedule { warmup: o.warmup, final_scale: o.final_scale, decay_from: o.decay_from };
        let cameras = model.cameras();
        device.upload(&model, &photographs, &observations)?;
        Ok(Trainer {
            cameras,
            model,
            photographs,
            checkpoints,
            buffers: Buffers::default(),
            schedule,
            recovered: false,
            marched: 0,
            observations,
            device,
            setback: None,
            held_out: None,
            view: None,
        })
    }

    /// Shows what has been learned so far.
    fn show(&mut self) -> Result<()> {
        if let Some(view) = self.view {
            self.device.download(&mut self.model)?;
            view.show(self.model.to_look_at());
        }
        Ok(())
    }

    /// Waits for a GPU and counts what it has done.
    fn settle(&mut self) -> Result<()> {
        let f = self.device.figures(&mut self.model)?;
        self.marched += f.marched as u64;
        Ok(())
    }

    /// As many rays as give about the wanted number of samples, fewer while coarse steps in quick succession
    /// teach more.
    fn rays(&self, step: u64) -> usize {
        let s = &self.model.config.sampling;
        if s.rays > 0 {
            return (s.rays >> self.device.halvings()).max(1);
        }
        let (from, until) = BATCH_RAMP;
        let grown = step.saturating_sub(from) as f64 / (until - from) as f64;
        let n = self.device.batch_samples(&self.model.config) as f64 * (0.25 + 0.75 * grown.min(1.0)) / self.model.samples_per_ray.max(1.0);
        (n as usize).clamp(64, self.device.most_rays()).next_multiple_of(64)
    }

    fn draw(&mut self, step: u64, first: u64) {
        let n = self.rays(step);
        let m = &self.model;
        self.buffers.batch.resize(n);
        let options = DrawOptions {
            cameras: &self.cameras,
            first,
            rng: Rng::new(m.config.seed, PIXELS),
            near: m.config.sampling.near,
            cube: m.cube(),
            error_map: m.error_map.as_ref(),
            observations: &self.observations,
        };
        pixels::draw(&self.photographs, &options, &mut self.buffers.batch);
        self.fill_background(first);
        self.buffers.field.stages.done("draw");
    }

    fn is_background_random(&self) -> bool {
        match self.model.config.background {
            Background::Random => true,
            Background::Auto => self.model.config.method == Method::Ngp,
            _ => false,
        }
    }

    fn fill_background(&mut self, first: u64) {
        let random = self.is_background_random();
        let b = &mut self.buffers;
        let n = b.batch.len();
        b.background.resize(n * 3, 0.0);
        let m = &self.model;
        if let Some(l) = &m.learned {
            l.forward(&b.batch.dirs, &mut b.background);
        } else if random {
            let rng = Rng::new(m.config.seed, BACKGROUND);
            b.background.iter_mut().enumerate().for_each(|(i, v)| *v = rng.uniform(first * 3 + i as u64));
        } else {
            let color = m.backdrop_color();
            b.background.chunks_exact_mut(3).for_each(|c| c.copy_from_slice(&color));
        }
    }

    /// Occupied samples through the one field.
    fn step_ngp(&mut self, step: u64) -> (f64, u64) {
        let b = &mut self.buffers;
        let m = &mut self.model;
        let (s, thin, terms) = (&m.config.sampling, m.thin(), m.terms(step));
        let grid = m.occupancy.as_mut().expect("ngp has an occupancy grid");
        if step > 0 && step.is_multiple_of(s.occupancy_every) {
            let (until, block) = OCCUPANCY_WARMUP;
            let rng = Rng::new(m.config.seed, OCCUPANCY);
            grid.update(&m.field, &rng, step, s.occupancy_points, if step <= until { block } else { 1 });
            b.field.stages.done("occupancy");
        }
        let rays = MarchRays {
            origins: &b.batch.origins,
            dirs: &b.batch.dirs,
            near_far: &b.batch.near_far,
            jitter: &b.batch.jitter,
            resumed: false,
        };
        let pruning = Pruning { stop: s.stop, min_alpha: s.min_alpha, thin, min_weight: 0.0 };
        let march = grid.march_config(s.max_samples).stretched(stretch(step));
        m.field.visible(&grid.bits, &rays, &march, pruning, &mut b.visible, &mut b.field);
        b.field.visible.seen().for_each(|(cells, sigma)| grid.record(cells, sigma));
        self.marched += b.field.visible.marched() as u64;
        let per_ray = b.visible.samples.t.len() as f64 / b.batch.len() as f64;
        m.samples_per_ray = if step == 0 { per_ray } else { 0.9 * m.samples_per_ray + 0.1 * per_ray };
        let loss = train_field(
            &mut m.field,
            &terms,
            &b.batch,
            &mut b.visible,
            &b.background,
            &mut b.field,
            m.corrections.is_some().then_some(&mut b.d_positions),
        );
        (loss, b.visible.samples.t.len() as u64)
    }

    /// The same on a GPU, which reports after some steps what they came to on average.
    fn step_gpu(&mut self, step: u64, progress: f64) -> Result<StepReport> {
        let (rays, m) = (self.rays(step), &self.model);
        let s = &m.config.sampling;
        let (until, block) = OCCUPANCY_WARMUP;
        let seed = m.config.seed;
        let drawing = Drawing {
            rays,
            pixels: Rng::new(seed, PIXELS),
            background: self.is_background_random().then(|| Rng::new(seed, BACKGROUND)),
            probes: (step > 0 && step.is_multiple_of(s.occupancy_every)).then(|| Rng::new(seed, OCCUPANCY)),
            block: if step <= until { block } else { 1 },
            coarse: Rng::new(seed, COARSE),
            fine: Rng::new(seed, FINE),
            refresh_errors: step.is_multiple_of(ERROR_REFRESH),
            stretch: stretch(step),
            thin: m.thin(),
            terms: m.terms(step),
            rate_scale: self.schedule.scale(progress as f32) * m.rate_scale,
        };
        let figures = self.device.step(&mut self.model, step, &drawing)?;
        self.marched += figures.marched as u64;
        Ok(StepReport { loss: figures.loss, mse: figures.mse, rays: rays as u64, samples: figures.trained as u64 })
    }

    /// Stratified samples through the one field.
    fn step_stratified(&mut self, step: u64, first: u64) -> (f64, u64) {
        let b = &mut self.buffers;
        let m = &mut self.model;
        let terms = m.terms(step);
        let rng = Rng::new(m.config.seed, COARSE);
        stratified::stratified(&b.batch, m.config.sampling.samples, Some((rng, first)), &mut b.visible.samples);
        encode(&m.field, &b.batch, &mut b.visible);
        let d = m.corrections.is_some().then_some(&mut b.d_positions);
        let loss = train_field(&mut m.field, &terms, &b.batch, &mut b.visible, &b.background, &mut b.field, d);
        (loss, b.visible.samples.t.len() as u64)
    }

    /// Stratified samples through the coarse field, then more where it found matter through the fine one.
    fn step_hierarchical(&mut self, step: u64, first: u64) -> (f64, u64) {
        let b = &mut self.buffers;
        let m = &mut self.model;
        let (n, more, terms) = (m.config.sampling.samples, m.config.sampling.importance, m.terms(step));
        stratified::stratified(&b.batch, n, Some((Rng::new(m.config.seed, COARSE), first)), &mut b.guide.samples);
        let coarse = m.coarse.as_mut().expect("nerf has a coarse field");
        encode(coarse, &b.batch, &mut b.guide);
        let coarse_loss = train_field(coarse, &terms, &b.batch, &mut b.guide, &b.background, &mut b.field, None);
        let (guide, fine) = (&b.guide.samples, &mut b.visible.samples);
        stratified::refine(guide, &b.field.out.weights, n, more, Some((Rng::new(m.config.seed, FINE), first)), fine);
        encode(&m.field, &b.batch, &mut b.visible);
        let d = m.corrections.is_some().then_some(&mut b.d_positions);
        let loss = train_field(&mut m.field, &terms, &b.batch, &mut b.visible, &b.background, &mut b.field, d);
        (coarse_loss + loss, (b.guide.samples.t.len() + b.visible.samples.t.len()) as u64)
    }

    /// Squared error of the step's colours, and what the error map learns from it.
    fn score(&mut self) -> f64 {
        let (b, is_linear) = (&self.buffers, self.model.is_linear());
        let (mut sum, mut n) = (0.0f64, 0usize);
        for r in 0..b.batch.len() {
            let t = &b.batch.target[r * 4..r * 4 + 4];
            if t[0].is_nan() {
                continue;
            }
            let want = [0, 1, 2].map(|k| t[k] * t[3] + b.background[r * 3 + k] * (1.0 - t[3]));
            let got = [0, 1, 2].map(|k| b.field.out.values[r * 3 + k]);
            let e = losses::squared_error(got, want, is_linear);
            sum += e as f64;
            n += 1;
            if let Some(map) = &mut self.model.error_map {
                let image = b.batch.images[r] as usize;
                let (w, h) = self.photographs.size(image);
                map.record(image, b.batch.pixels[r * 2] / w as f32, b.batch.pixels[r * 2 + 1] / h as f32, e);
            }
        }
        sum / n.max(1) as f64
    }

    /// Gradients of the camera corrections from those of the sample positions.
    fn correct_cameras(&mut self) {
        let Some(group) = &mut self.model.corrections else { return };
        let b = &self.buffers;
        let rays = b.batch.len();
        let (mut d_origins, mut d_dirs) = (vec![0.0; rays * 3], vec![0.0; rays * 3]);
        for r in 0..rays {
            let s = &b.visible.samples;
            for i in s.offsets[r] as usize..s.offsets[r + 1] as usize {
                let t = s.t[i] + 0.5 * s.dt[i];
                for k in 0..3 {
                    d_origins[r * 3 + k] += b.d_positions[i * 3 + k];
                    d_dirs[r * 3 + k] += t * b.d_positions[i * 3 + k];
                }
            }
        }
        let mut d = vec![0.0f64; group.values.len()];
        ray_generation::cpu::backward(&self.cameras, &b.batch.images, &b.batch.pixels, &b.batch.dirs, &d_origins, &d_dirs, &mut d);
        group.grads.iter_mut().zip(&d).for_each(|(g, d)| *g += *d as f32);
    }
}

/// How much longer a march's steps are at a training step.
fn stretch(step: u64) -> f32 {
    let (most, until) = MARCH_RAMP;
    most.powf(1.0 - step.min(until) as f32 / until as f32)
}

/// Positions of samples along their rays, and their encoding.
fn encode(field: &Field, batch: &RayBatch, out: &mut VisibleSamples) {
    let rays = MarchRays { origins: &batch.origins, dirs: &batch.dirs, near_far: &batch.near_far, jitter: &batch.jitter, resumed: false };
    march::cpu::positions(&rays, &out.samples, &mut out.positions);
    field.encode(&out.positions, &mut out.encoded);
}

#[allow(clippy::too_many_arguments)]
fn train_field(
    field: &mut Field,
    terms: &Terms,
    batch: &RayBatch,
    on: &mut VisibleSamples,
    background: &[f32],
    buffers: &mut FieldBuffers,
    d_positions: Option<&mut Vec<f32>>,
) -> f64 {
    let marched = &on.samples;
    let samples = Packed { offsets: &marched.offsets, t: &marched.t, dt: &marched.dt };
    let (mut starts, mut lengths) = (Vec::new(), Vec::new());
    let spread = if terms.distortion > 0.0 && field.is_unbounded() {
        distortion::cpu::normalize(&samples, &mut starts, &mut lengths);
        Packed { offsets: &marched.offsets, t: &starts, dt: &lengths }
    } else {
        samples
    };
    // Linear light has a color head of its own.
    let relative = if field.net.color().activation == Activation::TruncatedExp { losses::RELATIVE } else { 0.0 };
    let Terms { color, distortion, depth, alpha, near_scaling } = *terms;
    let loss = Photometric { batch, samples: spread, background, color, relative, distortion, alpha, depth, along: samples };
    let (dirs, images) = (&batch.dirs[..], Some(&batch.images[..]));
    let b = Batch { samples, positions: &on.positions, dirs, images, given: &[], background, near_scaling };
    field.train(&b, &mut on.encoded, Loss::Rays(&loss), buffers, d_positions);
    buffers.out.loss
}

impl Trainee for Trainer<'_> {
    type Error = PipelineError;

    fn step(&mut self, step: u64, progress: f64) -> Result<StepReport> {
        if self.view.is_some_and(RunView::wants) {
            // A device that fails here fails in the step below as well, which knows what to do.
            let _ = self.show();
        }
        if self.device.is_gpu() {
            let e = match self.step_gpu(step, progress) {
                Err(e) => e,
                done => return done,
            };
            let m = &self.model;
            let needs =
                memory::of_training(&m.config, &m.capture, self.photographs.0.format(), self.device.batch_samples(&m.config)).to_string();
            self.setback = Some(match device::aftermath(e, &m.config.device, self.device.halvings(), &needs) {
                Aftermath::Fail(e) => return Err(e),
                Aftermath::Cpu(why) => {
                    self.device = Opened::cpu(None);
                    Setback::Lost(why)
                }
                Aftermath::Halve(why) => {
                    self.device.halve();
                    Setback::Full(why)
                }
            });
            return Ok(StepReport { loss: f64::NAN, ..StepReport::default() });
        }
        let first = self.model.origin.rays;
        self.draw(step, first);
        let (loss, samples) = match self.model.config.method {
            Method::Ngp => self.step_ngp(step),
            Method::Mlp | Method::Baseline => self.step_stratified(step, first),
            Method::Nerf => self.step_hierarchical(step, first),
        };
        self.buffers.field.stages.done("network");
        let mse = self.score();
        let rays = self.buffers.batch.len() as u64;
        let report = StepReport { loss, mse, rays, samples };
        if !loss.is_finite() {
            return Ok(report);
        }
        if let Some(l) = &mut self.model.learned {
            l.backward(&self.buffers.batch.dirs, &self.buffers.background, &self.buffers.field.out.d_background);
        }
        self.correct_cameras();
        self.buffers.field.stages.done("score");
        self.model.optimise(step as u32 + 1, self.schedule.scale(progress as f32));
        self.buffers.field.stages.done("optimise");
        if self.model.corrections.is_some() {
            self.cameras = self.model.cameras();
        }
        if step.is_multiple_of(ERROR_REFRESH)
            && let Some(map) = &mut self.model.error_map
        {
            map.refresh();
        }
        let o = &mut self.model.origin;
        o.rays += rays;
        o.samples += samples;
        Ok(report)
    }

    fn save(&mut self, step: u64, seconds: f64) -> Result<bool> {
        self.settle()?;
        self.device.download(&mut self.model)?;
        if self.model.is_broken() {
            return Ok(false);
        }
        self.model.origin.step = step;
        self.model.origin.seconds = seconds;
        let (entries, metadata) = self.model.entries();
        checkpoint::save(self.checkpoints, &entries, metadata)?;
        Ok(true)
    }

    fn recover(&mut self) -> Result<Option<(u64, String)>> {
        let why = match self.setback.take() {
            // The host holds what the last checkpoint or judgement brought back.
            Some(Setback::Lost(why)) => return Ok(Some((self.model.origin.step, why))),
            Some(Setback::Full(why)) => {
                self.go_back()?;
                why
            }
            None if self.recovered => return Ok(None),
            None => {
                self.recovered = true;
                self.go_back()?;
                self.model.rate_scale *= 0.3;
                "the loss was not finite; the rate is lowered".into()
            }
        };
        self.cameras = self.model.cameras();
        self.device.upload(&self.model, &self.photographs, &self.observations)?;
        Ok(Some((self.model.origin.step, why)))
    }

    fn evaluate(&mut self) -> Result<Option<HeldOut>> {
        let Some(pixels) = &self.held_out else { return Ok(None) };
        match self.device.download(&mut self.model) {
            Ok(()) => Ok(Some(pixels.judge(&self.model))),
            // A device that fails here fails in the next step as well, which knows what to do.
            Err(PipelineError::Device(_) | PipelineError::Memory(_)) => Ok(None),
            Err(e) => Err(e),
        }
    }
}

impl Trainer<'_> {
    /// Takes the model back to the last checkpoint, or to its start, which is a function of the seed.
    fn go_back(&mut self) -> Result<()> {
        let m = &self.model;
        let mut fresh = ObjectModel::new(m.config.clone(), m.capture.clone(), m.has_alpha)?;
        if checkpoint::exists(self.checkpoints) {
            let (c, _) = checkpoint::load(self.checkpoints)?;
            fresh.restore(c, &checkpoint::latest(self.checkpoints))?;
        }
        self.model = fresh;
        Ok(())
    }
}

#[cfg(test)]
#[path = "recipe_tests.rs"]
mod tests;
