//! `diorama export`

use super::clip::clip_or_crop;
use super::process::{note, usage, use_threads};
use super::relight::from_run::Source;
use super::relight::object::Object;
use super::{Outcome, Verb};
use clap::Args;
use diorama_data::{DataError, mesh_text};
use diorama_pipelines::object::cut_out::RESOLUTION;
use diorama_pipelines::object::export::{self, ExportOptions, Exported, Size};
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::object::points::{self, PointFormat, PointOptions, Region};
use diorama_pipelines::object::viewing;
use diorama_pipelines::object::{device, run_folder};
use diorama_pipelines::run::RunDescription;
use diorama_pipelines::run::viewer_files::Crop;
use diorama_pipelines::{Application, PipelineError, Result};
use std::path::PathBuf;
use std::time::Instant;

/// Folder of the run that finds materials, in the run's folder.
const MATERIALS: &str = "materials";

/// Extract a mesh or a point cloud
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama export runs/chair -o chair.glb\n  diorama export --materials runs/chair -o chair.glb\n  diorama export runs/chair --scale-to 80cm -o chair.usdz\n  diorama export runs/chair --resolution 384 --faces 100000 --watertight --units mm -o chair.stl\n  diorama export runs/chair --format points --points 2000000 -o chair.ply\n  diorama export runs/chair -o chair.e57"
)]
pub struct Export {
    /// Folder of the run
    run: PathBuf,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    device: String,
    /// glb, obj, ply, stl, usdz or dae; points (a point cloud: ply, las or e57) [default: the extension of --out]
    #[arg(long)]
    format: Option<String>,
    /// Number of points of a point cloud [default: 1000000]
    #[arg(long, value_name = "N")]
    points: Option<usize>,
    /// The file to write
    #[arg(short, long)]
    out: PathBuf,
    /// mc: marching cubes; mt: marching tetrahedra, about twice the faces before simplification
    #[arg(long, default_value = "mc")]
    extract: String,
    /// Cells along the longest side
    #[arg(long, default_value_t = RESOLUTION)]
    resolution: usize,
    /// auto, or the density of the surface in inverse units of the input
    #[arg(long, default_value = "auto")]
    level: String,
    /// Largest number of faces; 0 keeps all [default: 60000 with a texture, 200000 without]
    #[arg(long)]
    faces: Option<usize>,
    /// Edge of the texture in texels; 0 colors the vertices instead [default: 2048 if the format has textures]
    #[arg(long)]
    texture: Option<usize>,
    /// Write base color, roughness and metalness, and the light as NAME.probe.hdr, as `diorama relight object --from-run` finds them; glb
    #[arg(long, conflicts_with_all = ["format", "points", "extract", "level", "normal_map", "watertight", "scale", "scale_to", "measured", "units", "floaters", "keep_unseen"])]
    materials: bool,
    /// Also bake the field's normals and make the material lit; glb and obj
    #[arg(long)]
    normal_map: bool,
    /// Close the mesh, as printing requires, or fail
    #[arg(long)]
    watertight: bool,
    /// Meters per unit of the capture [default: from the length measured in the viewer, else 1]
    #[arg(long, conflicts_with_all = ["scale_to", "measured"])]
    scale: Option<f64>,
    /// Scale the mesh so that its longest side has this length, for example 80cm, 0.8m, 800mm or 31.5in
    #[arg(long, value_name = "LENGTH", conflicts_with = "measured")]
    scale_to: Option<String>,
    /// Two points of the capture and their true distance: x0,y0,z0,x1,y1,z1=45cm
    #[arg(long, value_name = "POINTS=LENGTH", allow_hyphen_values = true)]
    measured: Option<String>,
    /// Unit of the coordinates in obj, ply, stl and las: m, cm, mm or in; the other formats are always in meters
    #[arg(long, default_value = "m")]
    units: String,
    /// Extract only x0,y0,z0,x1,y1,z1 (the input's frame), or auto, or all (points only) [default: the crop box saved in the viewer, else auto: what most cameras look at]
    #[arg(long, allow_hyphen_values = true)]
    clip: Option<String>,
    /// Remove parts with fewer faces than this share of the largest part's
    #[arg(long, default_value_t = 0.01)]
    floaters: f32,
    /// Keep parts that fewer than three training cameras see, and parts close in front of a camera
    #[arg(long)]
    keep_unseen: bool,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Replace an existing file
    #[arg(long)]
    force: bool,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Export {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        match Application::of_run(&self.run)? {
            Application::Object if self.materials => self.materials(),
            Application::Object => self.object(),
            of @ Application::Relight => Err(of.refuse(&self.run, "diorama relight render")),
            of @ Application::RelightObject => Err(of.refuse(&self.run, "diorama relight object --resume, which writes the GLB again")),
            of @ Application::Text => Err(of.refuse(&self.run, "a run of object: a text run exports no mesh")),
            of @ Application::Detector => Err(of.refuse(&self.run, "a run of object, or diorama text eval-detector --onnx")),
        }
    }
}

