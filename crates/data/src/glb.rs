//! Binary glTF 2.0 with a texture or vertex colors. The material is unlit unless there is a normal map. glTF is y up: (x, y, z) is written
//! as (x, z, −y). COLOR_0 is linear, as the standard requires.

use crate::error::{DataError, Result};
use crate::gltf::binary::{ARRAY, CLAMP, Chunk, ELEMENTS, FLOAT, LINEAR, LINEAR_MIPMAP, UINT, USHORT, join, y_up};
use crate::{atomic, photo};
use diorama_geom::Mesh;
use diorama_geom::color::linear_from_srgb;
use serde_json::{Value, json};
use std::path::Path;

/// Encodes a mesh as GLB.
///
/// # Errors
/// If the mesh is empty (glTF has no empty accessors) or exceeds the format's limits.
pub fn encode(mesh: &Mesh, path: &Path) -> Result<Vec<u8>> {
    if mesh.faces.is_empty() {
        return Err(DataError::input(path, "the mesh is empty: nothing is denser than the level; lower --level or train longer"));
    }
    let n = mesh.positions.len();
    let texture = mesh.texture.as_ref().filter(|_| mesh.uvs.len() == n);
    let normal_map = mesh.normal_map.as_ref().filter(|_| texture.is_some() && mesh.tangents.len() == n);
    let mut chunk = Chunk::default();
    let mut attributes = attributes(mesh, texture.is_some(), &mut chunk);
    let indices = mesh.faces.iter().flatten().flat_map(|i| i.to_le_bytes()).collect();
    let indices = chunk.add(indices, ELEMENTS, json!({ "componentType": UINT, "count": mesh.faces.len() * 3, "type": "SCALAR" }));
    if normal_map.is_some() {
        let turned = mesh.tangents.iter().flat_map(|t| {
            let [x, y, z] = y_up([t[0], t[1], t[2]]);
            [x, y, z, t[3]]
        });
        let data = turned.flat_map(f32::to_le_bytes).collect();
        attributes["TANGENT"] = chunk.add(data, ARRAY, json!({ "componentType": FLOAT, "count": n, "type": "VEC4" }));
    }
    let mut images = Vec::new();
    for image in [texture, normal_map].into_iter().flatten() {
        let view = chunk.view(photo::encode_png(image), None);
        images.push(json!({ "mimeType": "image/png", "bufferView": view }));
    }
    let mut root = json!({
        "asset": { "version": "2.0", "generator": concat!("diorama ", env!("CARGO_PKG_VERSION")) },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "name": "mesh" }],
        "meshes": [{ "primitives": [{ "attributes": attributes, "indices": indices, "material": 0 }] }],
        "materials": [material(texture.is_some(), normal_map.is_some())],
        "buffers": [{ "byteLength": chunk.bytes.len() }],
        "bufferViews": chunk.views,
        "accessors": chunk.accessors,
    });
    if texture.is_some() {
        // Linear filters with mipmaps. Repeating coordinates would blend in the opposite edge.
        root["samplers"] = json!([{ "magFilter": LINEAR, "minFilter": LINEAR_MIPMAP, "wrapS": CLAMP, "wrapT": CLAMP }]);
        root["textures"] = (0..images.len()).map(|i| json!({ "sampler": 0, "source": i })).collect();
        root["images"] = images.into();
    }
    if normal_map.is_none() {
        root["extensionsUsed"] = json!(["KHR_materials_unlit"]);
    }
    join(&root, &chunk.bytes, path)
}

/// Positions, normals, and texture coordinates or vertex colors.
fn attributes(mesh: &Mesh, is_textured: bool, chunk: &mut Chunk) -> Value {
    let n = mesh.positions.len();
    let floats = |v: &mut dyn Iterator<Item = [f32; 3]>| v.flat_map(|p| p.map(f32::to_le_bytes)).flatten().collect::<Vec<u8>>();
    let turned: Vec<[f32; 3]> = mesh.positions.iter().map(|p| y_up(*p)).collect();
    let (lo, hi) = turned.iter().fold(([f32::MAX; 3], [f32::MIN; 3]), |(lo, hi), p| {
        (std::array::from_fn(|k| lo[k].min(p[k])), std::array::from_fn(|k| hi[k].max(p[k])))
    });
    let mut attributes = json!({});
    let accessor = json!({ "componentType": FLOAT, "count": n, "type": "VEC3", "min": lo, "max": hi });
    attributes["POSITION"] = chunk.add(floats(&mut turned.iter().copied()), ARRAY, accessor);
    if mesh.normals.len() == n {
        let data = floats(&mut mesh.normals.iter().map(|v| y_up(*v)));
        attributes["NORMAL"] = chunk.add(data, ARRAY, json!({ "componentType": FLOAT, "count": n, "type": "VEC3" }));
    }
    if is_textured {
        let data = mesh.uvs.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        attributes["TEXCOORD_0"] = chunk.add(data, ARRAY, json!({ "componentType": FLOAT, "count": n, "type": "VEC2" }));
    } else if mesh.colors_srgb.len() == n {
        let word = |v: f32| ((linear_from_srgb(v.clamp(0.0, 1.0)) * 65535.0 + 0.5) as u16).to_le_bytes();
        let data = mesh.colors_srgb.iter().flat_map(|c| [word(c[0]), word(c[1]), word(c[2]), [255, 255]]).flatten().collect();
        attributes["COLOR_0"] = chunk.add(data, ARRAY, json!({ "componentType": USHORT, "count": n, "type": "VEC4", "normalized": true }));
    }
    attributes
}

/// Vertex and texture colors already include the lighting, so the material is unlit. A normal map is meant for the user's own lights.
fn material(is_textured: bool, is_lit: bool) -> Value {
    let mut material = json!({ "name": "radiance", "pbrMetallicRoughness": { "metallicFactor": 0.0, "roughnessFactor": 1.0 } });
    if !is_lit {
        material["extensions"] = json!({ "KHR_materials_unlit": {} });
    }
    if is_textured {
        material["pbrMetallicRoughness"]["baseColorTexture"] = json!({ "index": 0 });
    }
    if is_lit {
        material["normalTexture"] = json!({ "index": 1 });
    }
    material
}

/// Writes a `.glb` atomically.
pub fn save(path: &Path, mesh: &Mesh) -> Result<()> {
    atomic::write(path, &encode(mesh, path)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_are_aligned_and_the_axes_turned() {
        let mesh = Mesh {
            positions: vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 3.0]],
            normals: vec![[0.0, 0.0, 1.0]; 3],
            colors_srgb: vec![[1.0, 0.5, 0.0]; 3],
            faces: vec![[0, 1, 2]],
            ..Mesh::default()
        };
        let b = encode(&mesh, Path::new("x")).unwrap();
        assert_eq!(b.len() % 4, 0);
        assert_eq!(u32::from_le_bytes(b[8..12].try_into().unwrap()) as usize, b.len());
        let n = u32::from_le_bytes(b[12..16].try_into().unwrap()) as usize;
        let root: serde_json::Value = serde_json::from_slice(&b[20..20 + n]).unwrap();
        assert_eq!(root["accessors"][0]["max"], json!([1.0, 3.0, 0.0]));
        assert_eq!(root["accessors"][0]["min"], json!([0.0, 0.0, -2.0]));
    }

    #[test]
    fn an_empty_mesh_is_an_error_with_a_cure() {
        assert!(encode(&Mesh::default(), Path::new("x.glb")).unwrap_err().to_string().contains("--level"));
    }
}
