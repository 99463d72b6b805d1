//! `diorama bench reduce`: a surface of millions of faces with floaters, cleaned, reduced, and written.

use crate::error::Result;
use crate::relight::meshing::surface::{self, Removed};
use diorama_data::gltf::{self, WriteOptions};
use diorama_data::{DataError, mesh_text, model_file};
use diorama_geom::{Mesh, Model};
use diorama_mesh::extract::{Grid, Method};
use diorama_mesh::sparse_grid::{self, SparseGrid};
use diorama_scenes::hills::{self, Hills};
use serde::Serialize;
use std::path::Path;
use std::time::Instant;

/// Hills and floaters.
const HILLS: usize = 40;
pub const FLOATERS: usize = 50;
/// Samples per axis of a triangle, for distances and areas.
const SAMPLES: usize = 2;
/// A part of the surface is lost if no vertex of the cleaned mesh lies within so many cells of it.
const NEAR: f32 = 3.0;

/// What a reduction did, and how long each stage took.
#[derive(Clone, Debug, Serialize)]
pub struct ReduceReport {
    pub threads: usize,
    pub resolution: usize,
    pub sampled_blocks: usize,
    pub extracted_faces: usize,
    pub faces: usize,
    pub removed: Removed,
    /// Floaters of which any face is left, of all.
    pub floaters_left: usize,
    pub floaters: usize,
    /// Share of the true surface's area that cleaning removed.
    pub area_lost: f64,
    /// Mean distance of the reduced surface to the true one, over the diagonal of its box.
    pub mean_distance: f64,
    pub sample_seconds: f64,
    pub extract_seconds: f64,
    pub clean_seconds: f64,
    pub reduce_seconds: f64,
    /// The extracted surface as OBJ, and the reduced one as GLB with 16 bits per number.
    pub obj_bytes: u64,
    pub glb_bytes: u64,
    pub glb_load_seconds: f64,
}

/// Extracts [`Hills`] at a resolution and reduces them to `target` faces; files are written to `folder`.
///
/// # Errors
/// When a file cannot be written or read.
pub fn run(resolution: usize, target: usize, folder: &Path) -> Result<ReduceReport> {
    let hills = Hills::new(HILLS, FLOATERS, 0);
    let (min, max) = hills.bounds();
    let grid = Grid { min, max, resolution };
    let (mut seconds, mut since) = (Vec::new(), Instant::now());
    let mut lap = || {
        seconds.push(since.elapsed().as_secs_f64());
        since = Instant::now();
    };
    let may_hold = |lo: [f32; 3], hi: [f32; 3]| {
        let center = std::array::from_fn(|k| 0.5 * (lo[k] + hi[k]));
        let radius = 0.5 * (0..3).map(|k| (hi[k] - lo[k]).powi(2)).sum::<f32>().sqrt() + 0.02;
        hills.distance(center).min(hills.floater_distance(center)) < radius
    };
    let blocks = sparse_grid::candidates(&grid, &may_hold);
    let sampled = SparseGrid::sample(&hills, &grid, &blocks, &mut |_, _| true);
    lap();
    let mut mesh = sampled.surface(hills::LEVEL, Method::Cubes, true);
    drop(sampled);
    lap();
    let extracted_faces = mesh.faces.len();
    std::fs::create_dir_all(folder).map_err(DataError::io(folder, "create"))?;
    let (obj, glb) = (folder.join("extracted.obj"), folder.join("reduced.glb"));
    mesh_text::save_obj(&obj, &mesh)?;
    let before = area_of_ground(&mesh, &hills, &grid);
    lap();
    let removed = surface::clean(&mut mesh, &hills.cameras(), grid.cell());
    lap();
    let area_lost = 1.0 - area_of_ground(&mesh, &hills, &grid) / before;
    let near = |b: &&hills::Ball| {
        let is_near = |p: &[f32; 3]| (0..3).map(|k| (p[k] - b.center[k]).powi(2)).sum::<f32>().sqrt() < b.radius + NEAR * grid.cell();
        mesh.positions.iter().any(is_near)
    };
    let floaters_left = hills.floaters.iter().filter(near).count();
    lap();
    surface::reduce(&mut mesh, target);
    lap();
    mesh.compute_normals();
    let diagonal = (0..3).map(|k| ((max[k] - min[k]) as f64).powi(2)).sum::<f64>().sqrt();
    let mean_distance = distance(&mesh, &hills) / diagonal;
    gltf::save(&glb, &Model::of("hills", mesh.clone()), WriteOptions { quantize: true })?;
    let load = Instant::now();
    model_file::read(&glb)?;
    let bytes = |p: &Path| std::fs::metadata(p).map_or(0, |m| m.len());
    Ok(ReduceReport {
        threads: rayon::current_num_threads(),
        resolution,
        sampled_blocks: blocks.len(),
        extracted_faces,
        faces: mesh.faces.len(),
        removed,
        floaters_left,
        floaters: hills.floaters.len(),
        area_lost,
        mean_distance,
        sample_seconds: seconds[0],
        extract_seconds: seconds[1],
        clean_seconds: seconds[3],
        reduce_seconds: seconds[5],
        obj_bytes: bytes(&obj),
        glb_bytes: bytes(&glb),
        glb_load_seconds: load.elapsed().as_secs_f64(),
    })
}

