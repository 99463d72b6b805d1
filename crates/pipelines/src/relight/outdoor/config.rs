//! Everything that a run of the scene model depends on, as written to `config.toml`.

use crate::error::{PipelineError, Result};
use crate::run::config::{self, Configuration};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// What only the hash grid and its stages read.
const GRID_KEYS: [&str; 23] = [
    "field.levels",
    "field.log2_size",
    "field.base",
    "field.finest",
    "field.appearance",
    "field.space",
    "field.first_density",
    "light.from",
    "light.sun_cells",
    "loss.huber",
    "loss.robust",
    "loss.traced",
    "loss.normal",
    "loss.negative",
    "loss.distortion",
    "loss.depth",
    "loss.gauge",
    "loss.retinex",
    "loss.near_scaling",
    "optim.grid_rate",
    "optim.table_decay",
    "sampling.batch_samples",
    "sampling.max_samples",
];

/// Size of the model and length of its training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// Small: for tests and small photographs.
    Ci,
    Fast,
    /// The network as printed, all at once (Rudnev et al. 2022), for comparisons: days on a CPU.
    Paper,
}

/// What a run learns at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Surfaces, and how they look in each light.
    Surfaces,
    /// Albedo, shadow and light on surfaces that stay.
    Light,
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
    /// `grid`: a hash grid, in two stages; `mlp`: the network as printed, all at once ([`super::joint`]).
    #[serde(default = "grid")]
    pub kind: String,
    /// Bands of the encoding of `mlp`, and whether a network besides learns what lies around its sphere.
    #[serde(default = "twelve")]
    pub bands: usize,
    #[serde(default = "yes")]
    pub background: bool,
    pub levels: usize,
    /// `log2` of the most rows per level.
    pub log2_size: u32,
    pub base: u32,
    /// Cells per axis at the finest level, over the inner cube.
    pub finest: u32,
    /// Width of the hidden layers: of albedo, shadow and normal, or of all that `mlp` has.
    pub width: usize,
    /// Numbers of the code of a light.
    pub appearance: usize,
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
    /// Share of the steps in which surfaces are learned, before light is told apart.
    pub from: f32,
    /// Cells per axis of the optical depths that cast shadows.
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
    /// Deviation of the shadow from 1 where it is not traced, or with suns apart a thirtieth of it from the traced one, and of what is left of any sun
    /// from all; and from the traced one, or with suns apart of what is left of any sun from what arrives of those of training.
    pub shadow: f32,
    pub traced: f32,
    /// Angle between the normals that the field says and those of its surfaces.
    pub normal: f32,
    /// Negative irradiance.
    pub negative: f32,
    /// Spread of a ray's weights (Barron et al. 2022), from nothing at first to this while coarse surfaces are found.
    pub distortion: f32,
    /// Light that ends away from the distance that sparse points, planes or comparing photographs tell.
    pub depth: f32,
    /// Brightest twentieth of the albedo beyond a luminance of 0.9.
    pub gauge: f32,
    /// Albedo that differs between neighboring pixels which look alike (Land and McCann 1971); 0: none, else rays are drawn in pairs.
    #[serde(default)]
    pub retinex: f32,
    /// Distance, in inner cubes, within which samples learn more slowly the closer they are to the camera; 0: none.
    #[serde(default = "one_cube")]
    pub near_scaling: f32,
}

fn grid() -> String {
    "grid".into()
}

fn twelve() -> usize {
    12
}

fn yes() -> bool {
    true
}

fn first_samples() -> usize {
    64
}

fn more_samples() -> usize {
    128
}

fn one_cube() -> f32 {
    1.0
}

/// Rates and their course.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimConfig {
    /// Of the surfaces: grid and network alike.
    pub grid_rate: f32,
    pub table_decay: f32,
    /// Of the heads of albedo, shadow and normal.
    pub net_rate: f32,
    pub light_rate: f32,
    /// Rate at the end over the rate at the start.
    pub final_scale: f32,
}

/// Rays and samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamplingConfig {
    /// Rays per step; 0: as many as give `batch_samples` samples.
    pub rays: usize,
    pub batch_samples: usize,
    pub max_samples: usize,
    /// Samples per ray of the coarse network of `mlp`, and those that the fine one has besides.
    #[serde(default = "first_samples")]
    pub coarse: usize,
    #[serde(default = "more_samples")]
    pub fine: usize,
    /// Nearest distance at which matter may be, in inner cubes; 0: told by comparing photographs.
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

impl LightConfig {
    /// Whether the sun is apart.
    pub fn has_sun(&self) -> bool {
        self.model == "sun"
    }

    /// Stage of a run of which a share is done, and the share of the stage: first surfaces, then light.
    pub fn stage(&self, progress: f32) -> (Stage, f32) {
        match progress < self.from {
            true => (Stage::Surfaces, progress / self.from),
            false => (Stage::Light, ((progress - self.from) / (1.0 - self.from)).min(1.0)),
        }
    }
}

impl FieldConfig {
    /// Whether everything is learned at once, by the network as printed.
    pub fn is_joint(&self) -> bool {
        self.kind == "mlp"
    }
}

