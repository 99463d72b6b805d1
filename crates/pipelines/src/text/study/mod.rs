//! Studies of the paper's two claims on generated scenes: [`sampling`] compares cameras that cover text poses evenly with random ones
//! (Cui et al. 2024, Table 2), [`pasting`] images of fields with words that are pasted onto photographs (after their Table 1).
//!
//! A study is a folder; each of its stages is kept there, and the same call goes on with what is missing.

mod folder;
mod pasted;
pub mod pasting;
mod real;
pub mod sampling;
pub mod table;
mod work;

use super::detectors::config::Kind;
use super::make_scenes::SceneOptions;
use crate::error::{PipelineError, Result};
use serde::Serialize;
use serde_json::Value;
use table::Trial;

/// Keys of options that may change while a study goes on: stages of the others stay right.
const FREE: [&str; 3] = ["models", "seeds", "real"];

/// When the training of a detector ends.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Limit {
    /// 0: no limit.
    pub steps: u64,
    /// 0: no limit.
    pub seconds: f64,
}

/// What both studies have.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Common {
    /// Scenes that detectors are trained on, and images of each.
    pub scenes: usize,
    pub images: usize,
    /// Words that are written on each sign.
    pub words: usize,
    /// Of the images.
    pub size: (u32, u32),
    pub clusters: usize,
    /// Steps of each field.
    pub field_steps: u64,
    /// Of fields: `auto`, `cpu`, or a GPU.
    pub device: String,
    pub models: Vec<Kind>,
    /// Detectors of each kind on each set, which differ in their first weights and the order of their batches.
    pub seeds: u64,
    pub limit: Limit,
    pub seed: u64,
}

impl Common {
    /// # Errors
    /// With the option that cannot be, and what can.
    fn check(&self) -> Result<()> {
        let usage = |text: &str| Err(PipelineError::Usage(text.into()));
        for (name, value) in [("scenes", self.scenes), ("images", self.images), ("words", self.words), ("seeds", self.seeds as usize)] {
            if value == 0 {
                return Err(PipelineError::Usage(format!("--{name} 0: expected 1 or more")));
            }
        }
        if !(1..=256).contains(&self.clusters) {
            return usage("--clusters: expected a number from 1 to 256");
        }
        if self.models.is_empty() {
            return usage("--models: expected db, east, or both");
        }
        if self.field_steps == 0 {
            return usage("--field-steps 0: expected 1 or more");
        }
        match self.limit.steps > 0 || (self.limit.seconds.is_finite() && self.limit.seconds > 0.0) {
            true => Ok(()),
            false => usage("--seconds: expected a number above 0, or --steps"),
        }
    }

    /// The least of everything.
    #[cfg(test)]
    fn small(model: Kind, seeds: u64, limit: Limit) -> Common {
        Common {
            scenes: 2,
            images: 3,
            words: 2,
            size: (96, 72),
            clusters: 4,
            field_steps: 10,
            device: "cpu".into(),
            models: vec![model],
            seeds,
            limit,
            seed: 0,
        }
    }

    /// Photographs of scenes as `make-scenes --size ci` takes them, of other families and another number.
    fn photographs(&self, families: Vec<String>, scenes: usize) -> Result<SceneOptions> {
        Ok(SceneOptions { families, scenes, seed: self.seed, ..SceneOptions::named("ci")? })
    }

    /// Side of the windows that detectors learn from: the least multiple of 32 that holds an image's shorter side, from 64 to 320.
    fn crop(&self) -> usize {
        (self.size.0.min(self.size.1) as usize).next_multiple_of(32).clamp(64, 320)
    }

    /// In words: "for 120 s".
    fn length(&self) -> String {
        match (self.limit.steps, self.limit.seconds) {
            (0, seconds) => format!("for {seconds} s"),
            (steps, seconds) if seconds > 0.0 => format!("for {steps} steps or {seconds} s"),
            (steps, _) => format!("for {steps} steps"),
        }
    }
}

/// A study that is done.
#[derive(Clone, Debug, Serialize)]
pub struct Studied {
    pub study: &'static str,
    pub options: Value,
    /// Scenes that detectors were trained on, with figures of their fields.
    pub scenes: Vec<work::SceneStage>,
    /// Scenes that the others were tested on, where these have fields.
    pub test_scenes: Vec<work::SceneStage>,
    pub sets: Vec<work::SetStage>,
    pub trials: Vec<Trial>,
    /// The table as Markdown, with what it is of.
    pub text: String,
    pub notes: Vec<String>,
}
