//! Primitives of meshes as triangles.

use super::accessor::Vectors;
use super::binary::{TRIANGLE_FAN, TRIANGLE_STRIP, TRIANGLES};
use super::document::Document;
use super::material::Coordinates;
use super::schema::Primitive;
use crate::error::Result;
use crate::loaded_model::Notes;
use diorama_geom::Mesh;
use diorama_geom::color::srgb_from_linear;

/// (x, y, z) of a world whose y points up, in a world whose z does.
pub fn z_up([x, y, z]: [f32; 3]) -> [f32; 3] {
    [x, -z, y]
}

/// Reads a primitive; `None` with a note if it has no triangles.
///
/// # Errors
/// If data are missing, have different lengths, or are not finite.
pub fn read(document: &Document, primitive: &Primitive, uvs: Option<Coordinates>, what: &str, notes: &mut Notes) -> Result<Option<Mesh>> {
    if !matches!(primitive.mode, TRIANGLES..=TRIANGLE_FAN) {
        notes.add(format!("{what}: its points or lines are left out"));
        return Ok(None);
    }
    let Some(positions) = primitive.attributes.get("POSITION") else {
        notes.add(format!("{what} has no positions: it is left out"));
        return Ok(None);
    };
    let positions = document.arrays::<3>(*positions, &format!("{what}, POSITION"))?;
    if let Some(i) = positions.iter().position(|p| p.iter().any(|v| !v.is_finite())) {
        return Err(document.wrong(format!("{what}: position {i} is not finite; repair the mesh and export it again")));
    }
    let n = positions.len();
    let mut mesh = Mesh { faces: faces(document, primitive, n, what)?, ..Mesh::default() };
    if mesh.faces.is_empty() {
        notes.add(format!("{what} has no triangles: it is left out"));
        return Ok(None);
    }
    mesh.positions = positions.into_iter().map(z_up).collect();
    let mut attribute = |name: &str| optional(document, primitive, name, n, what, notes);
    if let Some(normals) = attribute("NORMAL")? {
        mesh.normals = arrays::<3>(document, normals, what, "NORMAL")?.into_iter().map(|v| unit(z_up(v), [0.0, 0.0, 1.0])).collect();
    }
    let coordinates = uvs.unwrap_or_default();
    if let Some(uvs) = attribute(&format!("TEXCOORD_{}", coordinates.set))? {
        mesh.uvs = arrays::<2>(document, uvs, what, "TEXCOORD")?.into_iter().map(|uv| coordinates.transform.apply(uv)).collect();
    }
    if let Some(tangents) = attribute("TANGENT")?.filter(|_| !mesh.normals.is_empty() && coordinates.transform.keeps_directions()) {
        let turned = |[x, y, z, sign]: [f32; 4]| {
            let [x, y, z] = unit(z_up([x, y, z]), [1.0, 0.0, 0.0]);
            [x, y, z, if sign < 0.0 { -1.0 } else { 1.0 }]
        };
        mesh.tangents = arrays::<4>(document, tangents, what, "TANGENT")?.into_iter().map(turned).collect();
    }
    if let Some(Vectors { size, values }) = attribute("COLOR_0")? {
        if size == 4 && values.chunks_exact(4).any(|c| c[3] < 1.0) {
            notes.add(format!("{what}: the opacity of its vertices is left out"));
        }
        let srgb = |c: &[f32]| std::array::from_fn(|k| srgb_from_linear(c.get(k).copied().unwrap_or(0.0).clamp(0.0, 1.0)));
        mesh.colors_srgb = values.chunks_exact(size).map(srgb).collect();
    }
    if !primitive.targets.is_empty() {
        notes.add(format!("{what}: its morph targets are left out"));
    }
    Ok(Some(mesh))
}

/// An attribute, if the primitive has it and all of its numbers are finite.
fn optional(document: &Document, primitive: &Primitive, name: &str, n: usize, what: &str, notes: &mut Notes) -> Result<Option<Vectors>> {
    let Some(index) = primitive.attributes.get(name) else { return Ok(None) };
    let vectors = document.vectors(*index, &format!("{what}, {name}"))?;
    let count = vectors.values.len() / vectors.size;
    if count != n {
        return Err(document.wrong(format!("{what} has {n} positions, but {count} of {name}; export the mesh again")));
    }
    if vectors.values.iter().any(|v| !v.is_finite()) {
        notes.add(format!("{what}: numbers of {name} are not finite: they are left out"));
        return Ok(None);
    }
    Ok(Some(vectors))
}

fn arrays<const N: usize>(document: &Document, vectors: Vectors, what: &str, name: &str) -> Result<Vec<[f32; N]>> {
    if vectors.size != N {
        let size = vectors.size;
        return Err(document.wrong(format!("{what}: {name} has vectors of {size} numbers, not {N}; export the mesh again")));
    }
    Ok(vectors.values.as_chunks().0.to_vec())
}

/// A vector of length 1: itself if it is one already, but for rounding.
pub fn unit(v: [f32; 3], otherwise: [f32; 3]) -> [f32; 3] {
    let square: f32 = v.iter().map(|v| v * v).sum();
    if (square - 1.0).abs() < 1e-6 {
        return v;
    }
    let length = square.sqrt();
    if length > 1e-12 && length.is_finite() { v.map(|v| v / length) } else { otherwise }
}

/// Triangles of three vertices each.
fn faces(document: &Document, primitive: &Primitive, n: usize, what: &str) -> Result<Vec<[u32; 3]>> {
    let count = u32::try_from(n).map_err(|_| document.wrong(format!("{what} has more than 2³² vertices; split it")))?;
    let indices = match primitive.indices {
        Some(index) => document.indices(index, &format!("{what}, indices"))?,
        None => (0..count).collect(),
    };
    if let Some(i) = indices.iter().find(|i| **i >= count) {
        return Err(document.wrong(format!("{what}: index {i} is not below its {n} vertices; export the mesh again")));
    }
    let triples = indices.windows(3).map(|w| [w[0], w[1], w[2]]);
    let mut faces: Vec<[u32; 3]> = match primitive.mode {
        TRIANGLE_STRIP => triples.enumerate().map(|(i, [a, b, c])| if i % 2 == 0 { [a, b, c] } else { [b, a, c] }).collect(),
        TRIANGLE_FAN => triples.map(|[_, b, c]| [b, c, indices[0]]).collect(),
        _ => return Ok(indices.as_chunks().0.to_vec()),
    };
    // Repeated vertices join strips.
    faces.retain(|[a, b, c]| a != b && b != c && a != c);
    Ok(faces)
}
