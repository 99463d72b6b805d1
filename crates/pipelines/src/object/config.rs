//! Everything that a run depends on, as written to `config.toml`.

use crate::error::{PipelineError, Result};
pub use crate::run::config::Auto;
use crate::run::{self, config::Configuration};
use diorama_data::masks::{self, MaskOptions};
use diorama_geom::Reduction;
use diorama_kernels::device::Api;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// The four methods (object.md, section 4).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    Ngp,
    Nerf,
    Mlp,
    Baseline,
}

/// What stands behind the scene, in training and in renders.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Background {
    /// White for photographs with alpha; random for opaque ones, so that every ray must end on matter.
    Auto,
    White,
    Black,
    /// A new colour for every ray in training; black in renders of opaque captures, white of others.
    Random,
    /// Learned as a function of direction.
    Learned,
}

macro_rules! names {
    ($t:ty { $($v:ident = $n:literal),* }) => {
        impl std::str::FromStr for $t {
            type Err = String;
            fn from_str(s: &str) -> std::result::Result<Self, String> {
                match s { $($n => Ok(Self::$v),)* _ => Err(format!("{s:?}: expected one of {}", [$($n),*].join(", "))) }
            }
        }
        impl std::fmt::Display for $t {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(match self { $(Self::$v => $n),* })
            }
        }
    };
}
names!(Method { Ngp = "ngp", Nerf = "nerf", Mlp = "mlp", Baseline = "baseline" });
names!(Background { Auto = "auto", White = "white", Black = "black", Random = "random", Learned = "learned" });

/// Where the photographs are and how they are read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    pub path: PathBuf,
    /// `transforms`, `blender`, `colmap` or `llff`; empty: whichever is there.
    pub format: String,
    pub downscale: u32,
    /// Reduce the photographs until their shortest side has so many pixels; 0: `downscale` times.
    #[serde(default)]
    pub shortest_side: u32,
    pub split: String,
    /// What is done with masks: `use` (black is left out), `invert` or `ignore`.
    #[serde(default = "use_masks")]
    pub mask: String,
    /// What masks leave out: `object` (empty space), `unknown` (anything), or `auto`, told by what they cover.
    #[serde(default = "auto")]
    pub mask_meaning: String,
    /// Bytes that pixels may take; beyond that one of each small square is kept.
    pub memory_budget: u64,
    /// Of photographs of linear light: what is shown as white, and is 1 to the field; 0: what few of their pixels exceed.
    #[serde(default)]
    pub white: f32,
    /// Leave out photographs that cannot be decoded, instead of refusing the capture.
    #[serde(default)]
    pub skip_broken: bool,
}

/// Of runs from before there was a choice.
fn no_weight() -> Auto {
    Auto::Is(0.0)
}

fn from_points() -> String {
    "points".into()
}

fn use_masks() -> String {
    "use".into()
}

fn auto() -> String {
    "auto".into()
}

impl DataConfig {
    /// How masks are to be taken.
    pub fn masks(&self) -> Result<MaskOptions> {
        Ok(MaskOptions {
            usage: self.mask.parse().map_err(PipelineError::Usage)?,
            meaning: masks::parse_meaning(&self.mask_meaning).map_err(PipelineError::Usage)?,
        })
    }
}

/// Shape of the field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FieldConfig {
    pub levels: usize,
    pub features: usize,
    /// `log2` of the most rows per level; 0: by the number of training pixels.
    pub log2_size: u32,
    pub base: u32,
    /// Cells per axis at the finest level; 0: half as wide as a pixel where cameras look, 512 to 2048 per inner cube.
    pub finest: u32,
    /// Length of the per-image appearance code; 0: none; `auto`: 8 for `ngp` where exposure or light differ between photographs.
    pub appearance: Auto,
    /// `auto`: unbounded for opaque photographs, else the capture's box; `box`; `unbounded`.
    pub space: String,
    /// `auto`: networks multiply in bf16 where the CPU has tiles for it; `f32`.
    pub precision: String,
}