impl Export {
    /// Exports a run of the object application.
    fn object(&self) -> Result<Outcome> {
        let format = Format::of(self)?;
        self.check_out()?;
        let size = size(self)?;
        let unit_m = unit(&self.units).ok_or_else(|| usage(format!("units {}: expected m, cm, mm or in", self.units)))?;
        let (mut model, notes) = run_folder::load_model(&self.run)?;
        notes.iter().for_each(|n| note(n));
        let level = self.level(&model)?;
        let everything = self.clip.as_deref() == Some("all");
        let clip = if everything { None } else { clip_or_crop(self.clip.as_deref(), "auto", &self.run, &model)? };
        device::accelerate(&mut model, &self.device, Box::new(note))?;
        match format {
            Format::Mesh(format) => self.mesh(&model, &ExportOptions { level, clip, size, unit_m, ..self.mesh_options(format)? }),
            Format::Points(format) => {
                let region = region(clip, everything);
                let points = self.points.unwrap_or(points::POINTS);
                export_points(self, &model, &PointOptions { format, out: self.out.clone(), points, region, size, unit_m })
            }
        }
    }

    /// Trains the object model from the run, in a run of its own inside of the run's folder.
    fn materials(&self) -> Result<Outcome> {
        if self.out.extension().is_none_or(|e| !e.eq_ignore_ascii_case("glb")) {
            return Err(usage(format!("materials: {} is no .glb, which alone holds them; choose another --out", self.out.display())));
        }
        self.check_out()?;
        let run = self.run.join(MATERIALS);
        if RunDescription::read(&run).is_ok() && !self.force {
            let text = format!(
                "holds an earlier export with materials; go on with diorama relight object --resume --run {} -o {}, or give --force to replace it",
                run.display(),
                self.out.display()
            );
            return Err(DataError::input(run, text).into());
        }
        let resolution = (self.resolution != RESOLUTION).then_some(self.resolution);
        let source = Source { run: &self.run, clip: self.clip.as_deref(), resolution, faces: self.faces, device: &self.device };
        let mut object = Object::of_run(&source, run, self.out.clone());
        (object.texture, object.force, object.json) = (self.texture, self.force, self.json);
        object.run()
    }

    /// # Errors
    /// If the file already exists, or its folder does not.
    fn check_out(&self) -> Result<()> {
        let written = [self.out.clone()].into_iter().chain(mesh_text::companions(&self.out));
        if let Some(file) = written.filter(|_| !self.force).find(|f| f.exists()) {
            return Err(DataError::input(file, "exists; give --force to replace it or another --out").into());
        }
        if let Some(parent) = self.out.parent().filter(|p| !p.as_os_str().is_empty() && !p.is_dir()) {
            return Err(DataError::input(parent, "is not a folder; create it or choose another --out").into());
        }
        Ok(())
    }

    /// `--level` in inverse units of the world; `None`: chosen from the field.
    fn level(&self, model: &ObjectModel) -> Result<Option<f32>> {
        if self.level == "auto" {
            return Ok(None);
        }
        let given = self.level.parse::<f32>().ok().filter(|v| v.is_finite() && *v > 0.0);
        let given = given.ok_or_else(|| usage(format!("level {}: expected auto or a number above 0", self.level)))?;
        // Densities per unit of the input are converted to densities per unit of the world.
        Ok(Some(given / model.capture.world_from_capture.scale as f32))
    }

