//! Models in files: glTF and OBJ.

use crate::error::{DataError, Result};
use crate::photo::{self, Origin};
use crate::{gltf, obj};
use diorama_geom::ImageU8;
use diorama_geom::model::Model;
use std::path::Path;

/// A model, and what was left out or assumed when it was read, in plain words.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedModel {
    pub model: Model,
    pub notes: Vec<String>,
}

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

/// Decodes an image of a texture to RGB or RGBA of 8 bits.
pub(crate) fn decode_texture(origin: Origin, bytes: &[u8]) -> Result<ImageU8> {
    let image = photo::decode(origin, bytes)?;
    let (width, height) = (image.width() as usize, image.height() as usize);
    if width == 0 || height == 0 {
        return Err(DataError::input(origin.path, format!("the image has no pixels; {}", origin.cure)));
    }
    let channels = if image.color().has_alpha() { 4 } else { 3 };
    let data = if channels == 4 { image.into_rgba8().into_raw() } else { image.into_rgb8().into_raw() };
    Ok(ImageU8 { width, height, channels, data })
}
