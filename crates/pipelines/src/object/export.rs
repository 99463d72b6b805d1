//! From a trained field to a mesh file in the input's scale and frame.

use super::model::ObjectModel;
use crate::error::{PipelineError, Result};
use diorama_data::{glb, mesh_text};
use diorama_geom::Mesh;
use diorama_geom::field_query::FieldQuery;
use diorama_geom::glam::DVec3;
use diorama_mesh::extract::Grid;
use diorama_mesh::{clean, color, extract, simplify};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Mesh files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    Glb,
    Obj,
    Ply,
    Stl,
}

impl std::str::FromStr for Format {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Self, String> {
        match s.to_ascii_lowercase().as_str() {
            "glb" => Ok(Format::Glb),
            "obj" => Ok(Format::Obj),
            "ply" => Ok(Format::Ply),
            "stl" => Ok(Format::Stl),
            _ => Err(format!("format {s:?}: expected glb, obj, ply or stl")),
        }
    }
}

/// How to extract.
#[derive(Clone, Debug, PartialEq)]
pub struct ExportOptions {
    pub format: Format,
    pub out: PathBuf,
    /// Cells along the box's longest side.
    pub resolution: usize,
    /// Density of the surface in inverse world units; none: from the field.
    pub level: Option<f32>,
    /// Most faces; 0: as many as there are.
    pub faces: usize,
    /// Lowest and highest corner in the world; none: the scene's inner cube.
    pub clip: Option<([f32; 3], [f32; 3])>,
    /// Components with fewer faces than this share of the largest one's are removed.
    pub floaters: f32,
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Exported {
    pub file: PathBuf,
    pub vertices: usize,
    pub faces: usize,
    pub bytes: u64,
    pub seconds: f64,
    pub watertight: bool,
    pub level: f32,
}

/// Extracts, cleans, simplifies, colours and writes; `progress` is told (done, of) while densities are sampled.
pub fn export(model: &ObjectModel, o: &ExportOptions, progress: &mut dyn FnMut(usize, usize)) -> Result<Exported> {
    let start = Instant::now();
    if !(16..=2048).contains(&o.resolution) {
        return Err(PipelineError::Usage(format!("--resolution {}: must be 16 to 2048", o.resolution)));
    }
    let s = model.capture.scene;
    let (min, max) = o.clip.unwrap_or_else(|| {
        let corner = |sign: f64| (s.center + DVec3::splat(sign * s.half)).as_vec3().to_array();
        (corner(-1.0), corner(1.0))
    });
    if (0..3).any(|k| max[k] <= min[k] || max[k].is_nan() || min[k].is_nan()) {
        return Err(PipelineError::Usage("--clip: each highest coordinate must exceed the lowest".into()));
    }
    let grid = Grid { min, max, resolution: o.resolution };
    let level = o.level.unwrap_or_else(|| automatic_level(model, &grid));
    let mut mesh = extract::extract(model, &grid, level, progress);
    clean::remove_degenerate(&mut mesh);
    clean::remove_floaters(&mut mesh, o.floaters);
    if o.faces > 0 {
        simplify::simplify(&mut mesh, o.faces);
    }
    mesh.compute_normals();
    color::color_from_field(&mut mesh, model);
    let watertight = mesh.is_watertight();
    to_capture(model, &mut mesh);
    write(o.format, &o.out, &mesh)?;
    let bytes = std::fs::metadata(&o.out).map_or(0, |m| m.len());
    Ok(Exported {
        file: o.out.clone(),
        vertices: mesh.positions.len(),
        faces: mesh.faces.len(),
        bytes,
        seconds: start.elapsed().as_secs_f64(),
        watertight,
        level,
    })
}

/// A cell of matter lets half the light pass: `σ = ln 2 / cell` for a grid of 256 cells, but not more
/// than half of the 99th percentile of sampled densities.
fn automatic_level(model: &ObjectModel, grid: &Grid) -> f32 {
    let coarse = Grid { resolution: 48, ..*grid };
    let [nx, ny, nz] = coarse.points();
    let cell = coarse.cell();
    let points: Vec<[f32; 3]> = (0..nx * ny * nz)
        .map(|i| {
            let p = [i % nx, i / nx % ny, i / nx / ny];
            std::array::from_fn(|k| grid.min[k] + p[k] as f32 * cell)
        })
        .collect();
    let mut sigma = vec![0.0; points.len()];
    model.density(&points, &mut sigma);
    sigma.sort_by(f32::total_cmp);
    let high = sigma[(sigma.len() as f32 * 0.99) as usize];
    let half_cell = std::f32::consts::LN_2 / (Grid { resolution: 256, ..*grid }).cell();
    half_cell.min(0.5 * high).max(1e-6)
}

/// World coordinates to those of the input.
fn to_capture(model: &ObjectModel, mesh: &mut Mesh) {
    let t = model.capture.world_from_capture.inverse();
    let wide = |p: [f32; 3]| DVec3::new(p[0] as f64, p[1] as f64, p[2] as f64);
    mesh.positions.iter_mut().for_each(|p| *p = t.point(wide(*p)).as_vec3().to_array());
    mesh.normals.iter_mut().for_each(|n| *n = (t.rotation * wide(*n)).as_vec3().to_array());
}

fn write(format: Format, out: &Path, mesh: &Mesh) -> Result<()> {
    match format {
        Format::Glb => glb::save(out, mesh),
        Format::Obj => mesh_text::save_obj(out, mesh),
        Format::Ply => mesh_text::save_ply(out, mesh),
        Format::Stl => mesh_text::save_stl(out, mesh),
    }?;
    Ok(())
}
