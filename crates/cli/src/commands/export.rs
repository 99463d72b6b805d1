//! `diorama export`

use super::{Outcome, clip_or_crop, note, use_threads};
use crate::arguments::ExportArgs;
use diorama_data::{DataError, mesh_text};
use diorama_pipelines::object::export::{self, ExportOptions, Size};
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::object::points::{self, PointFormat, PointOptions, Region};
use diorama_pipelines::object::{device, run_folder, viewing};
use diorama_pipelines::{PipelineError, Result};
use std::time::Instant;

pub fn run(a: &ExportArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let format = Format::of(a)?;
    let written = [a.out.clone()].into_iter().chain(mesh_text::companions(&a.out));
    if let Some(file) = written.filter(|_| !a.force).find(|f| f.exists()) {
        return Err(DataError::input(file, "exists; give --force to replace it or another --out").into());
    }
    if let Some(parent) = a.out.parent().filter(|p| !p.as_os_str().is_empty() && !p.is_dir()) {
        return Err(DataError::input(parent, "is not a folder; create it or choose another --out").into());
    }
    let (size, unit_m) =
        (size(a)?, unit(&a.units).ok_or_else(|| PipelineError::Usage(format!("--units {}: expected m, cm, mm or in", a.units)))?);
    let (mut model, notes) = run_folder::load_model(&a.run)?;
    notes.iter().for_each(|n| note(n));
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
    let everything = a.clip.as_deref() == Some("all");
    let clip = if everything { None } else { clip_or_crop(a.clip.as_deref(), "auto", &a.run, &model)? };
    device::accelerate(&mut model, &a.device, Box::new(note))?;
    let format = match format {
        Format::Mesh(f) => f,
        Format::Points(format) => {
            let region = match clip {
                Some((lo, hi)) => Region::Box(lo, hi),
                None if everything => Region::Everything,
                None => Region::Auto,
            };
            let points = a.points.unwrap_or(points::POINTS);
            return export_points(a, &model, &PointOptions { format, out: a.out.clone(), points, region, size, unit_m });
        }
    };
    let options = ExportOptions {
        format,
        out: a.out.clone(),
        method: a.extract.parse().map_err(|e| PipelineError::Usage(format!("--{e}")))?,
        resolution: a.resolution,
        level,
        faces: a.faces,
        texture: a.texture,
        normal_map: a.normal_map,
        watertight: a.watertight,
        size,
        unit_m,
        clip,
        floaters: a.floaters,
        keep_unseen: a.keep_unseen,
    };
    let made = export::export(&model, &options, &mut note, &mut progress())?;
    if a.json {
        println!("{}", serde_json::to_string(&made).expect("plain values"));
    } else {
        println!(
            "{}: {} vertices, {} faces, {}{} KiB, {}, {:.1} s, level {:.2}{}",
            made.file.display(),
            made.vertices,
            made.faces,
            if made.texture > 0 { format!("texture {0} x {0}, ", made.texture) } else { String::new() },
            made.bytes >> 10,
            extent(made.extent_m, size),
            made.seconds,
            made.level,
            if made.watertight { ", watertight" } else { "" }
        );
        let r = made.removed;
        println!(
            "removed: {} faces of small parts, {} of parts that fewer than three cameras see, {} of parts close before a camera{}",
            r.small,
            r.unseen,
            r.before_cameras,
            if r.unseen + r.before_cameras > 0 { " (--keep-unseen keeps the latter two)" } else { "" }
        );
        made.notes.iter().for_each(|n| println!("note: {n}"));
    }
    Ok(Outcome::Done)
}

/// What the file will hold.
#[derive(Clone, Copy)]
enum Format {
    Mesh(export::Format),
    Points(PointFormat),
}

impl Format {
    /// Of `--format`, else of the file's extension; flags that do not go with it are refused.
    fn of(a: &ExportArgs) -> Result<Format> {
        let usage = |e: String| PipelineError::Usage(format!("--{e}"));
        let extension = a.out.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        let named = a.format.as_deref().map(str::to_ascii_lowercase);
        let format = match (named.as_deref(), extension.as_deref()) {
            (Some("points"), e) => Format::Points(e.unwrap_or("ply").parse().map_err(usage)?),
            (Some("las" | "e57"), _) => Format::Points(named.unwrap_or_default().parse().map_err(usage)?),
            (None, Some(e @ ("las" | "e57"))) => Format::Points(e.parse().map_err(usage)?),
            (Some(n), _) | (None, Some(n)) => Format::Mesh(n.parse().map_err(usage)?),
            (None, None) => {
                return Err(PipelineError::Usage("--format: expected glb, obj, ply, stl, usdz, dae or points".into()));
            }
        };
        match format {
            Format::Mesh(_) if a.clip.as_deref() == Some("all") => {
                Err(PipelineError::Usage("--clip all: a mesh needs a box; give its corners, or --clip auto".into()))
            }
            Format::Mesh(_) if a.points.is_some() => {
                Err(PipelineError::Usage("--points: only a point cloud has them; add --format points, or name a .las or .e57 file".into()))
            }
            Format::Points(_) if a.texture.is_some() || a.faces.is_some() || a.normal_map || a.watertight => Err(PipelineError::Usage(
                "--faces, --texture, --normal-map and --watertight: only a mesh has them; leave them out for points".into(),
            )),
            _ => Ok(format),
        }
    }
}

