//! Everything that a run of the scene model depends on, as written to `config.toml`.

use crate::error::{PipelineError, Result};
use crate::run::config::{self, Configuration};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Size of the model and length of its training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// Small: for tests and small photographs.
    Ci,
    Fast,
}

/// Where the photographs are and how they are read.
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
    /// Width of hidden layers.
    pub width: usize,
    /// `box` or `unbounded`.
    pub space: String,
}

/// Light of the photographs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LightConfig {
    /// `session`: photographs of a session share their light; `image`: each has its own.
    pub of: String,
    /// Whether each photograph has a gain of its own, by channel.
    pub gain: bool,
}

/// Weights of the loss.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossConfig {
    /// Width of the Huber loss's quadratic part, in sRGB.
    pub huber: f32,
    /// Error beyond which a pixel counts less and less, in multiples of the running median; 0: all count alike.
    pub robust: f32,
    /// Normals that face away from the camera.
    pub orientation: f32,
    /// Deviation of the shadow from 1.
    pub shadow: f32,
    /// Negative irradiance.
    pub negative: f32,
    /// Spread of a ray's weights (Barron et al. 2022).
    pub distortion: f32,
}

/// Rates and their course.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimConfig {
    pub grid_rate: f32,
    pub net_rate: f32,
    pub light_rate: f32,
    /// Rate at the end over the rate at the start.
    pub final_scale: f32,
    /// Shares of the steps between which light gains its direction: before, it is even, and normals do not matter.
    pub even_until: f32,
    pub directed_from: f32,
    /// Share of the steps in which normals come from density differences at a distance that shrinks.
    pub anneal: f32,
}

/// Rays and samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamplingConfig {
    pub rays: usize,
    pub max_samples: usize,
    /// Nearest distance at which matter may be, in inner cubes.
    pub near: f32,
    pub occupancy_resolution: usize,
    pub occupancy_points: usize,
    pub occupancy_every: u64,
}

/// Length of the run and what it writes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
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
    pub data: DataConfig,
    pub field: FieldConfig,
    pub light: LightConfig,
    pub loss: LossConfig,
    pub optim: OptimConfig,
    pub sampling: SamplingConfig,
    pub run: RunConfig,
}

impl Config {
    /// The values of a preset.
    pub fn new(preset: Preset, path: PathBuf) -> Config {
        let ci = preset == Preset::Ci;
        let pick = |small: usize, large: usize| if ci { small } else { large };
        Config {
            seed: 0,
            data: DataConfig { path, downscale: 1, split: "file".into(), memory_budget: 4 << 30 },
            field: FieldConfig {
                levels: pick(8, 16),
                log2_size: pick(14, 19) as u32,
                base: 16,
                finest: pick(256, 2048) as u32,
                width: pick(32, 64),
                space: "box".into(),
            },
            light: LightConfig { of: "session".into(), gain: false },
            loss: LossConfig { huber: 0.1, robust: 0.0, orientation: 1e-3, shadow: 1e-2, negative: 0.1, distortion: 1e-2 },
            optim: OptimConfig {
                grid_rate: 1e-2,
                net_rate: 1e-3,
                light_rate: 5e-3,
                final_scale: 0.05,
                even_until: 0.15,
                directed_from: 0.4,
                anneal: 0.6,
            },
            sampling: SamplingConfig {
                rays: pick(512, 4096),
                max_samples: 256,
                near: 0.05,
                occupancy_resolution: pick(64, 128),
                occupancy_points: pick(1 << 14, 1 << 17),
                occupancy_every: 16,
            },
            run: RunConfig { steps: pick(1500, 20_000) as u64, seconds: 0.0, log_every: 50, save_every_seconds: 60.0 },
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
    const APPLICATION: &'static str = "relight";

    fn template() -> Config {
        Config::new(Preset::Fast, PathBuf::new())
    }

    fn data_set(&mut self) -> Option<&mut PathBuf> {
        Some(&mut self.data.path)
    }

    fn check(&self) -> Result<()> {
        let fault = |text: &str| Err(PipelineError::Usage(text.into()));
        if !["box", "unbounded"].contains(&&self.field.space[..]) {
            return fault("field.space: expected box or unbounded");
        }
        if !["session", "image"].contains(&&self.light.of[..]) {
            return fault("light.of: expected session or image");
        }
        if self.field.width == 0 || !self.field.width.is_multiple_of(16) || self.field.width > 512 {
            return fault("field.width: must be a multiple of 16 up to 512");
        }
        if self.field.levels == 0
            || self.field.base == 0
            || self.field.finest < self.field.base
            || !(4..=24).contains(&self.field.log2_size)
        {
            return fault("field: levels and base must be at least 1, finest at least base, log2_size from 4 to 24");
        }
        if self.data.downscale == 0 || self.sampling.rays == 0 || self.sampling.max_samples == 0 || self.sampling.occupancy_every == 0 {
            return fault("data.downscale, sampling.rays, max_samples and occupancy_every must be at least 1");
        }
        let weights = [self.loss.robust, self.loss.orientation, self.loss.shadow, self.loss.negative, self.loss.distortion];
        if self.loss.huber <= 0.0 || weights.iter().any(|w| !(*w >= 0.0 && w.is_finite())) {
            return fault("loss: huber must be above 0, weights 0 or more");
        }
        if self.run.steps == 0 && self.run.seconds <= 0.0 {
            return fault("run: give steps or seconds");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_sound_and_wrong_values_are_refused() {
        for preset in [Preset::Ci, Preset::Fast] {
            Config::new(preset, "d".into()).check().unwrap();
        }
        let mut c = Config::template();
        for (key, value) in
            [("light.of", "sun"), ("field.width", "20"), ("loss.huber", "0"), ("sampling.rays", "0"), ("field.space", "cube")]
        {
            let e = c.clone().set(key, value).unwrap_err();
            assert!(e.is_input() && e.to_string().contains(key.split('.').next().unwrap()), "{e}");
        }
        assert!(c.set("loss.robst", "1").unwrap_err().to_string().contains("loss.robust"));
    }
}
