//! Images and samplers as [`Texture`]s.

use super::binary::{CLAMP, MIRROR};
use super::document::Document;
use crate::error::{DataError, Result};
use crate::loaded_model::{Notes, decode_texture};
use crate::photo::Origin;
use diorama_geom::ImageU8;
use diorama_geom::model::{Texture, Wrap};
use std::borrow::Cow;
use std::collections::HashMap;

/// Remedy for damaged images.
const CURE: &str = "export the model and its textures again";

/// The textures read so far.
#[derive(Default)]
pub struct Textures {
    pub read: Vec<Texture>,
    /// Index in `read` by image and wrap.
    known: HashMap<(usize, [Wrap; 2]), usize>,
    images: HashMap<usize, usize>,
}

impl Textures {
    /// Index of glTF's texture `index` among those read; `None` with a note if its image has an unknown format.
    pub fn add(&mut self, document: &Document, index: usize, what: &str, notes: &mut Notes) -> Result<Option<usize>> {
        let Some(source) = source(document, index, what)? else {
            notes.add(format!("{what}: texture {index} has neither PNG, JPEG nor WebP: it is left out"));
            return Ok(None);
        };
        let texture = document.item(&document.root.textures, index, "texture", what)?;
        let sampler = match texture.sampler {
            Some(i) => *document.item(&document.root.samplers, i, "sampler", what)?,
            None => Default::default(),
        };
        let wrap = [sampler.wrap_s, sampler.wrap_t].map(wrap);
        if let Some(known) = self.known.get(&(source, wrap)) {
            return Ok(Some(*known));
        }
        let image = match self.images.get(&source) {
            Some(same) => self.read[*same].image.clone(),
            None => decode(document, source, what)?,
        };
        let index = self.read.len();
        self.read.push(Texture { image, wrap });
        self.known.insert((source, wrap), index);
        self.images.insert(source, index);
        Ok(Some(index))
    }
}

/// Index of a texture's image.
pub fn source(document: &Document, index: usize, what: &str) -> Result<Option<usize>> {
    let texture = document.item(&document.root.textures, index, "texture", what)?;
    Ok(texture.source.or(texture.extensions.webp.as_ref().and_then(|w| w.source)))
}

fn wrap(mode: u32) -> Wrap {
    match mode {
        CLAMP => Wrap::Clamp,
        MIRROR => Wrap::Mirror,
        _ => Wrap::Repeat,
    }
}

fn decode(document: &Document, index: usize, what: &str) -> Result<ImageU8> {
    let image = document.item(&document.root.images, index, "image", what)?;
    let title = format!("image {index}");
    let (path, bytes) = match (&image.uri, image.buffer_view) {
        (Some(uri), _) => document.load(uri, &title)?,
        (None, Some(view)) => (document.path.to_path_buf(), Cow::Owned(document.view(view, &title)?.1.to_vec())),
        (None, None) => return Err(document.wrong(format!("{title} has no data; {CURE}"))),
    };
    let named = |e| match e {
        DataError::Input { message, .. } if path == document.path => document.wrong(format!("{title}: {message}")),
        e => e,
    };
    decode_texture(Origin { path: &path, cure: CURE }, &bytes).map_err(named)
}