/// What the field is trained to do.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossConfig {
    /// `mse` or `huber`.
    pub color: String,
    /// Weight of the distortion loss; in unbounded space it is taken in `4 t / (1 + t)`. `auto`: 0.1 there,
    /// growing from nothing while coarse geometry is found, 0.01 in a box.
    pub distortion: Auto,
    pub alpha: f32,
    /// Weight of the light that ends away from what pixels of known distance show; `auto`: 0.3 in unbounded space, else none.
    #[serde(default = "no_weight")]
    pub depth: Auto,
    /// Where distances come from: `points` (those of the capture), `stereo` (photographs compared with their neighbours), or `auto`:
    /// points where photographs show any, else stereo.
    #[serde(default = "from_points")]
    pub depth_from: String,
    /// Distance, in inner cubes, within which samples learn more slowly the closer they are to the camera; 0: none.
    pub near_scaling: f32,
}

/// Rates and their course.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimConfig {
    pub rate: f32,
    /// Rate at the end over the rate at the start.
    pub final_scale: f32,
    pub warmup: f32,
    pub decay_from: f32,
    /// L2 penalty on the network's weights.
    pub weight_decay: f32,
    /// L2 penalty on those rows of the hash grid that a step reads; `auto`: 1e-5 in unbounded space, else none.
    #[serde(default)]
    pub table_decay: Auto,
}

/// Rays and samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamplingConfig {
    /// Rays per step; 0: as many as give `batch_samples` samples.
    pub rays: usize,
    /// Samples per step; 0: 2^15 on CPUs, 2^18 on GPUs.
    pub batch_samples: usize,
    /// Samples per ray of the methods without an occupancy grid.
    pub samples: usize,
    /// More samples per ray for the fine network of `nerf`.
    pub importance: usize,
    pub max_samples: usize,
    /// Samples behind which less than this share of light arrives are not trained on.
    pub stop: f32,
    /// Samples of less opacity than this are not trained on.
    pub min_alpha: f32,
    /// Nearest distance at which matter may be, in inner cubes; 0: 0.7 of the distance to the closest sparse points that cameras
    /// see; by stereo at most a fifth of the viewing distance; 0.1 where nothing is known.
    pub near: f32,
    pub occupancy_resolution: usize,
    /// Points of the occupancy grid sampled per update.
    pub occupancy_points: usize,
    pub occupancy_every: u64,
    /// Cameras that must see a cell for it to hold matter.
    pub min_cell_views: usize,
    /// Draw rays where the error is high.
    pub error_map: bool,
}

/// Correction of the given cameras.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    pub refine: bool,
    pub refine_focal: bool,
    pub rate: f32,
    /// Pull of the corrections towards zero.
    pub decay: f32,
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
    /// 0: by time alone.
    pub save_every_steps: u64,
    /// Judge held-out pixels each time so many steps are done; 0: every ten seconds, within 3 % of the time.
    pub evaluate_every: u64,
}

/// A whole configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    pub method: Method,
    pub background: Background,
    pub seed: u64,
    pub device: String,
    pub data: DataConfig,
    pub field: FieldConfig,
    pub loss: LossConfig,
    pub optim: OptimConfig,
    pub sampling: SamplingConfig,
    pub camera: CameraConfig,
    pub run: RunConfig,
}

