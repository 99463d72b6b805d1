//! Training of an object run: describes each step by the configuration, carries it out on the device, and saves, recovers and evaluates.

use super::config::{Background, Method};
use super::device;
use super::held_out::HeldOutPixels;
use super::memory;
use super::model::ObjectModel;
use super::viewing::RunView;
use crate::error::{PipelineError, Result};
use crate::run::device::{Aftermath, Device, Pictures, aftermath};
use crate::run::photographs::StoredPhotographs;
use diorama_data::checkpoint;
use diorama_engine::samplers::pixels::Observation;
use diorama_engine::samplers::placement::Placement;
use diorama_engine::step::{Backdrop, Figures, Loss, Probes, RaySource, Step};
use diorama_engine::train::{Scalar, Scalars, Scores, StepReport, Trainee};
use diorama_geom::rng::Rng;
use std::path::Path;

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

/// Room for marched and for trained samples on a GPU, in wanted samples per step.
const ROOM: (usize, usize) = (6, 2);

/// Share of the room for marched samples that rays are meant to fill.
const FILL: f64 = 0.9;

/// Most steps between which a GPU is not asked how they went.
const UNASKED: u64 = 16;

/// A device's failure that training survives; why, in words.
enum Setback {
    /// The CPU goes on from what the host holds.
    Lost(String),
    /// The device goes on from the last checkpoint, with a smaller batch.
    Full(String),
}

/// A model in training.
pub(super) struct Trainer<'a> {
    pub model: ObjectModel,
    pub photographs: StoredPhotographs,
    /// Pixels of known distance; none where they do not count.
    pub observations: Vec<Observation>,
    pub device: Device,
    pub held_out: Option<HeldOutPixels>,
    /// PSNR of each held-out view when they were judged last, named by its frame.
    pub judged: Vec<(usize, f64)>,
    /// Viewer of the run.
    pub view: Option<&'a RunView>,
    /// Samples before any were left out.
    pub marched: u64,
    /// Rays that did not lose samples for want of room.
    pub whole: u64,
    /// Samples per ray that a device marched to when it was asked last, without regard to the room of the last wave; 0: not asked yet.
    marched_per_ray: f64,
    /// Rays that were trained on before this part of the run.
    began: u64,
    checkpoints: &'a Path,
    recovered: bool,
    /// How a device failed, and what was made of it.
    setback: Option<Setback>,
}

impl<'a> Trainer<'a> {
    pub fn new(
        model: ObjectModel,
        photographs: StoredPhotographs,
        observations: Vec<Observation>,
        checkpoints: &'a Path,
        device: Device,
    ) -> Result<Self> {
        let mut trainer = Trainer {
            model,
            photographs,
            observations,
            device,
            held_out: None,
            judged: Vec::new(),
            view: None,
            began: 0,
            marched: 0,
            whole: 0,
            marched_per_ray: 0.0,
            checkpoints,
            recovered: false,
            setback: None,
        };
        trainer.began = trainer.model.rays;
        trainer.begin()?;
        Ok(trainer)
    }

    /// Uploads the model to the device.
    fn begin(&mut self) -> Result<()> {
        self.marched_per_ray = 0.0;
        let scene = self.model.scene();
        let pictures = Pictures { photographs: &self.photographs, observations: &self.observations };
        self.device.begin(&self.model.trainees(), scene, Some(pictures))
    }

    /// Shows the model as it is now in the viewer.
    pub fn show(&mut self) -> Result<()> {
        if let Some(view) = self.view {
            self.download()?;
            view.show(self.model.for_rendering());
        }
        Ok(())
    }

    /// Downloads the model from the device.
    pub fn download(&mut self) -> Result<()> {
        self.device.download(&mut self.model.trainees())
    }

    /// Waits for a GPU and counts what it has done.
    pub fn settle(&mut self) -> Result<()> {
        let counted = self.device.count()?;
        counted.into_iter().for_each(|f| self.count(&f));
        Ok(())
    }

