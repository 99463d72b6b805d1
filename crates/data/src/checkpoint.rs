//! Checkpoints: safetensors files with version, method, progress and a hash of the content in their metadata. They are written atomically,
//! and the previous one is kept as `previous.safetensors`.

use crate::atomic;
use crate::error::{self, DataError, Result};
use diorama_geom::NamedArray;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use std::collections::HashMap;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Version of the file layout.
pub const VERSION: &str = "1";

const LATEST: &str = "latest.safetensors";
const PREVIOUS: &str = "previous.safetensors";
const LIMIT: u64 = 64 << 30;

/// Content of a checkpoint: named f32 tensors, and text metadata.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Checkpoint {
    pub tensors: Vec<(String, Vec<usize>, Vec<f32>)>,
    pub metadata: HashMap<String, String>,
}

/// FNV-1a over eight bytes at a time. Detects truncation and flipped bits, not tampering.
fn hash<'a>(tensors: impl Iterator<Item = (&'a str, &'a [u8])>) -> String {
    let mut h = 0xcbf2_9ce4_8422_2325u64;
    let mut mix = |bytes: &[u8]| {
        let mut chunks = bytes.chunks_exact(8);
        for c in &mut chunks {
            h = (h ^ u64::from_le_bytes(c.try_into().expect("eight bytes"))).wrapping_mul(0x0000_0100_0000_01b3).rotate_left(23);
        }
        for b in chunks.remainder() {
            h = (h ^ *b as u64).wrapping_mul(0x0000_0100_0000_01b3);
        }
    };
    for (name, data) in tensors {
        mix(name.as_bytes());
        mix(data);
    }
    format!("{h:016x}")
}

fn bytes_of(values: &[f32]) -> &[u8] {
    // SAFETY: any f32 is four initialized bytes; the length is in bytes.
    unsafe { std::slice::from_raw_parts(values.as_ptr().cast(), std::mem::size_of_val(values)) }
}

/// A tensor to save, borrowed.
pub struct Entry<'a> {
    pub name: String,
    pub shape: Vec<usize>,
    pub data: &'a [f32],
}

/// Saves into `folder`. The newest file becomes the previous one only after the new file is complete.
pub fn save(folder: &Path, entries: &[Entry], mut metadata: HashMap<String, String>) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(DataError::io(folder, "create"))?;
    let (latest, previous) = (folder.join(LATEST), folder.join(PREVIOUS));
    let mut sorted: Vec<&Entry> = entries.iter().collect();
    sorted.sort_by(|a, b| a.name.cmp(&b.name));
    metadata.insert("version".into(), VERSION.into());
    metadata.insert("hash".into(), hash(sorted.iter().map(|e| (&e.name[..], bytes_of(e.data)))));
    let mut views = Vec::with_capacity(sorted.len());
    for e in &sorted {
        let view = TensorView::new(Dtype::F32, e.shape.clone(), bytes_of(e.data));
        views.push((e.name.clone(), view.map_err(|e| DataError::input(&latest, format!("cannot be serialized: {e}")))?));
    }
    if cfg!(target_endian = "big") {
        return Err(DataError::input(&latest, "checkpoints can only be written on little-endian machines"));
    }
    let bytes =
        safetensors::serialize(views, Some(metadata)).map_err(|e| DataError::input(&latest, format!("cannot be serialized: {e}")))?;
    if latest.exists() {
        // A second name for the old file: it survives the rename that replaces the first.
        let _ = std::fs::remove_file(&previous);
        if std::fs::hard_link(&latest, &previous).is_err() {
            std::fs::copy(&latest, &previous).map_err(DataError::io(&previous, "write"))?;
        }
    }
    atomic::write_with(&latest, |w| w.write_all(&bytes))
}

/// Saves arrays into `folder`, as [`save`] does.
pub fn save_arrays(folder: &Path, arrays: &[NamedArray], metadata: HashMap<String, String>) -> Result<()> {
    let entries: Vec<Entry> = arrays.iter().map(|a| Entry { name: a.name.clone(), shape: a.shape.clone(), data: &a.values }).collect();
    save(folder, &entries, metadata)
}

