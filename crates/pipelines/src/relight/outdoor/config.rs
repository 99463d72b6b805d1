//! Everything that a run of the scene model depends on, as written to `config.toml`.

use crate::error::{PipelineError, Result};
use crate::run::config::{self, Configuration};
use diorama_engine::fields::{DensitySlope, Normals};
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
    /// Density before anything is learned, per inner cube.
    pub first_density: f32,
}

/// Light of the photographs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LightConfig {
    /// `session`: photographs of a session share their light; `image`: each has its own.
    pub of: String,
    /// Whether each photograph has a gain of its own, by channel.
    pub gain: bool,
    /// `sh`: spherical harmonics and a learned shadow; `sun`: a sun apart, whose shadows are those of the learned surfaces.
    pub model: String,
    /// Share of the steps before the sun is told apart.
    pub sun_from: f32,
    /// Times that suns and shadows are brought up to date with the surfaces.
    pub sun_updates: u64,
    /// Cells per axis in which surfaces are solid or not.
    pub sun_cells: usize,
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
    /// Opacity where a mask says that there is nothing but sky.
    pub masked_sky: f32,
    /// Opacity of rays above the horizon whose color is that of the sky.
    pub likely_sky: f32,
    /// Brightest twentieth of the albedo beyond a luminance of 0.9.
    pub gauge: f32,
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
    /// Share of the steps in which noise stands for the sky: a sky that learns at once explains surfaces, and the field stays empty.
    pub sky_from: f32,
}

/// Normals: a head of the network says them, and they are tied to the slope of the density.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NormalsConfig {
    /// Distances at which opacities are compared for the slope, at first and from `until` on, in inner cubes.
    pub first: f32,
    pub last: f32,
    /// Share of the steps in which the distance shrinks.
    pub until: f32,
    /// Weight of the angle between normal and slope.
    pub tie: f32,
    /// Share of the tie's gradient that the density gets.
    pub push: f32,
    /// Share of the gradient of colors that normals get: light that they explain badly bends them away from surfaces.
    pub lit: f32,
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
    pub normals: NormalsConfig,
    pub sampling: SamplingConfig,
    pub run: RunConfig,
}

impl OptimConfig {
    /// How much of the direction of light counts when a share of the steps is done.
    pub fn directed(&self, progress: f32) -> f32 {
        ((progress - self.even_until) / (self.directed_from - self.even_until).max(1e-6)).clamp(0.0, 1.0)
    }
}

impl LightConfig {
    /// Whether the sun is apart.
    pub fn has_sun(&self) -> bool {
        self.model == "sun"
    }

    /// Updates of suns and shadows that are due when a share of the steps is done.
    pub fn sun_updates_by(&self, progress: f32) -> u64 {
        if !self.has_sun() || progress < self.sun_from {
            return 0;
        }
        (((progress - self.sun_from) / (1.0 - self.sun_from) * self.sun_updates as f32) as u64 + 1).min(self.sun_updates)
    }
}

impl NormalsConfig {
    /// How slopes are computed when a share of the steps is done.
    pub fn of(&self, progress: f32) -> Normals {
        let slope = DensitySlope::annealed(progress / self.until.max(1e-6), self.first, self.last);
        Normals { slope, ..Normals::default() }
    }
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
                first_density: 1.0,
            },
            light: LightConfig {
                of: "session".into(),
                gain: false,
                model: "sh".into(),
                sun_from: 0.75,
                sun_updates: 4,
                sun_cells: pick(128, 256),
            },
            loss: LossConfig {
                huber: 0.1,
                robust: 0.0,
                orientation: 1e-4,
                shadow: 1e-2,
                negative: 0.1,
                distortion: 1e-4,
                masked_sky: 0.01,
                likely_sky: 0.02,
                gauge: 0.1,
            },
            optim: OptimConfig {
                grid_rate: 1e-2,
                net_rate: 1e-3,
                light_rate: 2e-2,
                final_scale: 0.05,
                even_until: 0.3,
                directed_from: 0.5,
                sky_from: 0.4,
            },
            normals: NormalsConfig { first: 1.0 / 64.0, last: 1.0 / 256.0, until: 0.6, tie: 1e-3, push: 0.0, lit: 0.0 },
            sampling: SamplingConfig {
                rays: pick(512, 4096),
                max_samples: 256,
                near: 0.02,
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
        if !["sh", "sun"].contains(&&self.light.model[..]) {
            return fault("light.model: expected sh or sun");
        }
        if !(0.0..1.0).contains(&self.light.sun_from) || self.light.sun_updates == 0 || !(16..=512).contains(&self.light.sun_cells) {
            return fault("light: sun_from must lie between 0 and 1, sun_updates be at least 1, sun_cells from 16 to 512");
        }
        let n = &self.normals;
        if !(n.last > 0.0 && n.first >= n.last && n.tie >= 0.0 && n.push >= 0.0 && n.lit >= 0.0) {
            return fault("normals: last must be above 0, first at least last, tie, push and lit 0 or more");
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
        if !(self.field.first_density > 0.0 && self.field.first_density.is_finite()) {
            return fault("field.first_density: must be above 0");
        }
        if self.data.downscale == 0 || self.sampling.rays == 0 || self.sampling.max_samples == 0 || self.sampling.occupancy_every == 0 {
            return fault("data.downscale, sampling.rays, max_samples and occupancy_every must be at least 1");
        }
        let weights = [
            self.loss.robust,
            self.loss.orientation,
            self.loss.shadow,
            self.loss.negative,
            self.loss.distortion,
            self.loss.masked_sky,
            self.loss.likely_sky,
            self.loss.gauge,
        ];
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
