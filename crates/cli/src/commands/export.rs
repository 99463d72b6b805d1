//! `diorama export`

use super::{Outcome, parse_clip, use_threads};
use crate::arguments::ExportArgs;
use diorama_data::DataError;
use diorama_pipelines::object::export::{self, ExportOptions};
use diorama_pipelines::object::run_folder;
use diorama_pipelines::{PipelineError, Result};
use std::time::Instant;

pub fn run(a: &ExportArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let extension = a.out.extension().map(|e| e.to_string_lossy().into_owned());
    let named = a.format.clone().or(extension).ok_or_else(|| PipelineError::Usage("--format: expected glb, obj, ply or stl".into()))?;
    let format = named.parse().map_err(|e| PipelineError::Usage(format!("--{e}")))?;
    if a.out.exists() && !a.force {
        return Err(DataError::input(&a.out, "exists; give --force to replace it or another --out").into());
    }
    if let Some(parent) = a.out.parent().filter(|p| !p.as_os_str().is_empty() && !p.is_dir()) {
        return Err(DataError::input(parent, "is not a folder; create it or choose another --out").into());
    }
    let (model, notes) = run_folder::load_model(&a.run)?;
    notes.iter().for_each(|n| eprintln!("note: {n}"));
    let scale = model.capture.world_from_capture.scale as f32;
    let level = match &a.level[..] {
        "auto" => None,
        // Densities per unit of the input become densities per unit of the world.
        n => Some(
            n.parse::<f32>()
                .ok()
                .filter(|v| v.is_finite() && *v > 0.0)
                .map(|v| v / scale)
                .ok_or_else(|| PipelineError::Usage(format!("--level {n}: expected auto or a number above 0")))?,
        ),
    };
    let clip = a.clip.as_deref().map(|c| parse_clip(c, &model.capture.world_from_capture)).transpose()?;
    let options = ExportOptions { format, out: a.out.clone(), resolution: a.resolution, level, faces: a.faces, clip, floaters: a.floaters };
    let mut last = Instant::now();
    let made = export::export(&model, &options, &mut |i, n| {
        if last.elapsed().as_secs() >= 5 {
            last = Instant::now();
            eprintln!("density: slice {i} of {n}");
        }
    })?;
    if a.json {
        println!("{}", serde_json::to_string(&made).expect("plain values"));
    } else {
        println!(
            "{}: {} vertices, {} faces, {} KiB, {:.1} s, level {:.2}{}",
            made.file.display(),
            made.vertices,
            made.faces,
            made.bytes >> 10,
            made.seconds,
            made.level,
            if made.watertight { ", watertight" } else { "" }
        );
    }
    Ok(Outcome::Done)
}
