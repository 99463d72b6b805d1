//! Mesh of a trained scene: surface of the density, albedo as a texture, in a GLB that any renderer lights.

mod glass;
mod level;
pub mod surface;

use glass::GlassViews;
pub use level::Candidate;

use super::outdoor::model::SceneModel;
use super::outdoor::surface_field::SurfaceField;
use crate::error::{PipelineError, Result};
use crate::run::memory;
use diorama_data::DataError;
use diorama_data::gltf::{self, WriteOptions};
use diorama_engine::samplers::occupancy::MIN_STEP;
use diorama_geom::capture::Frame;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Mesh, Pose};
use diorama_mesh::extract::{Grid, Method};
use diorama_mesh::sparse_grid::{self, SparseGrid};
use diorama_mesh::{atlas, bake, simplify};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Most training cameras that visibility is tested with.
const CAMERAS: usize = 240;
/// Cameras and pixels along the longer side of the views that tell the extent of the scene; shares of the points left out on either side,
/// and the margin around the rest. Beyond a second share, the extent grows by no more than so much of what lies between.
const EXTENT: (usize, u32) = (48, 40);
const STRAYS: f64 = 0.01;
const OUTER: (f64, f64) = (0.05, 0.5);
const MARGIN: f64 = 0.1;
/// Fewest points that tell an extent.
const FEWEST: usize = 100;
/// Cells before and behind the surface whose albedo makes a texel, and the same in steps of marching at least.
const REACH: f32 = 3.0;
const REACH_STEPS: f32 = 4.0;
/// Bytes per texel while a texture is baked.
const TEXEL: u64 = 64;
/// Faces of a level of detail over those of the next.
const LOD_FACTOR: usize = 4;

/// Options of [`mesh`].
#[derive(Clone, Debug, PartialEq)]
pub struct MeshOptions {
    pub out: PathBuf,
    pub method: Method,
    /// Cells along the box's longest side.
    pub resolution: usize,
    /// Density at the surface in inverse world units; none: the best of five.
    pub level: Option<f32>,
    /// Whether vertices lie at the level between grid points, or halfway.
    pub interpolate: bool,
    /// Most faces; 0: no limit.
    pub target: usize,
    /// Edge of the texture in texels.
    pub bake: usize,
    /// Coarser copies, each with a quarter of the faces.
    pub lods: usize,
    /// Whether numbers are stored with 16 and 8 bits (KHR_mesh_quantization).
    pub quantize: bool,
}

/// Result of [`mesh`].
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Meshed {
    pub file: PathBuf,
    pub lods: Vec<PathBuf>,
    pub vertices: usize,
    pub faces: usize,
    /// Faces that masks mark as glass.
    pub glass: usize,
    /// Faces before cleaning and reduction.
    pub extracted: usize,
    pub removed: surface::Removed,
    pub level: f32,
    /// Candidates for the level; none where it was given.
    pub candidates: Vec<Candidate>,
    /// Share of the box that was sampled.
    pub sampled: f64,
    pub bytes: u64,
    pub seconds: f64,
    /// Deviations from the options, one line each.
    pub notes: Vec<String>,
}

