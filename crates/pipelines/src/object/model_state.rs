//! A model's state in checkpoints.

use super::model::ObjectModel;
use crate::error::{PipelineError, Result};
use diorama_data::checkpoint::{Checkpoint, Entry};
use diorama_engine::train::Origin;
use std::collections::HashMap;

impl ObjectModel {
    /// Everything that a checkpoint holds.
    pub fn entries(&self) -> (Vec<Entry<'_>>, HashMap<String, String>) {
        let mut entries = Vec::new();
        let mut add = |name: String, data| entries.push(Entry { name, shape: vec![<[f32]>::len(data)], data });
        for (name, g) in self.groups() {
            add(name.clone(), &g.values);
            add(format!("{name}.moment1"), &g.moment1);
            add(format!("{name}.moment2"), &g.moment2);
        }
        if let Some(o) = &self.occupancy {
            add("occupancy".into(), &o.density);
            add("occupancy.fresh".into(), &o.fresh);
        }
        if let Some(m) = &self.error_map {
            add("error_map".into(), &m.errors);
            add("error_map.drawn".into(), &m.drawn);
        }
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
        let mut load = |name: &str, into: &mut Vec<f32>| -> Result<()> {
            let v = c.take(name).ok_or_else(|| wrong(format!("{name} is missing")))?;
            if v.len() != into.len() {
                return Err(wrong(format!(
                    "{name} has {} numbers where the configuration needs {}; use the configuration that it was trained with",
                    v.len(),
                    into.len()
                )));
            }
            *into = v;
            Ok(())
        };
        for (name, g) in self.groups_mut() {
            load(&name, &mut g.values)?;
            load(&format!("{name}.moment1"), &mut g.moment1)?;
            load(&format!("{name}.moment2"), &mut g.moment2)?;
            g.grads.fill(0.0);
            g.touched.fill(0);
        }
        if let Some(o) = &mut self.occupancy {
            load("occupancy", &mut o.density)?;
            load("occupancy.fresh", &mut o.fresh)?;
            o.refresh();
        }
        if let Some(m) = &mut self.error_map {
            load("error_map", &mut m.errors)?;
            load("error_map.drawn", &mut m.drawn)?;
            m.rebuild();
        }
        Ok(())
    }
}
