//! Extensions of glTF that are read, and what to do about others.

use super::schema::Root;
use crate::error::{DataError, Result};
use crate::loaded_model::Notes;
use std::path::Path;

/// Extensions that are read.
const READ: [&str; 7] = [
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "KHR_materials_emissive_strength",
    "KHR_materials_specular",
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "EXT_texture_webp",
];

/// Refuses a file that cannot be understood without an extension that is not read.
pub fn check(root: &Root, path: &Path) -> Result<()> {
    if let Some(name) = root.extensions_required.iter().find(|n| !READ.contains(&n.as_str())) {
        return Err(DataError::input(path, format!("it requires the extension {name}, which is not read; {}", cure(name))));
    }
    Ok(())
}

/// Notes other extensions that are not read.
pub fn note(root: &Root, notes: &mut Notes) {
    for name in root.extensions_used.iter().filter(|n| !READ.contains(&n.as_str())) {
        notes.add(format!("the extension {name} is left out"));
    }
    if !root.animations.is_empty() {
        notes.add("animations are left out".into());
    }
}

fn cure(name: &str) -> &'static str {
    match name {
        "KHR_draco_mesh_compression" | "EXT_meshopt_compression" | "KHR_meshopt_compression" => {
            "decompress it: npx @gltf-transform/cli copy IN.glb OUT.glb, or export it without compression"
        }
        "KHR_texture_basisu" => "convert its textures: npx @gltf-transform/cli ktxdecompress IN.glb OUT.glb, or export PNG textures",
        "KHR_materials_pbrSpecularGlossiness" => "convert it: npx @gltf-transform/cli metalrough IN.glb OUT.glb",
        _ => "export it without",
    }
}