/// Extracts, cleans, reduces and bakes the mesh of a run, and writes it; returns none when stopped, with nothing written. `progress` receives
/// the stage and (done, total).
///
/// # Errors
/// When options are invalid, memory does not suffice, nothing is as dense as the level or seen by the cameras, or a file cannot be written.
pub fn mesh(
    model: &SceneModel,
    o: &MeshOptions,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(&str, usize, usize),
) -> Result<Option<Meshed>> {
    let start = Instant::now();
    check(o)?;
    let is_stopped = || stop.load(Ordering::Relaxed);
    let field = SurfaceField::new(model);
    let frames: Vec<&Frame> = model.train.iter().map(|i| &model.capture.frames[*i]).collect();
    let grid = grid(&field, &frames, o)?;
    let blocks = sparse_grid::candidates(&grid, &|lo, hi| field.may_hold(lo, hi));
    check_memory(blocks.len(), o)?;
    let candidates = if o.level.is_none() { level::candidates(&field, &grid, &frames) } else { Vec::new() };
    let level = o.level.or(level::best(&candidates)).unwrap_or(1.0);
    if is_stopped() {
        return Ok(None);
    }
    let sampled = SparseGrid::sample(&field, &grid, &blocks, &mut |i, n| {
        progress("density", i, n);
        !is_stopped()
    });
    if is_stopped() {
        return Ok(None);
    }
    let mut mesh = sampled.surface(level, o.method, o.interpolate);
    drop(sampled);
    let extracted = mesh.faces.len();
    progress("cleaning", 0, 1);
    let removed = surface::clean(&mut mesh, &cameras(&frames), grid.cell());
    if mesh.faces.is_empty() {
        let why = if extracted == 0 { "nothing is as dense; give a lower --level" } else { "the training cameras see none of the surface" };
        return Err(DataError::input(&o.out, format!("the mesh is empty at the density {level:.3}: {why}, or train longer")).into());
    }
    let mut notes = Vec::new();
    if o.target > 0 && !is_stopped() {
        progress("reduction", 0, 1);
        notes.extend(surface::reduce(&mut mesh, o.target));
    }
    if is_stopped() {
        return Ok(None);
    }
    mesh.compute_normals();
    atlas::unwrap(&mut mesh, o.bake);
    bake_albedo(&field, &mut mesh, o.bake, grid.cell(), progress);
    if is_stopped() {
        return Ok(None);
    }
    to_capture(model, &mut mesh);
    let slack = surface::SLACK * grid.cell() / model.capture.world_from_capture.scale as f32;
    let mut views = GlassViews::read(model, &spread(&frames), slack)?;
    notes.extend(views.note.take());
    let (lods, glass) = write(&mesh, &views, o)?;
    Ok(Some(Meshed {
        file: o.out.clone(),
        lods,
        vertices: mesh.positions.len(),
        faces: mesh.faces.len(),
        glass,
        extracted,
        removed,
        level,
        candidates,
        sampled: blocks.len() as f64 / sparse_grid::candidates(&grid, &|_, _| true).len().max(1) as f64,
        bytes: std::fs::metadata(&o.out).map_or(0, |m| m.len()),
        seconds: start.elapsed().as_secs_f64(),
        notes,
    }))
}

fn check(o: &MeshOptions) -> Result<()> {
    let fault = |text: String| Err(PipelineError::Usage(text));
    if !(16..=2048).contains(&o.resolution) {
        return fault(format!("--resolution {}: must be 16 to 2048", o.resolution));
    }
    if !(64..=16_384).contains(&o.bake) {
        return fault(format!("--bake {}: must be 64 to 16384", o.bake));
    }
    if o.lods > 8 {
        return fault(format!("--lods {}: must be 0 to 8", o.lods));
    }
    if o.level.is_some_and(|l| !(l > 0.0 && l.is_finite())) {
        return fault("--level: must be above 0".into());
    }
    if o.out.extension().is_none_or(|e| !e.eq_ignore_ascii_case("glb")) {
        return fault(format!("--out {}: must end in .glb", o.out.display()));
    }
    Ok(())
}

/// Blocks of densities, and as much again for the surface; the texture while it is baked.
fn check_memory(blocks: usize, o: &MeshOptions) -> Result<()> {
    let cure = format!("use --resolution {}", (o.resolution / 2).max(16));
    memory::require("sampling the density", 2 * sparse_grid::bytes(blocks), &cure)?;
    memory::require("baking the texture", TEXEL * o.bake as u64 * o.bake as u64, &format!("use --bake {}", (o.bake / 2).max(64)))
}

