//! Everything that the training of a detector depends on, as written to `config.toml`.

use super::boxes::{DbDecoding, EastDecoding};
use super::samples::AugmentConfig;
use crate::error::{PipelineError, Result};
use crate::run::config::{self, Configuration};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Detectors.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Zhou et al. 2017.
    East,
    /// Liao et al. 2020.
    Db,
}

/// Networks that detectors see with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backbone {
    /// Four stages of 16 to 128 channels, for CPUs.
    Tiny,
    Resnet50,
}

impl Kind {
    pub const ALL: [Kind; 2] = [Kind::East, Kind::Db];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Kind::East => "east",
            Kind::Db => "db",
        }
    }

    /// # Errors
    /// When the name is none.
    pub fn named(name: &str) -> Result<Kind> {
        let found = Kind::ALL.into_iter().find(|k| k.name() == name);
        found.ok_or_else(|| PipelineError::Usage(format!("--model {name:?}: expected east or db")))
    }
}

impl Backbone {
    pub const ALL: [Backbone; 2] = [Backbone::Tiny, Backbone::Resnet50];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Backbone::Tiny => "tiny",
            Backbone::Resnet50 => "resnet50",
        }
    }

    /// # Errors
    /// When the name is none.
    pub fn named(name: &str) -> Result<Backbone> {
        let found = Backbone::ALL.into_iter().find(|b| b.name() == name);
        found.ok_or_else(|| PipelineError::Usage(format!("--backbone {name:?}: expected tiny or resnet50")))
    }
}

/// The images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// Folder with `images/` and `icdar15/`.
    pub path: PathBuf,
    /// Images are shrunk until their longer side has at most so many pixels.
    pub most_px: usize,
    /// Writing whose shorter side has fewer pixels is ignored in training.
    pub least_px: f32,
    /// Bytes that decoded images may take; more of them are decoded again each time.
    pub memory_budget: u64,
}

/// Batches.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BatchConfig {
    pub size: usize,
    /// Pixels of a side of the square windows, a multiple of 32.
    pub crop: usize,
    /// Threads that make samples.
    pub workers: usize,
}

/// The optimizer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimConfig {
    /// `adam` or `sgd` (with a momentum of 0.9).
    pub rule: String,
    pub rate: f32,
    pub weight_decay: f32,
    /// `halfway` (a tenth from half of the run on), `poly` (`(1 − progress)^0.9`) or `constant`.
    pub schedule: String,
    /// Largest norm of the gradient; 0: any.
    pub clip_norm: f32,
}

/// How maps become boxes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DecodeConfig {
    pub east: EastDecoding,
    pub db: DbDecoding,
}

/// Length of the run and what it writes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// 0: no limit.
    pub steps: u64,
    /// 0: no limit.
    pub seconds: f64,
    pub log_every: u64,
    pub save_every_seconds: f64,
}

/// The whole configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    pub seed: u64,
    pub model: Kind,
    pub backbone: Backbone,
    pub data: DataConfig,
    pub augment: AugmentConfig,
    pub batch: BatchConfig,
    pub optim: OptimConfig,
    pub decode: DecodeConfig,
    pub run: RunConfig,
}

impl Config {
    /// The values of a detector.
    pub fn new(model: Kind, backbone: Backbone, path: PathBuf) -> Config {
        let is_tiny = backbone == Backbone::Tiny;
        let optim = match model {
            Kind::East => OptimConfig { rule: "adam".into(), rate: 1e-3, weight_decay: 0.0, schedule: "halfway".into(), clip_norm: 0.0 },
            Kind::Db => OptimConfig { rule: "sgd".into(), rate: 0.007, weight_decay: 1e-4, schedule: "poly".into(), clip_norm: 0.0 },
        };
        let crop = match (is_tiny, model) {
            (true, _) => 320,
            (false, Kind::East) => 512,
            (false, Kind::Db) => 640,
        };
        Config {
            seed: 0,
            model,
            backbone,
            data: DataConfig { path, most_px: 1280, least_px: 6.0, memory_budget: 2 << 30 },
            augment: AugmentConfig { rotation: 0.175, least_scale: 0.5, most_scale: 2.0, color: 0.2 },
            batch: BatchConfig { size: if is_tiny { 8 } else { 16 }, crop, workers: 2 },
            optim,
            decode: DecodeConfig::default(),
            run: RunConfig { steps: if is_tiny { 5000 } else { 100_000 }, seconds: 0.0, log_every: 20, save_every_seconds: 60.0 },
        }
    }

