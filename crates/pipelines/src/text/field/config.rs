//! Everything that a run of the field depends on, as written to `config.toml`.

use crate::error::{PipelineError, Result};
use crate::run::config::{self, Configuration};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Most classes, the background's among them.
pub const MOST_CLASSES: usize = 64;

/// Size of the field and length of its training.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Preset {
    /// Small: for tests and small photographs.
    Ci,
    /// For CPUs.
    Fast,
    Gpu,
}

impl Preset {
    /// # Errors
    /// When the name is none.
    pub fn named(name: &str) -> Result<Preset> {
        match name {
            "ci" => Ok(Preset::Ci),
            "fast" => Ok(Preset::Fast),
            "gpu" => Ok(Preset::Gpu),
            other => Err(PipelineError::Usage(format!("--preset {other:?}: expected ci, fast or gpu"))),
        }
    }
}

/// What is learned at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Density and color.
    Scene,
    /// Classes, on a density that stays.
    Labels,
}

/// Where the photographs and their labels are.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    pub path: PathBuf,
    pub downscale: u32,
    pub split: String,
    /// Bytes that pixels may take.
    pub memory_budget: u64,
}

/// Shape of the field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FieldConfig {
    pub levels: usize,
    /// `log2` of the most rows per level.
    pub log2_size: u32,
    pub base: u32,
    /// Cells per axis at the finest level, over the inner cube.
    pub finest: u32,
    /// Numbers of the code of a photograph.
    pub appearance: usize,
    /// `box` or `unbounded`.
    pub space: String,
}

/// The head of classes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabelConfig {
    /// Share of the steps that learn classes, at the end.
    pub share: f32,
    pub width: usize,
    /// Bands of the triangle waves of the position that the head reads; 0: it reads the density's features alone.
    pub waves: usize,
}

/// Weights of the loss.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossConfig {
    /// Spread of a ray's weights (Barron et al. 2022).
    pub distortion: f32,
    /// Stochastic structural similarity (Xie et al. 2023), and edges of its tiles in pixels: height and width.
    pub s3im: f32,
    pub tile: [usize; 2],
    /// Entropy `−o ln o` of opacities.
    pub opacity: f32,
    /// Labels that depth carries to other photographs, over those that were given.
    pub proxy: f32,
    /// Relative error of depth where the distance is known.
    pub depth: f32,
    /// Mean optical depth of the space before known distances; runs that do not say have none.
    #[serde(default)]
    pub empty: f32,
    /// Gradients of samples nearer than this many inner cubes are scaled by the squared share (Philip and Deschaintre 2023), against fog
    /// before cameras.
    pub near_scaling: f32,
}

/// Rates and their course.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimConfig {
    pub rate: f32,
    /// Of the head of classes.
    pub label_rate: f32,
    /// Rate at the end over the rate at the start.
    pub final_scale: f32,
}

/// Rays and samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamplingConfig {
    /// Rays per step, a multiple of a tile's pixels.
    pub rays: usize,
    pub max_samples: usize,
    /// Nearest distance at which matter may be, in inner cubes; 0: told by pixels of known distance.
    pub near: f32,
    pub occupancy_resolution: usize,
    pub occupancy_points: usize,
    pub occupancy_every: u64,
}

/// Length of the run and what it writes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Of both stages.
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
    /// `auto`, `cpu`, or a GPU.
    pub device: String,
    pub data: DataConfig,
    pub field: FieldConfig,
    pub labels: LabelConfig,
    pub loss: LossConfig,
    pub optim: OptimConfig,
    pub sampling: SamplingConfig,
    pub run: RunConfig,
}

