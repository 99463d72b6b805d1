//! `diorama bench mesh`

use super::median_seconds;
use crate::error::Result;
use crate::object::model::ObjectModel;
use crate::object::{export, extent};
use diorama_data::{atomic, memory, mesh_text};
use diorama_mesh::extract::{self, Grid};
use serde::Serialize;
use std::io::Write;
use std::path::Path;

/// Extraction of a surface from densities that are at hand, with normals, to a PLY file.
#[derive(Clone, Debug, Serialize)]
pub struct MeshReport {
    pub threads: usize,
    /// Grid points along x, y, z.
    pub points: [usize; 3],
    pub level: f32,
    pub vertices: usize,
    pub faces: usize,
    /// Median.
    pub seconds: f64,
    /// Most memory in use during extraction, above what the densities and the program had taken before.
    pub peak_bytes: Option<u64>,
}

/// Samples a run's densities once, keeps them as `.npy` where `save` says so, and extracts `repeats` times.
pub fn run(model: &ObjectModel, resolution: usize, save: Option<&Path>, repeats: usize) -> Result<MeshReport> {
    let (min, max) = extent::of(model);
    let grid = Grid { min, max, resolution };
    let level = export::automatic_level(model, &grid);
    let sigma = extract::sample(model, &grid, &mut |_, _| {});
    if let Some(path) = save {
        save_npy(path, &sigma, grid.points())?;
    }
    let folder = std::env::temp_dir().join(format!("diorama-bench-{}", std::process::id()));
    std::fs::create_dir_all(&folder).map_err(diorama_data::DataError::io(&folder, "create"))?;
    let file = folder.join("bench.ply");
    let (mut sizes, mut failed) = ((0, 0), Ok(()));
    let before = resident();
    memory::reset_peak();
    let seconds = median_seconds(repeats, || {
        let mut mesh = extract::from_densities(&sigma, &grid, level);
        mesh.compute_normals();
        sizes = (mesh.positions.len(), mesh.faces.len());
        failed = mesh_text::save_ply(&file, &mesh);
    });
    let peak_bytes = peak().zip(before).map(|(p, b)| p.saturating_sub(b));
    let _ = std::fs::remove_dir_all(&folder);
    failed?;
    let (vertices, faces) = sizes;
    Ok(MeshReport { threads: rayon::current_num_threads(), points: grid.points(), level, vertices, faces, seconds, peak_bytes })
}

fn save_npy(path: &Path, values: &[f32], [nx, ny, nz]: [usize; 3]) -> Result<()> {
    let mut header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({nz}, {ny}, {nx}), }}");
    // Magic, version and length take ten bytes; data begins at a multiple of 64.
    let padded = (header.len() + 11).next_multiple_of(64) - 10;
    header.push_str(&" ".repeat(padded - header.len() - 1));
    header.push('\n');
    Ok(atomic::write_with(path, |w| {
        w.write_all(b"\x93NUMPY\x01\x00")?;
        w.write_all(&(header.len() as u16).to_le_bytes())?;
        w.write_all(header.as_bytes())?;
        values.iter().try_for_each(|v| w.write_all(&v.to_le_bytes()))
    })?)
}

/// A figure of Linux's /proc/self/status in bytes.
fn status(key: &str) -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find(|l| l.starts_with(key))?;
    Some(line.split_whitespace().nth(1)?.parse::<u64>().ok()? * 1024)
}

fn resident() -> Option<u64> {
    status("VmRSS:")
}

fn peak() -> Option<u64> {
    status("VmHWM:")
}
