//! A model's state in checkpoints.

use super::model::ObjectModel;
use crate::error::{PipelineError, Result};
use crate::run::param_state::{self, entry};
use diorama_data::checkpoint::{Checkpoint, Entry};
use diorama_engine::train::Origin;
use std::collections::HashMap;

impl ObjectModel {
    /// Everything that a checkpoint holds.
    pub fn entries(&mut self) -> (Vec<Entry<'_>>, HashMap<String, String>) {
        let o = &self.origin;
        let metadata = HashMap::from([
            ("method".to_string(), self.config.method.to_string()),
            ("step".into(), o.step.to_string()),
            ("rays".into(), self.rays.to_string()),
            ("samples".into(), self.samples.to_string()),
            ("seconds_bits".into(), o.seconds.to_bits().to_string()),
            ("samples_per_ray_bits".into(), self.samples_per_ray.to_bits().to_string()),
            ("rate_scale_bits".into(), self.rate_scale.to_bits().to_string()),
            ("has_alpha".into(), self.has_alpha.to_string()),
        ]);
        let (params, occupancy, error_map) = self.trainees().into_params();
        let mut entries = param_state::entries(params);
        if let Some(o) = occupancy {
            entries.extend([entry("occupancy", &o.grid.density), entry("occupancy.fresh", &o.grid.fresh)]);
        }
        if let Some(m) = error_map {
            entries.extend([entry("error_map", &m.errors), entry("error_map.drawn", &m.drawn)]);
        }
        (entries, metadata)
    }

    /// Takes over a checkpoint of the same method and shape.
    pub fn restore(&mut self, mut c: Checkpoint, file: &std::path::Path) -> Result<()> {
        let wrong = |what: String| PipelineError::Usage(format!("{}: {what}", file.display()));
        let method = c.metadata.get("method").cloned().unwrap_or_default();
        if method != self.config.method.to_string() {
            return Err(wrong(format!("holds method {method}, but the run is {}; use another run folder", self.config.method)));
        }
        fn number<T: std::str::FromStr>(c: &Checkpoint, key: &str) -> Option<T> {
            c.metadata.get(key).and_then(|v| v.parse().ok())
        }
        let missing = |k: &str| wrong(format!("metadata {k} is missing or malformed"));
        self.origin = Origin {
            step: number(&c, "step").ok_or_else(|| missing("step"))?,
            seconds: f64::from_bits(number(&c, "seconds_bits").ok_or_else(|| missing("seconds_bits"))?),
        };
        self.rays = number(&c, "rays").ok_or_else(|| missing("rays"))?;
        self.samples = number(&c, "samples").ok_or_else(|| missing("samples"))?;
        self.samples_per_ray = f64::from_bits(number(&c, "samples_per_ray_bits").ok_or_else(|| missing("samples_per_ray_bits"))?);
        self.rate_scale = f32::from_bits(number(&c, "rate_scale_bits").ok_or_else(|| missing("rate_scale_bits"))?);
        self.has_alpha = number(&c, "has_alpha").ok_or_else(|| missing("has_alpha"))?;
        let (mut params, occupancy, error_map) = self.trainees().into_params();
        param_state::restore(&mut params, &mut c, file)?;
        if let Some(o) = occupancy {
            param_state::take(&mut o.grid.density, "occupancy", &mut c, file)?;
            param_state::take(&mut o.grid.fresh, "occupancy.fresh", &mut c, file)?;
            o.grid.refresh();
        }
        if let Some(m) = error_map {
            param_state::take(&mut m.errors, "error_map", &mut c, file)?;
            param_state::take(&mut m.drawn, "error_map.drawn", &mut c, file)?;
            m.rebuild();
        }
        Ok(())
    }
}