    /// Adds the counts of steps.
    fn count(&mut self, f: &Figures) {
        let m = &mut self.model;
        let before = m.samples;
        m.samples += f.trained as u64;
        self.marched += f.marched as u64;
        self.whole += f.whole;
        if self.device.is_gpu() && f.rays > 0 {
            self.marched_per_ray = f.marched / f.rays as f64;
        }
        // Without an occupancy grid, each ray has as many samples as the configuration says.
        if m.occupancy.is_none() && !self.device.is_gpu() {
            return;
        }
        // Rays that were cut for want of room say nothing of what a ray needs.
        if f.whole == 0 {
            return;
        }
        let per_ray = f.trained / f.whole as f64;
        match before {
            0 => m.samples_per_ray = per_ray,
            _ => (0..f.steps).for_each(|_| m.samples_per_ray = 0.9 * m.samples_per_ray + 0.1 * per_ray),
        }
    }

    /// As many rays as give about the wanted number of samples, fewer while coarse steps in quick succession
    /// teach more, and no more than a device has room for.
    fn rays(&self, step: u64) -> usize {
        let s = &self.model.config.sampling;
        if s.rays > 0 {
            return (s.rays >> self.device.halvings()).max(1);
        }
        let (from, until) = BATCH_RAMP;
        let grown = step.saturating_sub(from) as f64 / (until - from) as f64;
        let n = self.batch_samples() as f64 * (0.25 + 0.75 * grown.min(1.0)) / self.model.samples_per_ray.max(1.0);
        let fitting = fitting(self.batch_samples() * ROOM.0, self.marched_per_ray);
        (n as usize).min(fitting).clamp(64, self.device.most_rays()).next_multiple_of(64)
    }

    fn batch_samples(&self) -> usize {
        self.device.batch_samples(device::batch_samples(&self.model.config, self.device.is_hardware()))
    }

    /// A training step as the configuration describes it.
    fn describe(&self, step: u64, progress: f64) -> Step<'static> {
        let m = &self.model;
        let (c, s) = (&m.config, &m.config.sampling);
        let is_random = match c.background {
            Background::Random => true,
            Background::Auto => c.method == Method::Ngp,
            _ => false,
        };
        let of = |stream: u64| Rng::new(c.seed, stream);
        let placement = match (&m.occupancy, &m.coarse) {
            (Some(grid), _) => {
                Placement::Occupancy { march: grid.march_config(s.max_samples).stretched(stretch(step)), pruning: m.pruning() }
            }
            (None, Some(_)) => Placement::Hierarchical { samples: s.samples, more: s.importance, noise: Some([of(COARSE), of(FINE)]) },
            (None, None) => Placement::Stratified { samples: s.samples, noise: Some(of(COARSE)) },
        };
        let (until, block) = OCCUPANCY_WARMUP;
        let block = if step <= until { block } else { 1 };
        let is_probed = m.occupancy.is_some() && step > 0 && step.is_multiple_of(s.occupancy_every);
        Step {
            number: step,
            rays: RaySource::Photographs { count: self.rays(step), rng: of(PIXELS) },
            first: m.rays,
            backdrop: if is_random { Backdrop::Random(of(BACKGROUND)) } else { Backdrop::Color(m.backdrop_color()) },
            placement,
            room: (self.batch_samples() * ROOM.0, self.batch_samples() * ROOM.1),
            probes: is_probed.then(|| Probes { rng: of(OCCUPANCY), points: s.occupancy_points, block }),
            loss: Loss::Photometric(m.terms(step)),
            near_scaling: c.loss.near_scaling,
            progress: progress as f32,
            rate_scale: m.rate_scale,
            refresh_errors: step.is_multiple_of(ERROR_REFRESH),
        }
    }

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

    /// Decides how to go on after a device's failure.
    fn survive(&mut self, e: PipelineError) -> Result<Setback> {
        let m = &self.model;
        let needs = memory::of_training(&m.config, &m.capture, self.photographs.store().format(), self.batch_samples()).to_string();
        Ok(match aftermath(e, &m.config.device, self.device.halvings(), &needs) {
            Aftermath::Fail(e) => return Err(e),
            Aftermath::Cpu(why) => {
                self.device = Device::cpu(None);
                Setback::Lost(why)
            }
            Aftermath::Halve(why) => {
                self.device.halve();
                Setback::Full(why)
            }
        })
    }
}

