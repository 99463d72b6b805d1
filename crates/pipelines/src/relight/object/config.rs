//! Everything that a run of the object model depends on, as written to `config.toml`.

use crate::error::{PipelineError, Result};
use crate::run::config::{self, Auto, Configuration};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Samples per pixel and side of pictures to be looked at or scored: patterns have edges.
pub const SHOWN: usize = 4;
/// Numbers of a texel: base color; occlusion, roughness, metalness; normal in tangent space.
pub const CHANNELS: usize = 9;

/// Size of the model and length of its training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// Small: for tests.
    Ci,
    /// Two CPU cores, some minutes.
    Fast,
}

impl std::str::FromStr for Preset {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Preset, String> {
        match s {
            "ci" => Ok(Preset::Ci),
            "fast" => Ok(Preset::Fast),
            _ => Err(format!("{s:?}: expected ci or fast")),
        }
    }
}

/// Where the photographs are and how they are read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    pub path: PathBuf,
    pub downscale: u32,
    pub split: String,
}

/// The tetrahedral grid.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridConfig {
    /// Cubes of the lattice along an axis; a cube has 12 tetrahedra.
    pub cells: usize,
    /// Tetrahedra of an `.npz` file as nvdiffrec has them, in place of the lattice: `vertices` between −½ and ½, and `indices`.
    #[serde(default)]
    pub file: PathBuf,
    /// Half the edge of the box that holds the object, in units of the capture; auto: from the masks.
    pub scale: Auto,
    /// First surface: `carved`, what all masks allow without what photographs do not agree on; `hull`, with it; or `random`.
    pub start: String,
}

/// The material as a field in space.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaterialConfig {
    pub levels: usize,
    /// `log2` of the most rows per level.
    pub log2_size: u32,
    pub base: u32,
    /// Cells per axis at the finest level.
    pub finest: u32,
    /// Width of hidden layers.
    pub width: usize,
    /// Least and largest base color.
    pub color: [f32; 2],
    /// Edge of the textures in texels.
    pub texture: usize,
}

/// The light around the object.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LightConfig {
    /// Edge of the faces of its cube map: 32, 64, 128 or 256.
    pub cube: usize,
    /// File of a light that is given and not learned; empty: it is learned.
    pub fixed: PathBuf,
}

/// Weights of the loss.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossConfig {
    /// Opacity.
    pub mask: f32,
    /// Edges between inside and outside, at the start and after a quarter of the first stage.
    pub sign_change: [f32; 2],
    /// Differences of the base color between near points.
    pub color_smoothness: f32,
    /// Color of the light.
    pub white_light: f32,
    /// Entropy of base colors in the third stage.
    pub color_entropy: f32,
    /// Bending of the mesh in the second stage against its first shape; falls to 0.
    pub laplacian: f32,
    /// Angles between faces in the first stage; those of creases count little.
    pub normal_consistency: f32,
}

/// Rates.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimConfig {
    pub shape_rate: f32,
    pub material_rate: f32,
    /// Share of the first stage during which light alone is learned, besides the shape.
    pub material_from: f32,
    pub light_rate: f32,
    /// Textures in the second stage.
    pub texture_rate: f32,
    /// Light in the third stage.
    pub traced_light_rate: f32,
    /// Vertices in the second stage.
    pub vertex_rate: f32,
    /// Rate at the end of a stage over that at its start.
    pub final_scale: f32,
}

/// Length of the run and what it writes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Steps in which the shape may change its topology.
    pub topology_steps: u64,
    /// Steps on a fixed mesh with textures, after them.
    pub texture_steps: u64,
    /// Steps with traced shadows, after them; 0: none.
    pub traced_steps: u64,
    /// Photographs per step.
    pub batch: usize,
    /// Samples per pixel and axis in the second and third stage; runs from before there was a choice have one.
    #[serde(default = "one_sample")]
    pub samples: usize,
    pub log_every: u64,
    pub save_every_seconds: f64,
}

fn one_sample() -> usize {
    1
}

/// The whole configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    pub seed: u64,
    /// File of a mesh to begin with; empty: the shape is found in the first stage.
    pub base_mesh: PathBuf,
    pub data: DataConfig,
    pub grid: GridConfig,
    pub material: MaterialConfig,
    pub light: LightConfig,
    pub loss: LossConfig,
    pub optim: OptimConfig,
    pub run: RunConfig,
}

