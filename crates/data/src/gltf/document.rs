//! A glTF file with its buffers: `.glb`, or `.gltf` with data beside it or inside of it.

use super::binary::{BIN, JSON, MAGIC};
use super::schema::{BufferView, Root};
use super::{data_uri, extensions};
use crate::error::{self, DataError, Result};
use std::borrow::Cow;
use std::cell::Cell;
use std::path::{Path, PathBuf};

/// Largest file that is read, in bytes: what the lengths in a `.glb` can say.
const LIMIT: u64 = u32::MAX as u64;

/// A parsed file.
pub struct Document<'a> {
    pub path: &'a Path,
    pub root: Root,
    buffers: Vec<Vec<u8>>,
    /// Numbers read from accessors so far.
    pub numbers: Cell<usize>,
}

impl<'a> Document<'a> {
    /// Reads the file and all of its buffers.
    pub fn open(path: &'a Path) -> Result<Document<'a>> {
        let bytes = error::read(path, LIMIT)?;
        let (text, binary) = if bytes.starts_with(MAGIC) { chunks(&bytes, path)? } else { (&bytes[..], None) };
        let text = text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text);
        let root: Root = serde_json::from_slice(text).map_err(|e| {
            let cure = if e.is_eof() { "the JSON ends too early; copy the file again" } else { "export it again as glTF 2.0" };
            DataError::input(path, format!("not glTF: {e}; {cure}"))
        })?;
        let mut document = Document { path, root, buffers: Vec::new(), numbers: Cell::new(0) };
        // Before the buffers, which compression may leave out.
        extensions::check(&document.root, path)?;
        document.buffers = (0..document.root.buffers.len()).map(|i| document.load_buffer(i, binary)).collect::<Result<_>>()?;
        Ok(document)
    }

    fn load_buffer(&self, i: usize, binary: Option<&[u8]>) -> Result<Vec<u8>> {
        let buffer = &self.root.buffers[i];
        let bytes = match (&buffer.uri, binary) {
            (Some(uri), _) => self.load(uri, &format!("buffer {i}"))?.1.into_owned(),
            (None, Some(binary)) if i == 0 => binary.to_vec(),
            (None, _) => return Err(self.wrong(format!("buffer {i} has no data; export the file again"))),
        };
        if bytes.len() < buffer.byte_length {
            let (want, have) = (buffer.byte_length, bytes.len());
            return Err(self.wrong(format!("buffer {i} should have {want} bytes, but only {have} are there; copy the file again")));
        }
        Ok(bytes)
    }

    /// The bytes of a URI, and the file that holds them.
    pub fn load(&self, uri: &str, what: &str) -> Result<(PathBuf, Cow<'static, [u8]>)> {
        if let Some(data) = data_uri::decode(uri) {
            let data = data.map_err(|e| self.wrong(format!("{what}: {e}; export the file again")))?;
            return Ok((self.path.to_path_buf(), data.into()));
        }
        let refused = |why: &str| self.wrong(format!("{what} is at {uri:.80}, {why}; put the file beside and name it by a relative path"));
        if uri.contains("://") {
            return Err(refused("which is not fetched"));
        }
        let relative = data_uri::path(uri).ok_or_else(|| refused("which is not UTF-8"))?;
        if Path::new(&relative).is_absolute() || relative.starts_with('\\') || relative.contains('\0') {
            return Err(refused("which is no relative path"));
        }
        let file = self.path.parent().unwrap_or(Path::new("")).join(relative);
        match std::fs::metadata(&file) {
            Ok(m) if m.is_file() => Ok((file.clone(), error::read(&file, LIMIT)?.into())),
            Ok(_) => Err(refused("which is no file")),
            Err(_) => Err(self.wrong(format!("{what}: the file {} is missing; put it there, or export as one .glb", file.display()))),
        }
    }

    /// The bytes of a buffer view.
    pub fn view(&self, index: usize, what: &str) -> Result<(&BufferView, &[u8])> {
        let view = self.item(&self.root.buffer_views, index, "buffer view", what)?;
        let buffer = self.item(&self.buffers, view.buffer, "buffer", what)?;
        let end = view.byte_offset.checked_add(view.byte_length).filter(|end| *end <= buffer.len());
        let end = end.ok_or_else(|| {
            self.wrong(format!("{what}: buffer view {index} goes past the end of buffer {}; export the file again", view.buffer))
        })?;
        Ok((view, &buffer[view.byte_offset..end]))
    }

    /// An item of a list that `what` refers to by index.
    pub fn item<'b, T>(&self, items: &'b [T], index: usize, kind: &str, what: &str) -> Result<&'b T> {
        let missing = || self.wrong(format!("{what} refers to {kind} {index}, but there are {}; export the file again", items.len()));
        items.get(index).ok_or_else(missing)
    }

    /// An error in this file.
    pub fn wrong(&self, message: impl Into<String>) -> DataError {
        DataError::input(self.path, message)
    }

    /// Kind, index and name of an item, for messages.
    pub fn title(kind: &str, index: usize, name: Option<&str>) -> String {
        match name.filter(|n| !n.is_empty()) {
            Some(name) => format!("{kind} \"{name}\""),
            None => format!("{kind} {index}"),
        }
    }
}

/// JSON and binary chunk of a `.glb`.
fn chunks<'b>(bytes: &'b [u8], path: &Path) -> Result<(&'b [u8], Option<&'b [u8]>)> {
    let word = |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes(b.try_into().expect("4 bytes")) as usize);
    let short = || DataError::input(path, format!("the file ends early: only {} bytes are there; copy it again", bytes.len()));
    let (version, total) = word(4).zip(word(8)).ok_or_else(short)?;
    if version != 2 {
        return Err(DataError::input(path, format!("glTF version {version}, of which only 2 is read; export it as glTF 2.0")));
    }
    if bytes.len() < total {
        let have = bytes.len();
        return Err(DataError::input(path, format!("the file ends early: {have} of {total} bytes are there; copy it again")));
    }
    let (mut json, mut binary, mut at) = (None, None, 12);
    while at + 8 <= total {
        let (length, kind) = word(at).zip(bytes.get(at + 4..at + 8)).ok_or_else(short)?;
        let data = bytes.get(at + 8..at + 8 + length).ok_or_else(short)?;
        if kind == JSON && json.is_none() {
            json = Some(data);
        } else if kind == BIN && binary.is_none() {
            binary = Some(data);
        }
        at += 8 + length;
    }
    json.map(|json| (json, binary)).ok_or_else(|| DataError::input(path, "the file has no JSON; export it again as .glb"))
}