/// The box of the scene: around the points of structure from motion, or else around the surfaces that the training cameras see.
fn grid(field: &SurfaceField, frames: &[&Frame], o: &MeshOptions) -> Result<Grid> {
    let mut points: Vec<DVec3> = field.model.capture.points.iter().map(|p| p.position).collect();
    if points.len() < FEWEST {
        let views = level::depth_views(field, frames, EXTENT.0, EXTENT.1);
        let of = |v: &level::DepthView| -> Vec<DVec3> {
            let solid = (0..v.depth.data.len()).filter(|i| v.opacity.data[*i] > 0.5);
            solid.map(|i| v.point(i, v.depth.data[i] as f64)).collect()
        };
        points = views.iter().flat_map(of).collect();
    }
    if points.len() < FEWEST {
        return Err(DataError::input(&o.out, "the training cameras see hardly any surface; train longer").into());
    }
    let side = |k: usize| {
        let mut v: Vec<f64> = points.iter().map(|p| p[k]).collect();
        v.sort_by(f64::total_cmp);
        let within = |share: f64| {
            let left_out = (v.len() as f64 * share) as usize;
            (v[left_out], v[v.len() - 1 - left_out])
        };
        let ((low, high), (inner_low, inner_high)) = (within(STRAYS), within(OUTER.0));
        let most = OUTER.1 * (inner_high - inner_low);
        (low.max(inner_low - most), high.min(inner_high + most))
    };
    let sides = [side(0), side(1), side(2)];
    let margin = MARGIN * sides.iter().map(|(a, b)| b - a).fold(1e-6, f64::max);
    let (min, max) = (sides.map(|s| (s.0 - margin) as f32), sides.map(|s| (s.1 + margin) as f32));
    Ok(Grid { min, max, resolution: o.resolution })
}

/// At most [`CAMERAS`] frames, spread over all.
fn spread<'a>(frames: &[&'a Frame]) -> Vec<&'a Frame> {
    let n = frames.len().min(CAMERAS);
    (0..n).map(|i| frames[i * frames.len() / n]).collect()
}

fn cameras(frames: &[&Frame]) -> Vec<(Camera, Pose)> {
    spread(frames).into_iter().map(|f| (f.camera, f.world_from_camera)).collect()
}

/// A texture of the albedo that short rays meet.
fn bake_albedo(field: &SurfaceField, mesh: &mut Mesh, size: usize, cell: f32, progress: &mut dyn FnMut(&str, usize, usize)) {
    let texels = bake::texels(mesh, size);
    let step = MIN_STEP / field.model.model_from_world.scale as f32;
    let reach = (REACH * cell).max(REACH_STEPS * step);
    let rgb = field.albedo(&texels.positions, &texels.normals, reach, &mut |i, n| progress("texture", i, n));
    mesh.texture = Some(bake::texture(&texels, &rgb, size));
}

/// Moves a mesh from the world to the coordinates of the capture, in which compositions have the run's cameras.
fn to_capture(model: &SceneModel, mesh: &mut Mesh) {
    let t = model.capture.world_from_capture.inverse();
    let wide = |p: [f32; 3]| DVec3::from(p.map(f64::from));
    mesh.positions.iter_mut().for_each(|p| *p = t.point(wide(*p)).as_vec3().to_array());
    mesh.normals.iter_mut().for_each(|n| *n = (t.rotation * wide(*n)).normalize_or(DVec3::Z).as_vec3().to_array());
}

/// `site.glb` → `site.lod1.glb`.
fn lod_path(out: &Path, lod: usize) -> PathBuf {
    out.with_extension(format!("lod{lod}.glb"))
}

/// Writes the mesh and its coarser copies, which share the texture coordinates; returns the files of the copies, and the mesh's faces of glass.
fn write(mesh: &Mesh, glass: &GlassViews, o: &MeshOptions) -> Result<(Vec<PathBuf>, usize)> {
    let options = WriteOptions { quantize: o.quantize };
    let name = o.out.file_stem().map_or("site".into(), |s| s.to_string_lossy().into_owned());
    let (mut coarser, mut files) = (mesh.clone(), Vec::new());
    for lod in 1..=o.lods {
        simplify::collapse(&mut coarser, mesh.faces.len() / LOD_FACTOR.pow(lod as u32));
        let file = lod_path(&o.out, lod);
        gltf::save(&file, &glass.model(&name, coarser.clone()).0, options)?;
        files.push(file);
    }
    let (model, panes) = glass.model(&name, mesh.clone());
    gltf::save(&o.out, &model, options)?;
    Ok((files, panes))
}
