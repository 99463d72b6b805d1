//! Meshes as primitives of glTF, in floats or quantized (KHR_mesh_quantization).

use super::binary::{ARRAY, BYTE, Chunk, ELEMENTS, FLOAT, UINT, USHORT, y_up};
use super::primitive::unit;
use crate::error::{DataError, Result};
use diorama_geom::Mesh;
use diorama_geom::color::linear_from_srgb;
use diorama_geom::glam::DVec3;
use diorama_geom::model::{Material, Part};
use serde_json::{Value, json};
use std::path::Path;

/// The grid of quantized positions, y up: `position = corner + step · integers`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    pub corner: DVec3,
    /// One for all axes, so that normals keep their directions.
    pub step: f64,
}

impl Default for Grid {
    fn default() -> Grid {
        Grid { corner: DVec3::ZERO, step: 1.0 }
    }
}

impl Grid {
    /// The finest grid of 16 bits that holds a mesh.
    pub fn of(mesh: &Mesh) -> Grid {
        let points = || mesh.positions.iter().map(|p| DVec3::from(y_up(*p).map(f64::from)));
        let Some(first) = points().next() else { return Grid::default() };
        let (low, high) = points().fold((first, first), |(low, high), p| (low.min(p), high.max(p)));
        let side = (high - low).max_element();
        Grid { corner: low, step: if side > 0.0 { side / u16::MAX as f64 } else { 1.0 } }
    }

    fn steps(&self, p: [f32; 3]) -> [u16; 3] {
        ((DVec3::from(p.map(f64::from)) - self.corner) / self.step).round().to_array().map(|v| v as u16)
    }
}

/// Refuses what glTF does not allow.
///
/// # Errors
/// If positions are not finite, faces refer to missing vertices, or a textured part has no texture coordinates.
pub fn check(part: &Part, material: &Material, path: &Path) -> Result<()> {
    let wrong = |what: String| DataError::input(path, format!("part \"{}\" {what}", part.name));
    let mesh = &part.mesh;
    if let Some(i) = mesh.positions.iter().position(|p| p.iter().any(|v| !v.is_finite())) {
        return Err(wrong(format!("has the position {i} that is not finite; repair the mesh")));
    }
    if let Some(i) = mesh.faces.iter().flatten().find(|i| **i as usize >= mesh.positions.len()) {
        return Err(wrong(format!("has a face with vertex {i}, but {} vertices; repair the mesh", mesh.positions.len())));
    }
    let textures = [material.base_color_texture, material.metallic_roughness_texture, material.normal_texture, material.emission_texture];
    if textures.iter().any(Option::is_some) && mesh.uvs.len() != mesh.positions.len() {
        return Err(wrong(format!("has no texture coordinates for the textures of material \"{}\"; unwrap it", material.name)));
    }
    Ok(())
}