    /// The mesh options that do not depend on the model.
    fn mesh_options(&self, format: export::Format) -> Result<ExportOptions> {
        Ok(ExportOptions {
            format,
            out: self.out.clone(),
            method: self.extract.parse().map_err(usage)?,
            resolution: self.resolution,
            level: None,
            faces: self.faces,
            texture: self.texture,
            normal_map: self.normal_map,
            watertight: self.watertight,
            size: Size::Unknown,
            unit_m: 1.0,
            clip: None,
            floaters: self.floaters,
            keep_unseen: self.keep_unseen,
        })
    }

    fn mesh(&self, model: &ObjectModel, options: &ExportOptions) -> Result<Outcome> {
        let made = export::export(model, options, &mut note, &mut progress())?;
        if self.json {
            println!("{}", serde_json::to_string(&made).expect("plain values"));
        } else {
            print_mesh(&made, options.size);
        }
        Ok(Outcome::Done)
    }
}

fn print_mesh(made: &Exported, size: Size) {
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
        "removed: {} faces of small parts, {} of parts that fewer than three cameras see, {} of parts close in front of a camera{}",
        r.small,
        r.unseen,
        r.before_cameras,
        if r.unseen + r.before_cameras > 0 { " (--keep-unseen keeps the latter two)" } else { "" }
    );
    made.notes.iter().for_each(|n| println!("note: {n}"));
}

/// Options for extracting points.
fn region(clip: Option<Crop>, everything: bool) -> Region {
    match clip {
        Some((lo, hi)) => Region::Box(lo, hi),
        None if everything => Region::Everything,
        None => Region::Auto,
    }
}

/// Output format.
#[derive(Clone, Copy)]
enum Format {
    Mesh(export::Format),
    Points(PointFormat),
}

impl Format {
    /// From `--format`, else from the file's extension; options that do not apply to the format are refused.
    fn of(a: &Export) -> Result<Format> {
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
                Err(PipelineError::Usage("--points: only for point clouds; add --format points, or write a .las or .e57 file".into()))
            }
            Format::Points(_) if a.texture.is_some() || a.faces.is_some() || a.normal_map || a.watertight => Err(PipelineError::Usage(
                "--faces, --texture, --normal-map and --watertight: only for meshes; leave them out for points".into(),
            )),
            _ => Ok(format),
        }
    }
}

fn export_points(a: &Export, model: &ObjectModel, options: &PointOptions) -> Result<Outcome> {
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

/// Lengths of the sides, with their unit.
fn extent([x, y, z]: [f32; 3], size: Size) -> String {
    let unit = match size {
        Size::Unknown => " units of the capture, taken as meters (give the true size with --measured or --scale-to)",
        _ => " m",
    };
    format!("{x:.3} x {y:.3} x {z:.3}{unit}")
}

/// Prints the progress of a stage every few seconds.
fn progress() -> impl FnMut(&str, usize, usize) {
    let mut last = Instant::now();
    move |stage, i, n| {
        if last.elapsed().as_secs() >= 5 {
            last = Instant::now();
            eprintln!("{stage}: {} %", i * 100 / n.max(1));
        }
    }
}

/// Meters per unit, by the unit's name.
fn unit(name: &str) -> Option<f64> {
    match name {
        "m" => Some(1.0),
        "cm" => Some(1e-2),
        "mm" => Some(1e-3),
        "in" => Some(0.0254),
        _ => None,
    }
}

/// Parses a length with a unit, such as 80cm, to meters.
fn length(text: &str) -> Option<f64> {
    let text = text.trim();
    let split = text.find(|c: char| c.is_ascii_alphabetic() && c != 'e' && c != 'E')?;
    let value: f64 = text[..split].trim().parse().ok()?;
    Some(value * unit(&text[split..])?).filter(|v| v.is_finite() && *v > 0.0)
}

fn size(a: &Export) -> Result<Size> {
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
        return read().ok_or_else(|| usage("--measured", text, "x0,y0,z0,x1,y1,z1=45cm with two different points"));
    }
    let Some(scale) = a.scale else {
        let measured = viewing::read_scale(&a.run)?;
        if let Some(Size::Measured { metres, .. }) = measured {
            let file = a.run.join("scale.json");
            eprintln!("note: scaled by the length of {metres} m measured in the viewer ({}); --scale 1 ignores it", file.display());
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