impl Config {
    /// The values of a preset.
    pub fn new(preset: Preset, path: PathBuf) -> Config {
        let pick = |ci: usize, fast: usize, gpu: usize| match preset {
            Preset::Ci => ci,
            Preset::Fast => fast,
            Preset::Gpu => gpu,
        };
        let steps = [600, 4000, 20_000].map(|n| n as f32);
        let labels = [200, 800, 2000].map(|n| n as f32);
        let of = pick(0, 1, 2);
        let tile = pick(32, 32, 64);
        Config {
            seed: 0,
            device: "auto".into(),
            data: DataConfig { path, downscale: 1, split: "file".into(), memory_budget: 4 << 30 },
            field: FieldConfig {
                levels: pick(8, 16, 16),
                log2_size: pick(14, 17, 19) as u32,
                base: 16,
                finest: pick(512, 2048, 2048) as u32,
                appearance: 32,
                space: "unbounded".into(),
            },
            labels: LabelConfig { share: labels[of] / (steps[of] + labels[of]), width: pick(32, 64, 64), waves: 12 },
            loss: LossConfig {
                distortion: 1e-3,
                s3im: 1.0,
                tile: [tile; 2],
                opacity: 1e-3,
                proxy: 0.3,
                depth: 1.0,
                empty: 0.1,
                near_scaling: 1.0,
            },
            optim: OptimConfig { rate: 1e-2, label_rate: 1e-2, final_scale: 1.0 / 30.0 },
            sampling: SamplingConfig {
                rays: pick(1024, 2048, 8192),
                max_samples: 1024,
                near: 0.0,
                occupancy_resolution: 128,
                occupancy_points: 1 << 16,
                occupancy_every: 16,
            },
            run: RunConfig { steps: pick(800, 4800, 22_000) as u64, seconds: 0.0, log_every: 50, save_every_seconds: 60.0 },
        }
    }

    /// Stage of a run of which a share is done, and the share of the stage.
    pub fn stage(&self, progress: f32) -> (Stage, f32) {
        let from = 1.0 - self.labels.share;
        match progress < from {
            true => (Stage::Scene, progress / from),
            false => (Stage::Labels, ((progress - from) / self.labels.share).min(1.0)),
        }
    }
}

impl Configuration for Config {
    const APPLICATION: &'static str = "text";

    fn template() -> Config {
        Config::new(Preset::Fast, PathBuf::new())
    }

    fn data_set(&mut self) -> Option<&mut PathBuf> {
        Some(&mut self.data.path)
    }

    fn check(&self) -> Result<()> {
        let fault = |text: String| Err(PipelineError::Usage(text));
        let (f, s, [h, w]) = (&self.field, &self.sampling, self.loss.tile);
        if !["box", "unbounded"].contains(&&f.space[..]) {
            return fault("field.space: expected box or unbounded".into());
        }
        if f.levels == 0 || f.base == 0 || f.finest < f.base || !(4..=24).contains(&f.log2_size) {
            return fault("field: levels and base must be at least 1, finest at least base, log2_size from 4 to 24".into());
        }
        if !(1..=256).contains(&f.appearance) {
            return fault("field.appearance: must be from 1 to 256".into());
        }
        let l = &self.labels;
        if !(l.share > 0.0 && l.share < 1.0) || l.width == 0 || !l.width.is_multiple_of(16) || l.width > 512 || l.waves > 24 {
            return fault("labels: share must lie between 0 and 1, width be a multiple of 16 up to 512, waves at most 24".into());
        }
        let l = &self.loss;
        let weights = [l.distortion, l.s3im, l.opacity, l.proxy, l.depth, l.empty, l.near_scaling];
        if weights.iter().any(|v| !(*v >= 0.0 && v.is_finite())) {
            return fault("loss: weights must be 0 or more".into());
        }
        if h < 4 || w < 4 || s.rays == 0 || !s.rays.is_multiple_of(h * w) {
            let what = format!("sampling.rays: {} rays do not fill tiles of {h} x {w} pixels (loss.tile), each edge at least 4", s.rays);
            return fault(what);
        }
        if self.data.downscale == 0 || s.max_samples == 0 || s.occupancy_every == 0 {
            return fault("data.downscale, sampling.max_samples and occupancy_every must be at least 1".into());
        }
        if self.run.steps == 0 && self.run.seconds <= 0.0 {
            return fault("run: give steps or seconds".into());
        }
        Ok(())
    }
}

impl Config {
    /// Overrides one value by its path.
    ///
    /// # Errors
    /// As [`config::set`].
    pub fn set(&mut self, key: &str, value: &str) -> Result<()> {
        config::set(self, key, value)
    }
}