impl Config {
    /// The values of a preset.
    pub fn new(preset: Preset, path: PathBuf) -> Config {
        let ci = preset == Preset::Ci;
        let pick = |small: usize, large: usize| if ci { small } else { large };
        Config {
            seed: 0,
            base_mesh: PathBuf::new(),
            data: DataConfig { path, downscale: 1, split: "file".into() },
            grid: GridConfig { cells: pick(8, 26), file: PathBuf::new(), scale: Auto::Auto, start: "carved".into() },
            material: MaterialConfig {
                levels: pick(8, 16),
                log2_size: pick(14, 19) as u32,
                base: 16,
                finest: pick(256, 2048) as u32,
                width: 32,
                color: [0.0, 1.0],
                texture: pick(128, 512),
            },
            light: LightConfig { cube: pick(32, 64), fixed: PathBuf::new() },
            loss: LossConfig {
                mask: 1.0,
                sign_change: [0.2, 0.01],
                color_smoothness: 0.3,
                white_light: 0.005,
                color_entropy: 0.02,
                laplacian: 1e3,
                normal_consistency: 0.0,
            },
            optim: OptimConfig {
                shape_rate: 0.01,
                material_rate: 0.01,
                material_from: 0.0,
                light_rate: 0.1,
                texture_rate: 0.01,
                traced_light_rate: 0.01,
                vertex_rate: 0.003,
                final_scale: 0.1,
            },
            run: RunConfig {
                topology_steps: pick(200, 3000) as u64,
                texture_steps: pick(100, 3000) as u64,
                traced_steps: 0,
                batch: 1,
                samples: pick(1, 3),
                log_every: pick(20, 50) as u64,
                save_every_seconds: 60.0,
            },
        }
    }

    /// Overrides one value by its path.
    ///
    /// # Errors
    /// As [`config::set`].
    pub fn set(&mut self, key: &str, value: &str) -> Result<()> {
        config::set(self, key, value)
    }

    /// Steps of the first stage: none where a mesh is given.
    pub fn topology_steps(&self) -> u64 {
        if self.base_mesh.as_os_str().is_empty() { self.run.topology_steps } else { 0 }
    }

    /// Steps of all stages.
    pub fn steps(&self) -> u64 {
        self.topology_steps() + self.run.texture_steps + self.run.traced_steps
    }
}

impl Configuration for Config {
    const APPLICATION: &'static str = "relight-object";

    fn template() -> Config {
        Config::new(Preset::Fast, PathBuf::new())
    }

    fn data_set(&mut self) -> Option<&mut PathBuf> {
        Some(&mut self.data.path)
    }

    fn check(&self) -> Result<()> {
        let fault = |text: &str| Err(PipelineError::Usage(text.into()));
        if !(4..=128).contains(&self.grid.cells) {
            return fault("grid.cells: must lie between 4 and 128");
        }
        if !["hull", "carved", "random"].contains(&&self.grid.start[..]) {
            return fault("grid.start: expected hull, carved or random");
        }
        if matches!(self.grid.scale, Auto::Is(s) if s <= 0.0) {
            return fault("grid.scale: must be above 0, or auto");
        }
        let m = &self.material;
        if m.levels == 0 || m.base == 0 || m.finest < m.base || !(4..=24).contains(&m.log2_size) {
            return fault("material: levels and base must be at least 1, finest at least base, log2_size from 4 to 24");
        }
        if m.width == 0 || !m.width.is_multiple_of(16) || m.width > 256 {
            return fault("material.width: must be a multiple of 16 up to 256");
        }
        if !m.texture.is_power_of_two() || !(64..=8192).contains(&m.texture) {
            return fault("material.texture: must be a power of two from 64 to 8192");
        }
        if !(0.0 <= m.color[0] && m.color[0] < m.color[1] && m.color[1] <= 1.0) {
            return fault("material.color: two numbers from 0 to 1, the first the lower one");
        }
        if !self.light.cube.is_power_of_two() || !(32..=256).contains(&self.light.cube) {
            return fault("light.cube: must be 32, 64, 128 or 256");
        }
        let l = &self.loss;
        let weights = [
            l.mask,
            l.sign_change[0],
            l.sign_change[1],
            l.color_smoothness,
            l.white_light,
            l.color_entropy,
            l.laplacian,
            l.normal_consistency,
        ];
        if weights.iter().any(|w| !(*w >= 0.0 && w.is_finite())) {
            return fault("loss: weights must be 0 or more");
        }
        let o = &self.optim;
        let rates = [
            o.shape_rate,
            o.material_from,
            o.material_rate,
            o.light_rate,
            o.texture_rate,
            o.traced_light_rate,
            o.vertex_rate,
            o.final_scale,
        ];
        if rates.iter().any(|r| !(*r >= 0.0 && r.is_finite())) || o.final_scale == 0.0 {
            return fault("optim: rates must be 0 or more, final_scale above 0");
        }
        if self.data.downscale == 0 || self.run.batch == 0 || self.run.log_every == 0 || self.steps() == 0 {
            return fault("data.downscale, run.batch, run.log_every and the steps of both stages must be at least 1");
        }
        if !(1..=4).contains(&self.run.samples) {
            return fault("run.samples: must lie between 1 and 4");
        }
        if self.run.texture_steps == 0 {
            return fault("run.texture_steps: must be at least 1: the second stage makes the mesh with its textures");
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
        for (key, value) in [
            ("grid.cells", "2"),
            ("grid.start", "cube"),
            ("material.texture", "100"),
            ("light.cube", "48"),
            ("optim.final_scale", "0"),
            ("run.batch", "0"),
            ("run.samples", "5"),
            ("run.texture_steps", "0"),
        ] {
            let e = c.clone().set(key, value).unwrap_err();
            assert!(e.is_input() && e.to_string().contains(key.split('.').next().unwrap()), "{e}");
        }
        assert!(c.set("loss.maks", "1").unwrap_err().to_string().contains("loss.mask"));
    }
}