impl Config {
    /// A method's defaults for the capture at `path`.
    pub fn new(method: Method, path: PathBuf) -> Config {
        let ngp = method == Method::Ngp;
        let (rate, rays, steps) = match method {
            Method::Ngp => (1.5e-2, 0, 6000),
            Method::Nerf => (5e-4, 512, 20_000),
            Method::Mlp => (1e-3, 128, 40_000),
            Method::Baseline => (1e-3, 256, 4000),
        };
        Config {
            method,
            background: Background::Auto,
            seed: 1,
            device: "auto".into(),
            data: DataConfig {
                path,
                format: String::new(),
                downscale: 1,
                shortest_side: 0,
                split: "file".into(),
                mask: use_masks(),
                mask_meaning: auto(),
                memory_budget: diorama_data::pixel_store::DEFAULT_BUDGET,
                white: 0.0,
                skip_broken: false,
            },
            field: FieldConfig {
                levels: 16,
                features: 2,
                log2_size: 0,
                base: 16,
                finest: 0,
                appearance: if ngp { Auto::Auto } else { Auto::Is(0.0) },
                space: "auto".into(),
                precision: "auto".into(),
            },
            loss: LossConfig {
                color: if ngp { "huber" } else { "mse" }.into(),
                distortion: if ngp { Auto::Auto } else { Auto::Is(0.0) },
                depth: if ngp { Auto::Auto } else { Auto::Is(0.0) },
                depth_from: "auto".into(),
                alpha: 0.0,
                near_scaling: if ngp { 1.0 } else { 0.0 },
            },
            optim: OptimConfig {
                rate,
                final_scale: if ngp { 0.03 } else { 0.1 },
                warmup: if ngp { 0.0 } else { 0.01 },
                decay_from: if ngp { 0.3 } else { 0.0 },
                weight_decay: 0.0,
                table_decay: Auto::Auto,
            },
            sampling: SamplingConfig {
                rays,
                batch_samples: 0,
                samples: 64,
                importance: 128,
                max_samples: 1024,
                stop: 1e-4,
                min_alpha: 3e-3,
                near: 0.0,
                occupancy_resolution: 128,
                occupancy_points: 1 << 16,
                occupancy_every: 16,
                min_cell_views: 2,
                error_map: false,
            },
            camera: CameraConfig { refine: false, refine_focal: false, rate: 3e-4, decay: 1e-2 },
            run: RunConfig { steps, seconds: 0.0, log_every: 10, save_every_seconds: 60.0, save_every_steps: 0, evaluate_every: 0 },
        }
    }

    /// How much smaller than the photographs the run's images are.
    pub fn reduction(&self) -> Reduction {
        match self.data.shortest_side {
            0 => Reduction::Times(self.data.downscale),
            side => Reduction::ShortestSide(side),
        }
    }

    /// Overrides one value ([`run::config::set`]).
    ///
    /// # Errors
    /// When the key does not exist (the nearest one is named) or the value has the wrong type.
    pub fn set(&mut self, key: &str, value: &str) -> Result<()> {
        run::config::set(self, key, value)
    }

    /// Reads what [`Config::to_toml`] wrote.
    ///
    /// # Errors
    /// When the text is no TOML, is of another application, or holds an unknown key or a wrong value.
    pub fn from_toml(text: &str) -> std::result::Result<Config, String> {
        run::config::from_toml(text)
    }

    /// The configuration as `config.toml` keeps it.
    pub fn to_toml(&self) -> String {
        run::config::to_toml(self)
    }

    /// All keys with their values as text, in order.
    pub fn values(&self) -> Vec<(String, String)> {
        run::config::values(self)
    }