fn export_points(a: &ExportArgs, model: &ObjectModel, options: &PointOptions) -> Result<Outcome> {
    let made = points::export(model, options, &mut progress())?;
    if a.json {
        println!("{}", serde_json::to_string(&made).expect("plain values"));
        return Ok(Outcome::Done);
    }
    println!(
        "{}: {} points, {} KiB, {}, {:.1} s",
        made.file.display(),
        made.points,
        made.bytes >> 10,
        extent(made.extent_m, options.size),
        made.seconds
    );
    if made.points < made.asked {
        println!("note: {} points instead of {}: the cameras see little surface there", made.points, made.asked);
    }
    Ok(Outcome::Done)
}

/// Lengths of the sides, and in what.
fn extent([x, y, z]: [f32; 3], size: Size) -> String {
    let unit = match size {
        Size::Unknown => " units of the capture, taken as meters (--measured or --scale-to says how large it is)",
        _ => " m",
    };
    format!("{x:.3} x {y:.3} x {z:.3}{unit}")
}

/// Says every few seconds how far a stage is.
fn progress() -> impl FnMut(&str, usize, usize) {
    let mut last = Instant::now();
    move |stage, i, n| {
        if last.elapsed().as_secs() >= 5 {
            last = Instant::now();
            eprintln!("{stage}: {} %", i * 100 / n.max(1));
        }
    }
}

/// Metres of a unit's name.
fn unit(name: &str) -> Option<f64> {
    match name {
        "m" => Some(1.0),
        "cm" => Some(1e-2),
        "mm" => Some(1e-3),
        "in" => Some(0.0254),
        _ => None,
    }
}

/// Metres of a number with a unit, such as 80cm.
fn length(text: &str) -> Option<f64> {
    let text = text.trim();
    let split = text.find(|c: char| c.is_ascii_alphabetic() && c != 'e' && c != 'E')?;
    let value: f64 = text[..split].trim().parse().ok()?;
    Some(value * unit(&text[split..])?).filter(|v| v.is_finite() && *v > 0.0)
}

fn size(a: &ExportArgs) -> Result<Size> {
    let usage = |flag: &str, text: &str, expected: &str| PipelineError::Usage(format!("{flag} {text}: expected {expected}"));
    if let Some(text) = &a.scale_to {
        return length(text).map(Size::Longest).ok_or_else(|| usage("--scale-to", text, "a length with its unit, such as 80cm"));
    }
    if let Some(text) = &a.measured {
        let read = || {
            let (points, distance) = text.split_once('=')?;
            let v: Vec<f64> = points.split(',').map(|v| v.trim().parse().ok().filter(|v: &f64| v.is_finite())).collect::<Option<_>>()?;
            let points: [[f64; 3]; 2] = [v.get(..3)?.try_into().ok()?, v.get(3..)?.try_into().ok()?];
            (points[0] != points[1]).then_some(Size::Measured { points, metres: length(distance)? })
        };
        return read().ok_or_else(|| usage("--measured", text, "x0,y0,z0,x1,y1,z1=45cm with two points that differ"));
    }
    let Some(scale) = a.scale else {
        let measured = viewing::read_scale(&a.run)?;
        if let Some(Size::Measured { metres, .. }) = measured {
            let file = a.run.join("scale.json");
            eprintln!(
                "note: scaled by the length of {metres} m that was measured in the viewer ({}); --scale 1 leaves it out",
                file.display()
            );
        }
        return Ok(measured.unwrap_or(Size::Unknown));
    };
    if !(scale > 0.0 && scale.is_finite()) {
        return Err(usage("--scale", &scale.to_string(), "a number above 0"));
    }
    Ok(Size::Scaled(scale))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_have_units() {
        for (text, metres) in [("80cm", 0.8), ("0.8 m", 0.8), ("800mm", 0.8), ("10in", 0.254), ("1e2cm", 1.0)] {
            assert!((length(text).unwrap() - metres).abs() < 1e-12, "{text}");
        }
        for text in ["80", "cm", "-1m", "1ft", "nan m", ""] {
            assert_eq!(length(text), None, "{text}");
        }
    }
}
