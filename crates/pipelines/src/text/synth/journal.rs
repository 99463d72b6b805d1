//! Journal of a data set: the samples that are done, one per line.

use super::super::fnv;
use crate::error::Result;
use diorama_data::text_set::SetImage;
use diorama_data::{DataError, atomic, error};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

/// File of a data set's folder.
pub const JOURNAL: &str = "journal.jsonl";
const LIMIT: u64 = 1 << 34;

/// A sample that is done.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Done {
    pub sample: usize,
    /// Cluster of the text pose that it was drawn for.
    pub cluster: usize,
    /// Hash of the image's file.
    pub hash: String,
    /// Labels of new words that were compared with their glyphs, those that are more than 2 pixels off, and the largest distance between both.
    pub compared: usize,
    pub misfits: usize,
    pub misfit_px: f64,
    pub record: SetImage,
}

/// Hash of a file's bytes.
pub(super) fn hash(bytes: &[u8]) -> String {
    format!("{:016x}", fnv::hash(bytes.iter().copied()))
}

/// Lines of a folder's journal; the last may have been cut, and is then left out.
///
/// # Errors
/// When it cannot be read.
pub fn lines(folder: &Path) -> Result<Vec<Done>> {
    let path = folder.join(JOURNAL);
    if !path.exists() {
        return Ok(Vec::new());
    }
    let bytes = error::read(&path, LIMIT)?;
    Ok(bytes.split(|b| *b == b'\n').filter_map(|line| serde_json::from_slice(line).ok()).collect())
}

/// Samples of a folder's journal whose images are as they were written; others are to be drawn anew.
///
/// # Errors
/// When the journal or an image cannot be read.
pub fn read(folder: &Path) -> Result<BTreeMap<usize, Done>> {
    let mut out = BTreeMap::new();
    for done in lines(folder)? {
        let image = folder.join(&done.record.image);
        if image.exists() && hash(&error::read(&image, LIMIT)?) == done.hash {
            out.insert(done.sample, done);
        }
    }
    Ok(out)
}

/// Place of the glyphs of an image.
pub fn glyphs(image: &str) -> String {
    image.replacen("images/", "glyphs/", 1)
}

/// Samples that are done, one per line.
pub struct Journal {
    file: std::fs::File,
    path: std::path::PathBuf,
}

impl Journal {
    /// The journal of a folder, with what is known to be done.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn open(folder: &Path, done: &BTreeMap<usize, Done>) -> Result<Journal> {
        let path = folder.join(JOURNAL);
        let lines: String = done.values().map(line).collect();
        atomic::write(&path, lines.as_bytes())?;
        let file = std::fs::OpenOptions::new().append(true).open(&path).map_err(DataError::io(&path, "write"))?;
        Ok(Journal { file, path })
    }

    /// Adds a sample.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn add(&mut self, done: &Done) -> Result<()> {
        Ok(self.file.write_all(line(done).as_bytes()).map_err(DataError::io(&self.path, "write"))?)
    }
}

fn line(done: &Done) -> String {
    serde_json::to_string(done).expect("plain values") + "\n"
}
