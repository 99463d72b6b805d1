//! Cuts the object of a run out of its photographs: the mesh of the trained field, and the photographs with opacity where the mesh covers
//! them, as a capture of its own. What needs masks begins from it.

mod view;

use super::export::{self, ExportOptions, Format, Size, Surface};
use super::model::ObjectModel;
use crate::error::{PipelineError, Result};
use crate::run::viewer_files::Crop;
use diorama_data::{DataError, glb, transforms_json};
use diorama_geom::capture::{MaskRule, Split};
use diorama_geom::field_query::FieldQuery;
use diorama_geom::glam::DVec3;
use diorama_geom::{Capture, Frame, Mesh};
use diorama_mesh::extract::Method;
use rayon::prelude::*;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use view::{Cutter, LeftOut, Shown};

/// File of the mesh.
pub const MESH: &str = "object.glb";
/// Cells along the longest side where nobody says: as `diorama export` has it.
pub const RESOLUTION: usize = 320;
/// Parts with fewer faces than this share of the largest part's are removed.
const FLOATERS: f32 = 0.01;
/// Fewest photographs to train on.
const FEWEST: usize = 3;
/// Mean opacity of the field behind the mesh below which the mesh is only fog.
const FOG: f64 = 0.4;
/// Share of the vertices that lie on a side of the box from which on the box has cut the surface.
const CUT: f64 = 0.002;

/// What is cut out.
#[derive(Clone, Debug)]
pub struct CutOptions {
    /// Box of the object in the world; none: what most cameras look at.
    pub clip: Option<Crop>,
    /// Cells along the box's longest side.
    pub resolution: usize,
    /// Most faces.
    pub faces: usize,
}

/// What was cut out.
#[derive(Clone, Debug)]
pub struct CutOut {
    pub faces: usize,
    /// Photographs, and how many of them are to be trained on.
    pub photographs: usize,
    pub training: usize,
    /// What the user should know, one line each.
    pub notes: Vec<String>,
}

/// Writes the mesh and the photographs of a run's object into the folder `out`, in the coordinates of the capture; none when it was
/// interrupted. `progress` receives the stage and (done, total). Opacity that the photographs have already is kept.
///
/// # Errors
/// When the box holds no opaque surface, too few photographs show the object, or a file cannot be read or written. What was written until
/// then stays in `out`.
pub fn write(
    model: &ObjectModel,
    out: &Path,
    o: &CutOptions,
    interrupt: &AtomicBool,
    progress: &mut dyn FnMut(&str, usize, usize),
) -> Result<Option<CutOut>> {
    let mut notes = Vec::new();
    let density = Stoppable { model, interrupt };
    let extracted = export::surface(model, &density, &export_options(o), &mut |n| notes.push(n.into()), progress);
    if interrupt.load(Ordering::Relaxed) {
        return Ok(None);
    }
    let Surface { mut mesh, grid, notes: deviations, .. } = extracted?;
    if mesh.faces.is_empty() {
        return Err(nothing("the field has no surface there"));
    }
    notes.extend(deviations);
    let images = out.join("images");
    std::fs::create_dir_all(&images).map_err(DataError::io(&images, "create"))?;
    let cutter = Cutter::new(model, &mesh, &images);
    let Some(shown) = cut_all(&cutter, interrupt, progress)? else { return Ok(None) };
    model.check_device()?;
    notes.extend(judge(model, &shown)?);
    notes.extend(cut_by_box(model, &mesh, (grid.min, grid.max)));
    let frames: Vec<Frame> = shown.into_iter().filter_map(|s| s.frame.ok()).collect();
    let made = CutOut {
        faces: mesh.faces.len(),
        photographs: frames.len(),
        training: frames.iter().filter(|f| f.split == Split::Train).count(),
        notes,
    };
    let capture = Capture { frames, masks: MaskRule::default(), points: Vec::new(), agreement: None, ..model.capture.clone() };
    transforms_json::write(&out.join("transforms.json"), out, &capture, None)?;
    mesh.compute_normals();
    export::to_capture(model, &mut mesh);
    glb::save(&out.join(MESH), &mesh)?;
    Ok(Some(made))
}

/// The field until the user interrupts; then nothing, so that the extraction ends.
struct Stoppable<'a> {
    model: &'a ObjectModel,
    interrupt: &'a AtomicBool,
}

impl FieldQuery for Stoppable<'_> {
    fn density(&self, points_in_world: &[[f32; 3]], sigma: &mut [f32]) {
        if self.interrupt.load(Ordering::Relaxed) {
            return sigma.fill(0.0);
        }
        self.model.density(points_in_world, sigma);
    }

    fn color(&self, points_in_world: &[[f32; 3]], directions: &[[f32; 3]], rgb_srgb: &mut [[f32; 3]]) {
        self.model.color(points_in_world, directions, rgb_srgb);
    }
}