    /// Factor of the rate at a share of the run.
    pub fn rate_scale(&self, progress: f64) -> f32 {
        match &self.optim.schedule[..] {
            "halfway" if progress >= 0.5 => 0.1,
            "poly" => (1.0 - progress.clamp(0.0, 1.0)).powf(0.9) as f32,
            _ => 1.0,
        }
    }

    /// Overrides one value by its path.
    ///
    /// # Errors
    /// As [`config::set`].
    pub fn set(&mut self, key: &str, value: &str) -> Result<()> {
        config::set(self, key, value)
    }
}

impl Configuration for Config {
    const APPLICATION: &'static str = "detector";

    fn template() -> Config {
        Config::new(Kind::Db, Backbone::Tiny, PathBuf::new())
    }

    /// None: a set of labelled images is no capture.
    fn data_set(&mut self) -> Option<&mut PathBuf> {
        None
    }

    fn check(&self) -> Result<()> {
        let fault = |text: &str| Err(PipelineError::Usage(text.into()));
        let (b, o, a) = (&self.batch, &self.optim, &self.augment);
        if b.crop == 0 || !b.crop.is_multiple_of(32) || b.size == 0 || b.workers == 0 {
            return fault("batch: crop must be a multiple of 32, size and workers at least 1");
        }
        if !["adam", "sgd"].contains(&&o.rule[..]) {
            return fault("optim.rule: expected adam or sgd");
        }
        if !["halfway", "poly", "constant"].contains(&&o.schedule[..]) {
            return fault("optim.schedule: expected halfway, poly or constant");
        }
        if !(o.rate > 0.0 && o.rate.is_finite() && o.weight_decay >= 0.0 && o.clip_norm >= 0.0) {
            return fault("optim: rate must be above 0, weight_decay and clip_norm 0 or more");
        }
        if !(a.least_scale > 0.0 && a.most_scale >= a.least_scale && a.most_scale <= 16.0 && a.rotation >= 0.0 && a.color >= 0.0) {
            return fault("augment: scales must be above 0 and at most 16, the least not above the most, rotation and color 0 or more");
        }
        if self.data.most_px < 32 || self.data.least_px.is_nan() || self.data.least_px < 0.0 {
            return fault("data: most_px must be at least 32, least_px 0 or more");
        }
        let (e, d) = (&self.decode.east, &self.decode.db);
        let shares = [e.score, e.overlap as f32, d.pixel, d.score];
        if shares.iter().any(|v| !(0.0..1.0).contains(v)) || !(0.0..=10.0).contains(&d.unclip) || !(0.0..=1e3).contains(&d.least_px) {
            return fault("decode: scores, overlap and pixel must lie from 0 to below 1, unclip from 0 to 10, least_px from 0 to 1000");
        }
        if self.run.log_every == 0 || (self.run.steps == 0 && self.run.seconds <= 0.0) {
            return fault("run: give steps or seconds, and log_every of at least 1");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_follow_the_papers() {
        let scale = |kind| move |p: f64| Config::new(kind, Backbone::Tiny, PathBuf::new()).rate_scale(p);
        let (east, db) = (scale(Kind::East), scale(Kind::Db));
        assert_eq!([east(0.0), east(0.49), east(0.5), east(1.0)], [1.0, 1.0, 0.1, 0.1]);
        assert!((db(0.5) - 0.5f32.powf(0.9)).abs() < 1e-6 && (db(0.0), db(1.0)) == (1.0, 0.0));
    }

    #[test]
    fn configurations_come_back_and_faults_name_the_key() {
        for (kind, backbone) in [(Kind::East, Backbone::Tiny), (Kind::Db, Backbone::Resnet50)] {
            let c = Config::new(kind, backbone, "data".into());
            c.check().unwrap();
            assert_eq!(config::from_toml::<Config>(&config::to_toml(&c)), Ok(c));
        }
        let fault = |key: &str, value: &str| Config::template().set(key, value).unwrap_err().to_string();
        for (key, value, expected) in [
            ("batch.crop", "300", "batch: crop must be a multiple of 32"),
            ("optim.rule", "lion", "optim.rule: expected adam or sgd"),
            ("decode.db.unclip", "-1", "decode: "),
            ("augment.least_scale", "0", "augment: "),
            ("run.steps", "0", "run: give steps or seconds"),
            ("batch.corp", "32", "did you mean batch.crop"),
            ("model", "craft", "model"),
        ] {
            assert!(fault(key, value).contains(expected), "{}", fault(key, value));
        }
        assert!(Kind::named("craft").unwrap_err().to_string().contains("expected east or db"));
        assert!(Backbone::named("vgg").unwrap_err().to_string().contains("tiny or resnet50"));
    }
}
