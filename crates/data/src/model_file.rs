//! Models in files: glTF and OBJ.

use crate::error::{DataError, Result};
use crate::{gltf, obj};
use std::path::Path;

pub use crate::loaded_model::LoadedModel;

/// Reads a `.glb`, `.gltf` or `.obj` file.
///
/// # Errors
/// If the file cannot be read or has another extension.
pub fn read(path: &Path) -> Result<LoadedModel> {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    match extension.as_str() {
        "glb" | "gltf" => gltf::read(path),
        "obj" => obj::read(path, None),
        _ => Err(DataError::input(path, "a model is read from .glb, .gltf or .obj; export it as one of these")),
    }
}
