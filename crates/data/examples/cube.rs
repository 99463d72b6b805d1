//! Writes a textured cube of one meter in every mesh format: `cargo run --release -p diorama-data --example cube -- FOLDER`.

use diorama_data::{collada, glb, mesh_text, usdz};
use diorama_geom::{ImageU8, Mesh};
use std::path::PathBuf;

fn main() -> diorama_data::Result<()> {
    let folder = PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| ".".into()));
    let cube = cube();
    let file = |extension: &str| folder.join("cube").with_extension(extension);
    glb::save(&file("glb"), &cube)?;
    mesh_text::save_obj(&file("obj"), &cube)?;
    mesh_text::save_ply(&file("ply"), &cube)?;
    mesh_text::save_stl(&file("stl"), &cube)?;
    usdz::save(&file("usdz"), &cube)?;
    collada::save(&file("dae"), &cube)
}

/// From the origin to (1, 1, 1), z up; each side shows the whole texture: red to the right, green upward.
fn cube() -> Mesh {
    let mut m = Mesh::default();
    for (axis, side) in (0..3).flat_map(|a| [(a, 0.0), (a, 1.0f32)]) {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let first = m.positions.len() as u32;
        for (a, b) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
            let (mut p, mut n) = ([0.0f32; 3], [0.0; 3]);
            (p[axis], p[u], p[v], n[axis]) = (side, a, b, 2.0 * side - 1.0);
            m.positions.push(p);
            m.normals.push(n);
            m.uvs.push([a, 1.0 - b]);
            m.colors_srgb.push([a, b, 0.5]);
        }
        let ring = if side > 0.5 { [0, 1, 2, 3] } else { [0, 3, 2, 1] }.map(|i| first + i);
        m.faces.extend([[ring[0], ring[1], ring[2]], [ring[0], ring[2], ring[3]]]);
    }
    let texel = |i: usize| [(i % 64 * 4) as u8, 255 - (i / 64 * 4) as u8, 128];
    m.texture = Some(ImageU8 { width: 64, height: 64, channels: 3, data: (0..64 * 64).flat_map(texel).collect() });
    m
}