/// The surface as `diorama export` extracts it.
fn export_options(o: &CutOptions) -> ExportOptions {
    ExportOptions {
        format: Format::Glb,
        out: MESH.into(),
        method: Method::default(),
        resolution: o.resolution,
        level: None,
        faces: Some(o.faces),
        texture: Some(0),
        normal_map: false,
        watertight: false,
        size: Size::Unknown,
        unit_m: 1.0,
        clip: o.clip,
        floaters: FLOATERS,
        keep_unseen: false,
    }
}

/// Cuts all photographs, a few at a time.
fn cut_all(cutter: &Cutter, interrupt: &AtomicBool, progress: &mut dyn FnMut(&str, usize, usize)) -> Result<Option<Vec<Shown>>> {
    let n = cutter.len();
    let mut shown = Vec::with_capacity(n);
    let at_once = rayon::current_num_threads();
    for first in (0..n).step_by(at_once) {
        if interrupt.load(Ordering::Relaxed) {
            return Ok(None);
        }
        progress("photographs", first, n);
        let part = first..(first + at_once).min(n);
        shown.extend(part.into_par_iter().map(|i| cutter.cut(i)).collect::<Result<Vec<_>>>()?);
    }
    Ok(Some(shown))
}

/// Notes about photographs that are left out.
///
/// # Errors
/// When the surface is fog, or too few photographs are left.
fn judge(model: &ObjectModel, shown: &[Shown]) -> Result<Option<String>> {
    let (opacity, covered) = shown.iter().fold((0.0, 0), |(a, n), s| (a + s.opacity, n + s.covered));
    if covered > 0 && opacity < FOG * covered as f64 {
        return Err(nothing(&format!("the field lets {:.0} % of the light through there", 100.0 * (1.0 - opacity / covered as f64))));
    }
    let count = |why: LeftOut| shown.iter().filter(|s| s.frame.as_ref().err() == Some(&why)).count();
    let reasons = [
        (count(LeftOut::Absent), "do not show the object"),
        (count(LeftOut::Filled), "are filled by it or were taken inside of it"),
        (count(LeftOut::Hidden), "show something in front of it"),
    ];
    let text: Vec<String> = reasons.iter().filter(|r| r.0 > 0).map(|(n, why)| format!("{n} {why}")).collect();
    let training = shown.iter().filter(|s| s.frame.as_ref().is_ok_and(|f| f.split == Split::Train)).count();
    if training < FEWEST {
        let of = model.train.len();
        if of < FEWEST {
            return Err(PipelineError::Usage(format!("the run has {of} training photographs, {FEWEST} are needed")));
        }
        return Err(PipelineError::Usage(format!(
            "only {training} of {of} training photographs show what is in the box ({} of all photographs), {FEWEST} are needed; \
             give another box with --clip x0,y0,z0,x1,y1,z1",
            text.join(", ")
        )));
    }
    Ok((!text.is_empty()).then(|| format!("of {} photographs {}: they are left out", shown.len(), text.join(", "))))
}

/// The error of a box without an object.
fn nothing(why: &str) -> PipelineError {
    PipelineError::Usage(format!("the box holds no opaque object: {why}; train longer, or give another box with --clip x0,y0,z0,x1,y1,z1"))
}

/// A note where the box ends on the surface: a floor or wall may belong to it.
fn cut_by_box(model: &ObjectModel, mesh: &Mesh, (lo, hi): Crop) -> Option<String> {
    let near = 1e-3 * (0..3).map(|k| hi[k] - lo[k]).fold(0.0, f32::max);
    let on = |k: usize, side: f32| mesh.positions.iter().filter(|p| (p[k] - side).abs() < near).count();
    let sides = (0..3).flat_map(|k| [on(k, lo[k]), on(k, hi[k])]).filter(|n| *n as f64 > CUT * mesh.positions.len() as f64).count();
    if sides == 0 {
        return None;
    }
    let to_capture = model.capture.world_from_capture.inverse();
    let corners = (0..8).map(|c| to_capture.point(DVec3::from_array(std::array::from_fn(|k| [lo[k], hi[k]][c >> k & 1] as f64))));
    let (low, high) = corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(a, b), p| (a.min(p), b.max(p)));
    let text: Vec<String> = low.to_array().iter().chain(&high.to_array()).map(|v| format!("{v:.3}")).collect();
    Some(format!(
        "the box --clip {} cuts the surface at {sides} of its sides: what the object stands on or leans against counts as the object; \
         a smaller box leaves it out",
        text.join(",")
    ))
}