impl Config {
    /// The values of a preset.
    pub fn new(preset: Preset, path: PathBuf) -> Config {
        if preset == Preset::Paper {
            return Config::printed(path);
        }
        let ci = preset == Preset::Ci;
        let pick = |small: usize, large: usize| if ci { small } else { large };
        Config {
            seed: 0,
            data: DataConfig { path, downscale: 1, split: "file".into(), memory_budget: 4 << 30 },
            field: FieldConfig {
                kind: grid(),
                bands: twelve(),
                background: true,
                levels: 16,
                log2_size: pick(16, 19) as u32,
                base: 16,
                finest: pick(512, 2048) as u32,
                width: pick(32, 64),
                appearance: 8,
                space: "unbounded".into(),
                first_density: 0.1,
            },
            light: LightConfig { of: "session".into(), gain: false, model: "sh".into(), from: 0.85, sun_cells: pick(256, 512) },
            loss: LossConfig {
                huber: 0.1,
                robust: 2.0,
                shadow: 3e-3,
                traced: 0.1,
                normal: 0.1,
                negative: 0.1,
                distortion: 0.1,
                depth: 0.3,
                gauge: 0.1,
                retinex: 0.0,
                near_scaling: 0.0,
            },
            optim: OptimConfig { grid_rate: 1.5e-2, table_decay: 1e-5, net_rate: 3e-3, light_rate: 5e-3, final_scale: 0.05 },
            sampling: SamplingConfig {
                rays: 0,
                batch_samples: pick(1 << 15, 1 << 16),
                max_samples: 1024,
                coarse: first_samples(),
                fine: more_samples(),
                near: 0.0,
                occupancy_resolution: 128,
                occupancy_points: 1 << 16,
                occupancy_every: 16,
            },
            run: RunConfig { steps: pick(3000, 20_000) as u64, seconds: 0.0, log_every: 50, save_every_seconds: 60.0 },
        }
    }

    /// A key of the hash grid alone that has another value than presets give it.
    fn unread_by_mlp(&self) -> Option<&'static str> {
        let value =
            |c: &Config, key: &str| serde_json::to_value(c).expect("plain values").pointer(&format!("/{}", key.replace('.', "/"))).cloned();
        let presets = [Preset::Ci, Preset::Fast, Preset::Paper].map(|p| Config::new(p, PathBuf::new()));
        GRID_KEYS.into_iter().find(|key| presets.iter().all(|p| value(p, key) != value(self, key)))
    }

    /// The values of Rudnev et al. 2022.
    fn printed(path: PathBuf) -> Config {
        let mut c = Config::new(Preset::Fast, path);
        (c.field.kind, c.field.width) = ("mlp".into(), 256);
        (c.loss.shadow, c.loss.depth) = (1e-2, 0.0);
        (c.optim.net_rate, c.optim.light_rate, c.optim.final_scale) = (5e-4, 5e-4, 1.0);
        c.sampling.rays = 1024;
        c.run.steps = 500_000;
        c
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
        if !["grid", "mlp"].contains(&&self.field.kind[..]) {
            return fault("field.kind: expected grid or mlp");
        }
        if self.field.is_joint() {
            if self.light.has_sun() || self.light.gain {
                return fault("field.kind=mlp learns harmonics alone: leave out --light sun and light.gain");
            }
            let samples = [self.sampling.rays, self.sampling.coarse, self.sampling.fine];
            if samples.contains(&0) || !(1..=20).contains(&self.field.bands) {
                return fault("field.kind=mlp: sampling.rays, coarse and fine must be at least 1, field.bands from 1 to 20");
            }
            if let Some(key) = self.unread_by_mlp() {
                return fault(&format!("{key}: field.kind=mlp does not use it; leave it out"));
            }
        }
        if !["session", "image"].contains(&&self.light.of[..]) {
            return fault("light.of: expected session or image");
        }
        if !["sh", "sun"].contains(&&self.light.model[..]) {
            return fault("light.model: expected sh or sun");
        }
        if !(self.light.from > 0.0 && self.light.from < 1.0 && (16..=512).contains(&self.light.sun_cells)) {
            return fault("light: from must lie between 0 and 1, sun_cells from 16 to 512");
        }
        if !(1..=256).contains(&self.field.appearance) {
            return fault("field.appearance: must be from 1 to 256");
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
        if self.data.downscale == 0
            || self.sampling.batch_samples < 64
            || self.sampling.max_samples == 0
            || self.sampling.occupancy_every == 0
        {
            return fault("data.downscale, sampling.max_samples and occupancy_every must be at least 1, batch_samples at least 64");
        }
        let weights = [
            self.loss.robust,
            self.loss.shadow,
            self.loss.traced,
            self.loss.normal,
            self.loss.negative,
            self.loss.distortion,
            self.loss.depth,
            self.loss.gauge,
            self.loss.retinex,
            self.loss.near_scaling,
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
        for preset in [Preset::Ci, Preset::Fast, Preset::Paper] {
            Config::new(preset, "d".into()).check().unwrap();
        }
        let mut c = Config::template();
        for (key, value) in
            [("light.of", "sun"), ("field.width", "20"), ("loss.huber", "0"), ("sampling.batch_samples", "10"), ("field.space", "cube")]
        {
            let e = c.clone().set(key, value).unwrap_err();
            assert!(e.is_input() && e.to_string().contains(key.split('.').next().unwrap()), "{e}");
        }
        let mut printed = Config::new(Preset::Paper, "d".into());
        for (key, value) in [("light.model", "sun"), ("sampling.fine", "0"), ("field.kind", "tree"), ("loss.normal", "2")] {
            let e = printed.clone().set(key, value).unwrap_err();
            assert!(e.is_input() && e.to_string().contains("field.kind"), "{e}");
        }
        for key in GRID_KEYS {
            let value = match key {
                "field.space" => "box",
                "light.from" => "0.123",
                _ => "77",
            };
            let e = config::set(&mut printed.clone(), key, value).unwrap_err().to_string();
            assert!(e.starts_with(&format!("{key}: field.kind=mlp does not use it")), "{e}");
        }
        printed.set("field.background", "false").unwrap();
        assert!(c.set("loss.robst", "1").unwrap_err().to_string().contains("loss.robust"));
    }
}