    /// Values that make no sense together or alone.
    pub fn check(&self) -> Result<()> {
        let fail = |m: &str| Err(PipelineError::Usage(m.to_string()));
        let f = &self.field;
        let rows = f.log2_size == 0 || (4..=24).contains(&f.log2_size);
        if ![1, 2, 4, 8].contains(&f.features) || !(1..=64).contains(&f.levels) || f.base == 0 || !rows {
            return fail("field: features must be 1, 2, 4 or 8, levels 1 to 64, base at least 1, log2_size 0 or 4 to 24");
        }
        if !["auto", "box", "unbounded"].contains(&&f.space[..]) {
            return fail("field.space: expected auto, box or unbounded");
        }
        if !["auto", "f32"].contains(&&f.precision[..]) {
            return fail("field.precision: expected auto or f32");
        }
        if !["auto", "points", "stereo"].contains(&&self.loss.depth_from[..]) {
            return fail("loss.depth_from: expected auto, points or stereo");
        }
        if !["mse", "huber"].contains(&&self.loss.color[..]) {
            return fail("loss.color: expected mse or huber");
        }
        if !matches!(&self.device[..], "auto" | "cpu") {
            self.device.parse::<Api>().map_err(PipelineError::Usage)?;
        }
        let s = &self.sampling;
        if s.samples < 2 || s.max_samples == 0 || (1..64).contains(&s.batch_samples) || s.occupancy_every == 0 {
            return fail("sampling: samples at least 2, max_samples and occupancy_every at least 1, batch_samples 0 or at least 64");
        }
        if s.occupancy_resolution == 0 || !s.occupancy_resolution.is_multiple_of(16) {
            return fail("sampling.occupancy_resolution: must be a multiple of 16");
        }
        if s.near < 0.0 {
            return fail("sampling.near: 0 or more");
        }
        if !(0.0..=1e9).contains(&self.data.white) {
            return fail("data.white: 0, or light above 0");
        }
        if self.data.downscale == 0 {
            return fail("data.downscale (--downscale): at least 1, which leaves photographs as they are");
        }
        if self.run.log_every == 0 {
            return fail("run.log_every: at least 1");
        }
        self.data.masks()?;
        if self.data.shortest_side > 0 && self.data.downscale > 1 {
            return fail("data.shortest_side and data.downscale: give one of them");
        }
        let code = self.field.appearance.or(0.0);
        if code.fract() != 0.0 || code > 256.0 {
            return fail("field.appearance: expected auto or a whole number up to 256");
        }
        if code > 0.0 && matches!(self.method, Method::Mlp | Method::Baseline) {
            return fail("field.appearance: only ngp and nerf have a view-dependent part that takes an appearance code");
        }
        if self.run.steps == 0 && self.run.seconds <= 0.0 {
            return fail("run.steps and run.seconds: one of them must be greater than 0");
        }
        Ok(())
    }
}

impl Configuration for Config {
    const APPLICATION: &'static str = "object";

    fn template() -> Config {
        Config::new(Method::Ngp, "x".into())
    }

    fn data_set(&mut self) -> Option<&mut PathBuf> {
        Some(&mut self.data.path)
    }

    fn check(&self) -> Result<()> {
        Config::check(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_round_trips_and_takes_overrides() {
        let mut c = Config::new(Method::Nerf, "a b/ü".into());
        c.set("loss.distortion", "0.01").unwrap();
        c.set("method", "mlp").unwrap();
        c.set("camera.refine", "true").unwrap();
        assert_eq!(Config::from_toml(&c.to_toml()).unwrap(), c);
        assert!(c.camera.refine && c.method == Method::Mlp && c.loss.distortion == Auto::Is(0.01));
        for (value, want) in [("auto", Auto::Auto), ("2", Auto::Is(2.0)), ("0.5", Auto::Is(0.5))] {
            c.set("loss.distortion", value).unwrap();
            assert_eq!((c.loss.distortion, Config::from_toml(&c.to_toml()).unwrap().loss.distortion), (want, want));
        }
        assert!(
            c.set("loss.distortion", "-1").is_err() && c.set("loss.distortion", "much").is_err() && c.set("optim.rate", "auto").is_err()
        );
    }

    #[test]
    fn unknown_keys_name_the_nearest() {
        let mut c = Config::new(Method::Ngp, "x".into());
        assert!(c.set("loss.distorsion", "1").unwrap_err().to_string().contains("loss.distortion"));
        assert!(c.set("levles", "1").unwrap_err().to_string().contains("field.levels"));
        let text = c.to_toml().replace("log2_size", "log_size");
        assert!(Config::from_toml(&text).unwrap_err().contains("field.log2_size"));
    }

    #[test]
    fn values_that_make_no_sense_are_refused() {
        let c = Config::new(Method::Ngp, "x".into());
        for (k, v) in [
            ("field.features", "3"),
            ("loss.color", "l7"),
            ("loss.depth_from", "lidar"),
            ("optim.rate", "fast"),
            ("optim.rate", "inf"),
            ("data.downscale", "0"),
            ("data.mask", "maybe"),
            ("data.mask_meaning", "thing"),
            ("device", "gpu"),
        ] {
            assert!(c.clone().set(k, v).is_err(), "{k} = {v}");
        }
    }
}