/// A primitive without its material; positions are steps of `grid`, if there is one.
pub fn primitive(mesh: &Mesh, material: &Material, grid: Option<Grid>, chunk: &mut Chunk) -> Value {
    let n = mesh.positions.len();
    let quantize = grid.is_some();
    let mut attributes = json!({ "POSITION": positions(mesh, grid, chunk) });
    let has_normals = mesh.normals.len() == n;
    if has_normals {
        let normals: Vec<[f32; 3]> = mesh.normals.iter().map(|v| unit(y_up(*v), [0.0, 1.0, 0.0])).collect();
        attributes["NORMAL"] = directions(&normals, "VEC3", quantize, chunk);
    }
    if has_normals && material.normal_texture.is_some() && mesh.tangents.len() == n {
        let turned = mesh.tangents.iter().map(|[x, y, z, sign]| {
            let [x, y, z] = unit(y_up([*x, *y, *z]), [1.0, 0.0, 0.0]);
            [x, y, z, if *sign < 0.0 { -1.0 } else { 1.0 }]
        });
        attributes["TANGENT"] = directions(&turned.collect::<Vec<_>>(), "VEC4", quantize, chunk);
    }
    if mesh.uvs.len() == n {
        let numbers = || mesh.uvs.iter().flatten().map(|v| if v.is_finite() { *v } else { 0.0 });
        attributes["TEXCOORD_0"] = if quantize && numbers().all(|v| (0.0..=1.0).contains(&v)) {
            let data = numbers().flat_map(|v| ((v * 65535.0).round() as u16).to_le_bytes()).collect();
            chunk.add(data, ARRAY, json!({ "componentType": USHORT, "normalized": true, "count": n, "type": "VEC2" }))
        } else {
            let data = numbers().flat_map(f32::to_le_bytes).collect();
            chunk.add(data, ARRAY, json!({ "componentType": FLOAT, "count": n, "type": "VEC2" }))
        };
    }
    if mesh.colors_srgb.len() == n {
        let word = |v: f32| ((linear_from_srgb(v.clamp(0.0, 1.0)) * 65535.0).round() as u16).to_le_bytes();
        let data = mesh.colors_srgb.iter().flat_map(|c| [word(c[0]), word(c[1]), word(c[2]), [255; 2]]).flatten().collect();
        attributes["COLOR_0"] = chunk.add(data, ARRAY, json!({ "componentType": USHORT, "normalized": true, "count": n, "type": "VEC4" }));
    }
    json!({ "attributes": attributes, "indices": indices(mesh, chunk) })
}

fn positions(mesh: &Mesh, grid: Option<Grid>, chunk: &mut Chunk) -> Value {
    let turned = mesh.positions.iter().map(|p| y_up(*p));
    let n = mesh.positions.len();
    match grid {
        Some(grid) => {
            let rows: Vec<[u16; 3]> = turned.map(|p| grid.steps(p)).collect();
            let (min, max) = rows.iter().fold(([u16::MAX; 3], [0; 3]), |(min, max), p| {
                (std::array::from_fn(|k| p[k].min(min[k])), std::array::from_fn(|k| p[k].max(max[k])))
            });
            let data = rows.iter().flat_map(|[x, y, z]| [*x, *y, *z, 0]).flat_map(u16::to_le_bytes).collect();
            chunk.add_rows(data, 8, json!({ "componentType": USHORT, "count": n, "type": "VEC3", "min": min, "max": max }))
        }
        None => {
            let (min, max) = turned.clone().fold(([f32::MAX; 3], [f32::MIN; 3]), |(min, max), p| {
                (std::array::from_fn(|k| p[k].min(min[k])), std::array::from_fn(|k| p[k].max(max[k])))
            });
            let data = turned.flatten().flat_map(f32::to_le_bytes).collect();
            chunk.add(data, ARRAY, json!({ "componentType": FLOAT, "count": n, "type": "VEC3", "min": min, "max": max }))
        }
    }
}

/// Vectors of numbers from −1 to 1.
fn directions<const N: usize>(rows: &[[f32; N]], kind: &str, quantize: bool, chunk: &mut Chunk) -> Value {
    if quantize {
        let byte = |v: f32| (v * 127.0).round() as i8 as u8;
        // Rows begin at multiples of 4 bytes.
        let data = rows.iter().flat_map(|row| (0..4).map(|k| row.get(k).map_or(0, |v| byte(*v)))).collect();
        chunk.add_rows(data, 4, json!({ "componentType": BYTE, "normalized": true, "count": rows.len(), "type": kind }))
    } else {
        let data = rows.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        chunk.add(data, ARRAY, json!({ "componentType": FLOAT, "count": rows.len(), "type": kind }))
    }
}

fn indices(mesh: &Mesh, chunk: &mut Chunk) -> Value {
    let numbers = || mesh.faces.iter().flatten();
    // The largest number of a type is not an index.
    let (kind, data): (_, Vec<u8>) = if mesh.positions.len() <= u16::MAX as usize {
        (USHORT, numbers().flat_map(|i| (*i as u16).to_le_bytes()).collect())
    } else {
        (UINT, numbers().flat_map(|i| i.to_le_bytes()).collect())
    };
    chunk.add(data, ELEMENTS, json!({ "componentType": kind, "count": mesh.faces.len() * 3, "type": "SCALAR" }))
}
