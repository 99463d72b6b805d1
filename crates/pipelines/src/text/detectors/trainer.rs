//! Training steps of a detector.

use super::config::{Config, Kind};
use super::network::{Detector, Sample};
use super::samples::{self, Pictures};
use crate::error::{PipelineError, Result};
use diorama_data::{DataError, checkpoint};
use diorama_engine::train::{Origin, Scalar, Scalars, StepReport, Trainee};
use diorama_nets::param;
use diorama_nets::train::{self, Gradients, Loader, LoaderSettings, Optimizer, Rule};
use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

/// Momentum of SGD.
const MOMENTUM: f32 = 0.9;
/// Batches that are made ahead by each worker.
const AHEAD: usize = 2;
/// Factor of the rate after a loss that is not finite.
const LOWER: f32 = 0.3;

/// A detector in training.
pub(super) struct Trainer<'a> {
    pub detector: Detector,
    pub origin: Origin,
    config: Config,
    optimizer: Optimizer,
    pictures: Arc<Pictures>,
    loader: Loader<std::result::Result<Sample, String>>,
    checkpoints: &'a Path,
    rate_scale: f32,
    recovered: bool,
}

fn optimizer(config: &Config, detector: &Detector) -> Optimizer {
    let o = &config.optim;
    let rule = if o.rule == "adam" { Rule::ADAM } else { Rule::Sgd { momentum: MOMENTUM, nesterov: false } };
    Optimizer::new(detector, rule, o.rate, o.weight_decay, &[])
}

/// Batches from number `from` on.
fn loader(config: &Config, pictures: &Arc<Pictures>, from: u64) -> Loader<std::result::Result<Sample, String>> {
    let (b, n) = (&config.batch, pictures.len());
    // Sets smaller than a batch are gone through several times for one.
    let items = n * b.size.div_ceil(n);
    let settings = LoaderSettings { seed: config.seed, items, batch: b.size, shuffle: true, workers: b.workers, ahead: AHEAD };
    let (config, pictures) = (config.clone(), pictures.clone());
    Loader::start(settings, from, move |key| {
        let (image, labels) = pictures.get(key.item % pictures.len()).map_err(|e| e.to_string())?;
        let (picture, labels) = samples::draw(&image, &labels, config.batch.crop, &config.augment, key.rng);
        Ok(Detector::sample(config.model, picture, &labels, config.data.least_px as f64))
    })
}

impl<'a> Trainer<'a> {
    pub fn new(config: Config, detector: Detector, pictures: Pictures, checkpoints: &'a Path) -> Trainer<'a> {
        let pictures = Arc::new(pictures);
        let (optimizer, loader) = (optimizer(&config, &detector), loader(&config, &pictures, 0));
        let origin = Origin::default();
        Trainer { detector, origin, config, optimizer, pictures, loader, checkpoints, rate_scale: 1.0, recovered: false }
    }

    /// Goes on from the last checkpoint; a note where that is not the newest file.
    ///
    /// # Errors
    /// When there is none, or it is of another network.
    pub fn restore(&mut self) -> Result<Option<String>> {
        let (c, note) = checkpoint::load(self.checkpoints)?;
        let file = checkpoint::latest(self.checkpoints);
        let number = |key: &str| {
            let value = c.metadata.get(key).and_then(|v| v.parse::<f64>().ok());
            value.ok_or_else(|| DataError::input(&file, format!("{key}: missing or no number; train again")))
        };
        let origin = Origin { step: number("step")? as u64, seconds: number("seconds")? };
        let rate_scale = number("rate_scale")? as f32;
        let arrays = c.into_arrays();
        train::resume(&self.detector, &mut self.optimizer, None, &arrays)
            .map_err(|e| DataError::input(&file, format!("{e}; use the configuration that it was trained with")))?;
        (self.origin, self.rate_scale) = (origin, rate_scale);
        self.loader = loader(&self.config, &self.pictures, self.optimizer.steps());
        Ok(note)
    }

    fn is_finite(&self) -> bool {
        let mut all = true;
        param::visit(&self.detector, &mut |_, p| all &= p.read(|v| v.iter().all(|v| v.is_finite())));
        all
    }
}

impl Trainee for Trainer<'_> {
    type Error = PipelineError;

    fn step(&mut self, _: u64, progress: f64) -> Result<StepReport> {
        let made = self.loader.next_batch().map_err(PipelineError::Device)?;
        let batch = made.into_iter().collect::<std::result::Result<Vec<Sample>, String>>().map_err(PipelineError::Usage)?;
        let loss = self.detector.loss(&batch)?;
        let total = diorama_nets::read_values(loss.total.clone())[0] as f64;
        let mut gradients = Gradients::take(&self.detector, diorama_nets::on_pool(|| loss.total.backward()));
        if total.is_finite() {
            if self.config.optim.clip_norm > 0.0 {
                gradients.clip_norm(self.config.optim.clip_norm);
            }
            let scale = self.rate_scale * self.config.rate_scale(progress);
            self.optimizer.step(&self.detector, gradients, scale);
        }
        let mut scalars: Vec<Scalar> = loss.parts.map(|(name, v)| Scalar::new(name, v)).into();
        scalars.push(Scalar::rate("images_per_s", batch.len() as f64));
        Ok(StepReport { loss: total, scalars: Scalars(scalars) })
    }

    fn save(&mut self, step: u64, seconds: f64) -> Result<bool> {
        if !self.is_finite() {
            return Ok(false);
        }
        self.origin = Origin { step, seconds };
        let metadata = [("step", step.to_string()), ("seconds", seconds.to_string()), ("rate_scale", self.rate_scale.to_string())];
        let metadata: HashMap<String, String> = metadata.into_iter().map(|(k, v)| (k.to_string(), v)).collect();
        checkpoint::save_arrays(self.checkpoints, &train::saved(&self.detector, &self.optimizer, None), metadata)?;
        Ok(true)
    }

    fn recover(&mut self) -> Result<Option<(u64, String)>> {
        if self.recovered {
            return Ok(None);
        }
        self.recovered = true;
        if checkpoint::exists(self.checkpoints) {
            self.restore()?;
        } else {
            let c = &self.config;
            self.detector = Detector::new(c.model, c.backbone, c.seed);
            self.optimizer = optimizer(c, &self.detector);
            self.loader = loader(c, &self.pictures, 0);
            self.origin = Origin::default();
        }
        self.rate_scale *= LOWER;
        Ok(Some((self.origin.step, "the loss was not finite; the rate is lowered".into())))
    }
}

/// Metadata of a file of a detector's weights.
pub(super) fn metadata(config: &Config) -> HashMap<String, String> {
    let of = |k: Kind| k.name().to_string();
    HashMap::from([("model".into(), of(config.model)), ("backbone".into(), config.backbone.name().into())])
}