/// Area of the faces on the hills, without the sides and the underside where the box cuts them, and without floaters.
fn area_of_ground(mesh: &Mesh, hills: &Hills, grid: &Grid) -> f64 {
    let inside = |p: &[f32; 3]| {
        let room = 0.5 * grid.cell();
        p[2] > grid.min[2] + room && (0..2).all(|k| p[k] > grid.min[k] + room && p[k] < grid.max[k] - room)
    };
    let of = |f: &[u32; 3]| {
        let corners = f.map(|i| mesh.positions[i as usize]);
        let is_ground = corners.iter().all(|p| inside(p) && hills.distance(*p).abs() < NEAR * grid.cell());
        if is_ground { area(corners) } else { 0.0 }
    };
    mesh.faces.iter().map(of).sum()
}

fn area(corners: [[f32; 3]; 3]) -> f64 {
    use diorama_geom::glam::DVec3;
    let [a, b, c] = corners.map(|p| DVec3::from(p.map(f64::from)));
    0.5 * (b - a).cross(c - a).length()
}

/// Mean distance to the true surface over the area.
fn distance(mesh: &Mesh, hills: &Hills) -> f64 {
    let (mut sum, mut total) = (0.0, 0.0);
    for f in &mesh.faces {
        let corners = f.map(|i| mesh.positions[i as usize]);
        let area = area(corners);
        let mut mean = 0.0;
        for a in 0..SAMPLES {
            for b in 0..SAMPLES - a {
                let (u, v) = ((a as f32 + 1.0 / 3.0) / SAMPLES as f32, (b as f32 + 1.0 / 3.0) / SAMPLES as f32);
                let p = std::array::from_fn(|k| corners[0][k] * (1.0 - u - v) + corners[1][k] * u + corners[2][k] * v);
                mean += hills.distance(p).abs() as f64;
            }
        }
        sum += area * mean / (SAMPLES * (SAMPLES + 1) / 2) as f64;
        total += area;
    }
    sum / total.max(1e-30)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floaters_go_the_ground_stays_and_a_fortieth_of_the_faces_keeps_its_form() {
        let dir = tempfile::tempdir().unwrap();
        let r = run(384, 8_000, dir.path()).unwrap();
        assert!(r.extracted_faces > 300_000 && r.faces <= 8_000, "{r:?}");
        assert_eq!(r.floaters_left, 0, "{r:?}");
        assert!(r.area_lost < 1e-3, "{r:?}");
        assert!(r.mean_distance <= 1e-3, "{r:?}");
        assert!(r.glb_bytes * 50 <= r.obj_bytes, "{r:?}");
    }
}