/// Reads one file and checks its hash.
pub fn read(path: &Path) -> Result<Checkpoint> {
    let bytes = error::read(path, LIMIT)?;
    let broken = |e: &dyn std::fmt::Display| DataError::input(path, format!("is not a whole checkpoint: {e}"));
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|e| broken(&e))?;
    let metadata = header.metadata().clone().unwrap_or_default();
    let version = metadata.get("version").map_or("none", |v| v);
    if version != VERSION {
        return Err(DataError::input(
            path,
            format!("checkpoint version {version}; this program reads version {VERSION}: train again or use the program that wrote it"),
        ));
    }
    let tensors = SafeTensors::deserialize(&bytes).map_err(|e| broken(&e))?;
    let mut names: Vec<&str> = tensors.names();
    names.sort_unstable();
    let mut parts = Vec::new();
    for name in names {
        let t = tensors.tensor(name).map_err(|e| broken(&e))?;
        if t.dtype() != Dtype::F32 {
            return Err(broken(&format!("{name} is not f32")));
        }
        parts.push((name.to_string(), t.shape().to_vec(), t.data()));
    }
    let found = hash(parts.iter().map(|(n, _, d)| (&n[..], *d)));
    if metadata.get("hash") != Some(&found) {
        return Err(broken(&"its content does not match its checksum"));
    }
    let floats = |d: &[u8]| d.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().expect("four bytes"))).collect();
    let tensors = parts.into_iter().map(|(n, s, d)| (n, s, floats(d))).collect();
    Ok(Checkpoint { tensors, metadata })
}

/// Reads the newest complete checkpoint in `folder`, with a note if that is not the newest file.
pub fn load(folder: &Path) -> Result<(Checkpoint, Option<String>)> {
    let (latest, previous) = (folder.join(LATEST), folder.join(PREVIOUS));
    match read(&latest) {
        Ok(c) => Ok((c, None)),
        Err(e) if previous.exists() => match read(&previous) {
            Ok(c) => Ok((c, Some(format!("{e}; continuing from the previous checkpoint")))),
            Err(_) => Err(e),
        },
        Err(e) => Err(e),
    }
}

/// Whether `folder` holds any checkpoint.
pub fn exists(folder: &Path) -> bool {
    folder.join(LATEST).exists() || folder.join(PREVIOUS).exists()
}

/// Path of the newest checkpoint.
pub fn latest(folder: &Path) -> PathBuf {
    folder.join(LATEST)
}

impl Checkpoint {
    /// All tensors, sorted by name.
    pub fn into_arrays(self) -> Vec<NamedArray> {
        self.tensors.into_iter().map(|(name, shape, values)| NamedArray { name, shape, values }).collect()
    }

    /// Removes a tensor and returns its values.
    pub fn take(&mut self, name: &str) -> Option<Vec<f32>> {
        let i = self.tensors.iter().position(|t| t.0 == name)?;
        Some(self.tensors.swap_remove(i).2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn save_values(folder: &Path, v: &[f32]) {
        let entries =
            [Entry { name: "a.b".into(), shape: vec![v.len()], data: v }, Entry { name: "empty".into(), shape: vec![0], data: &[] }];
        save(folder, &entries, HashMap::from([("step".into(), v.len().to_string())])).unwrap();
    }

    #[test]
    fn round_trip_and_the_previous_one_is_kept() {
        let dir = tempfile::tempdir().unwrap();
        save_values(dir.path(), &[1.0, f32::MIN_POSITIVE, -0.0]);
        save_values(dir.path(), &[4.0]);
        let (mut c, note) = load(dir.path()).unwrap();
        assert_eq!((c.take("a.b"), note), (Some(vec![4.0]), None));
        assert_eq!(read(&dir.path().join(PREVIOUS)).unwrap().take("a.b").unwrap().len(), 3);
    }

    #[test]
    fn flipped_bits_truncation_and_other_versions_are_found() {
        let dir = tempfile::tempdir().unwrap();
        save_values(dir.path(), &[1.0; 100]);
        save_values(dir.path(), &[2.0; 100]);
        let path = latest(dir.path());
        let good = std::fs::read(&path).unwrap();
        let mut bad = good.clone();
        let n = bad.len();
        bad[n - 7] ^= 1;
        for (bytes, what) in [(&bad[..], "checksum"), (&good[..n - 9], "whole"), (&good[..5], "whole")] {
            std::fs::write(&path, bytes).unwrap();
            let (mut c, note) = load(dir.path()).unwrap();
            assert_eq!(c.take("a.b").unwrap()[0], 1.0, "the previous checkpoint serves");
            assert!(note.unwrap().contains(what));
        }
        let text = String::from_utf8_lossy(&good).replace("\"version\":\"1\"", "\"version\":\"9\"");
        assert_ne!(text.as_bytes(), &good[..]);
        let at = good.windows(13).position(|w| w == b"\"version\":\"1\"").unwrap();
        let mut other = good.clone();
        other[at + 11] = b'9';
        std::fs::write(&path, other).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("version 9"));
    }
}
