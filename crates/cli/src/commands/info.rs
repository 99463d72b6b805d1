//! `diorama info`

use super::{Outcome, Verb};
use clap::Args;
use diorama_data::import::{self, ImportOptions};
use diorama_geom::capture::{Split, focus_point};
use diorama_pipelines::run::description;
use diorama_pipelines::{Application, PipelineError, Result};
use std::path::PathBuf;

/// Describe a capture or a run
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:\n  diorama info data/chair\n  diorama info runs/chair --json")]
pub struct Info {
    /// Folder of a capture or of a run
    path: PathBuf,
    /// Format of the capture, if its folder contains several
    #[arg(long)]
    format: Option<String>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Info {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        let is_run = self.path.join(description::NAME).exists();
        let object = if is_run { Application::of_run(&self.path)?.describe(&self.path)? } else { self.capture()? };
        if self.json {
            println!("{object}");
        } else if let Some(map) = object.as_object() {
            for (k, v) in map {
                println!("{:<18} {}", k.replace('_', " "), shown(v));
            }
        }
        Ok(Outcome::Done)
    }
}

impl Info {
    /// Description of a capture.
    fn capture(&self) -> Result<serde_json::Value> {
        let format = self.format.as_deref().map(str::parse).transpose().map_err(PipelineError::Usage)?;
        let c = import::import(&self.path, &ImportOptions { format, min_views: 1, allow_broken: true, ..ImportOptions::default() })?;
        let poses: Vec<_> = c.frames.iter().map(|f| f.world_from_camera).collect();
        let (focus, distance) = focus_point(&poses);
        let first = &c.frames[0].camera;
        Ok(serde_json::json!({
            "kind": "capture",
            "views": c.frames.len(),
            "train": c.indices(Split::Train).len(),
            "val": c.indices(Split::Val).len(),
            "test": c.indices(Split::Test).len(),
            "size": format!("{}x{}", first.width, first.height),
            "focal_length_px": [first.fx, first.fy],
            "lens": first.lens,
            "masks": c.frames.iter().filter(|f| f.mask.is_some()).count(),
            "points": c.points.len(),
            "focus": focus.to_array(),
            "camera_distance": distance,
            "scene_center": c.scene.center.to_array(),
            "scene_half": c.scene.half,
            "aabb_scale": c.scene.aabb_scale,
            "notes": c.notes,
        }))
    }
}

/// Formats a value for people: four digits, lists without brackets.
fn shown(v: &serde_json::Value) -> String {
    use serde_json::Value;
    match v {
        Value::Null => "-".into(),
        Value::String(s) => s.clone(),
        Value::Number(n) => {
            let Some(n) = n.as_f64().filter(|_| n.is_f64()) else { return n.to_string() };
            if n != 0.0 && n.abs() < 1e-4 {
                return format!("{n:.3e}");
            }
            let digits = (3 - n.abs().max(1e-9).log10().floor() as i32).clamp(0, 6) as usize;
            let text = format!("{n:.digits$}");
            if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').into() } else { text }
        }
        Value::Array(all) if all.is_empty() => "none".into(),
        Value::Array(all) => {
            let apart = if all.iter().any(Value::is_string) { format!("\n{:<19}", "") } else { ", ".into() };
            all.iter().map(shown).collect::<Vec<_>>().join(&apart)
        }
        Value::Object(map) => {
            let part = |(k, v): (&String, &Value)| if v.is_array() { format!("{k} [{}]", shown(v)) } else { format!("{k} {}", shown(v)) };
            map.iter().map(part).collect::<Vec<_>>().join(", ")
        }
        other => other.to_string(),
    }
}