impl Trainee for Trainer<'_> {
    type Error = PipelineError;

    fn step(&mut self, step: u64, progress: f64) -> Result<StepReport> {
        if self.view.is_some_and(RunView::wants_update) {
            // A device that fails here fails in the step below as well, which knows what to do.
            let _ = self.show();
        }
        let described = self.describe(step, progress);
        let pictures = Pictures { photographs: &self.photographs, observations: &self.observations };
        let ask_every = UNASKED.min(self.model.config.run.log_every);
        let done = match self.device.step(&mut self.model.trainees(), Some(pictures), &described, ask_every) {
            Ok(done) => done,
            Err(e) => {
                self.setback = Some(self.survive(e)?);
                return Ok(StepReport { loss: f64::NAN, ..StepReport::default() });
            }
        };
        let (rays, f) = (described.rays.count() as u64, done.shown);
        if f.loss.is_finite() {
            self.model.rays += rays;
            done.counted.iter().for_each(|f| self.count(f));
        }
        let m = &self.model;
        let whole = if f.rays > 0 { f.whole as f64 / f.rays as f64 } else { 1.0 };
        let scalars = Scalars::from([
            Scalar::new("mse", f.mse).logged_only(),
            Scalar::psnr("psnr", f.mse),
            Scalar::count("rays", m.rays),
            Scalar::count("samples", m.samples),
            // Only rays that were trained on.
            Scalar::rate("rays_per_s", rays as f64 * whole),
        ]);
        Ok(StepReport { loss: f.loss, scalars })
    }

    fn save(&mut self, step: u64, seconds: f64) -> Result<bool> {
        match self.settle().and_then(|()| self.download()) {
            Ok(()) => {}
            Err(e) => {
                self.setback = Some(self.survive(e)?);
                return Ok(false);
            }
        }
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
            Some(Setback::Lost(why)) => {
                self.begin()?;
                return Ok(Some((self.model.origin.step, why)));
            }
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
        self.begin()?;
        Ok(Some((self.model.origin.step, why)))
    }

    fn evaluate(&mut self) -> Result<Option<Scores>> {
        let Some(pixels) = &self.held_out else { return Ok(None) };
        match self.device.download(&mut self.model.trainees()) {
            Ok(()) => {}
            // A device that fails here fails in the next step as well, which knows what to do.
            Err(PipelineError::Device(_) | PipelineError::Memory(_)) => return Ok(None),
            Err(e) => return Err(e),
        }
        let judged = pixels.judge(&self.model);
        let scores = judged.scores();
        self.view.into_iter().for_each(|v| v.mark_fog(&judged.views));
        self.judged = judged.views;
        Ok(Some(scores))
    }

    /// Its pixels take as long as if they were trained on.
    fn evaluation_seconds(&self, seconds: f64) -> f64 {
        let trained = self.model.rays.saturating_sub(self.began).max(1);
        self.held_out.as_ref().map_or(0.0, |h| h.rays() as f64 * seconds / trained as f64)
    }
}

/// Rays whose marched samples find room, at so many per ray; 0: not known.
fn fitting(room: usize, marched_per_ray: f64) -> usize {
    if marched_per_ray > 0.0 { (FILL * room as f64 / marched_per_ray) as usize } else { usize::MAX }
}

/// How much longer a march's steps are at a training step.
fn stretch(step: u64) -> f32 {
    let (most, until) = MARCH_RAMP;
    most.powf(1.0 - step.min(until) as f32 / until as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_fill_no_more_than_the_room_for_marched_samples() {
        let room = (1 << 18) * ROOM.0;
        assert_eq!(fitting(room, 0.0), usize::MAX, "nothing is known before the first step");
        for needed in [0.3, 12.0, 150.0, 4096.0] {
            let marched = fitting(room, needed) as f64 * needed;
            assert!(marched <= FILL * room as f64 && marched > FILL * room as f64 - needed, "{needed}: {marched}");
        }
    }
}
