//! What readers of models return, and what they share.

use crate::error::{DataError, Result};
use crate::photo::{self, Origin};
use diorama_geom::ImageU8;
use diorama_geom::model::Model;

/// A model, and what was left out or assumed when it was read, in plain words.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedModel {
    pub model: Model,
    pub notes: Vec<String>,
}

/// What was left out or assumed, each once.
#[derive(Default)]
pub(crate) struct Notes(pub Vec<String>);

impl Notes {
    pub(crate) fn add(&mut self, note: String) {
        if !self.0.contains(&note) {
            self.0.push(note);
        }
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
