//! Captures in zip files: unpacked once, beside the archive.

use crate::atomic;
use crate::error::{DataError, Result};
use std::collections::HashSet;
use std::fs::File;
use std::io::{BufReader, Read, Write};
use std::path::{Path, PathBuf};

/// Limits on the content of an archive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ArchiveLimits {
    pub entries: usize,
    /// Total size of all entries, unpacked.
    pub bytes: u64,
    /// Largest ratio of unpacked to packed size, for entries larger than a mebibyte.
    pub ratio: u64,
}

impl Default for ArchiveLimits {
    fn default() -> Self {
        ArchiveLimits { entries: 200_000, bytes: 256 << 30, ratio: 200 }
    }
}

/// Name of the file that marks a folder as the unpacked content of an archive.
const MARK: &str = ".unpacked";

/// Unpacks `archive` and returns the folder with its content: `capture.zip` becomes `capture/` beside it, unless it was unpacked before.
/// If the archive contains a single folder, that folder is returned.
///
/// # Errors
/// If the archive is malformed, exceeds its limits, contains links or names that lead out of the folder, or if a folder of that name
/// already exists and was not made from this archive.
pub fn unpacked(archive: &Path, limits: &ArchiveLimits) -> Result<PathBuf> {
    let folder = archive.with_extension("");
    let meta = std::fs::metadata(archive).map_err(DataError::io(archive, "read"))?;
    let changed = meta.modified().ok().and_then(|t| t.duration_since(std::time::UNIX_EPOCH).ok()).map_or(0, |d| d.as_nanos());
    let mark = format!("{} bytes, changed {changed}\n", meta.len());
    if folder.exists() {
        let known = std::fs::read_to_string(folder.join(MARK)).unwrap_or_default();
        return if known == mark {
            Ok(root_of(&folder))
        } else {
            Err(DataError::input(
                &folder,
                format!(
                    "already exists and was not unpacked from {}; move it away, or give the folder instead of the archive",
                    archive.display()
                ),
            ))
        };
    }
    let partial = archive.with_extension("partial");
    let _ = std::fs::remove_dir_all(&partial);
    let done = unpack(archive, &partial, limits).and_then(|()| {
        atomic::write(&partial.join(MARK), mark.as_bytes())?;
        std::fs::rename(&partial, &folder).map_err(DataError::io(&folder, "write"))
    });
    if done.is_err() {
        let _ = std::fs::remove_dir_all(&partial);
    }
    done.map(|()| root_of(&folder))
}

/// The only entry of a folder, if that entry is a folder.
fn root_of(folder: &Path) -> PathBuf {
    let inside: Vec<PathBuf> = folder
        .read_dir()
        .into_iter()
        .flatten()
        .flatten()
        .map(|e| e.path())
        .filter(|p| !p.file_name().is_some_and(|n| n == MARK || n == "__MACOSX"))
        .collect();
    match &inside[..] {
        [one] if one.is_dir() => one.clone(),
        _ => folder.to_path_buf(),
    }
}

fn unpack(archive: &Path, folder: &Path, limits: &ArchiveLimits) -> Result<()> {
    let bad = |what: String| DataError::input(archive, what);
    let file = File::open(archive).map_err(DataError::io(archive, "read"))?;
    let mut zip =
        zip::ZipArchive::new(BufReader::new(file)).map_err(|e| bad(format!("is not a readable zip file ({e}); copy it again")))?;
    if zip.len() > limits.entries {
        return Err(bad(format!("holds {} entries, more than the limit of {}", zip.len(), limits.entries)));
    }
    std::fs::create_dir_all(folder).map_err(DataError::io(folder, "create"))?;
    let (mut total, mut names) = (0u64, HashSet::new());
    for i in 0..zip.len() {
        let mut entry = zip.by_index(i).map_err(|e| bad(format!("entry {i} cannot be read ({e})")))?;
        let name = entry.name().map_err(|e| bad(format!("the name of entry {i} cannot be read ({e})")))?.into_owned();
        let Some(inside) = entry.enclosed_name().filter(|_| !name.starts_with('/') && !name.contains(['\\', ':'])) else {
            return Err(bad(format!("entry {name:?} leads out of the folder; such an archive is not unpacked")));
        };
        if entry.is_symlink() {
            return Err(bad(format!("entry {name:?} is a link; such an archive is not unpacked")));
        }
        let target = folder.join(&inside);
        if entry.is_dir() {
            std::fs::create_dir_all(&target).map_err(DataError::io(&target, "create"))?;
            continue;
        }
        if !names.insert(inside) {
            return Err(bad(format!("entry {name:?} appears twice; such an archive is not unpacked")));
        }
        if let Some(parent) = target.parent() {
            std::fs::create_dir_all(parent).map_err(DataError::io(parent, "create"))?;
        }
        // The size in the header may be false, so the bytes are counted.
        let packed = entry.compressed_size().max(1);
        let mut out = File::create_new(&target).map_err(DataError::io(&target, "create"))?;
        let (mut part, mut size) = (vec![0; 1 << 16], 0u64);
        loop {
            let n = entry.read(&mut part).map_err(|e| bad(format!("entry {name:?} cannot be unpacked ({e})")))?;
            if n == 0 {
                break;
            }
            (size, total) = (size + n as u64, total + n as u64);
            if total > limits.bytes {
                return Err(bad(format!("unpacks to more than the limit of {} MiB", limits.bytes >> 20)));
            }
            if size > 1 << 20 && size / packed > limits.ratio {
                return Err(bad(format!("entry {name:?} unpacks to more than {} times its size: a bomb", limits.ratio)));
            }
            out.write_all(&part[..n]).map_err(DataError::io(&target, "write"))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use zip::write::SimpleFileOptions;

    fn archive(dir: &Path, fill: impl FnOnce(&mut zip::ZipWriter<File>)) -> PathBuf {
        let path = dir.join("capture.zip");
        let mut w = zip::ZipWriter::new(File::create(&path).unwrap());
        fill(&mut w);
        w.finish().unwrap();
        path
    }

    fn put(w: &mut zip::ZipWriter<File>, name: &str, data: &[u8]) {
        w.start_file(name, SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated)).unwrap();
        w.write_all(data).unwrap();
    }

    #[test]
    fn a_good_archive_is_unpacked_once() {
        let dir = tempfile::tempdir().unwrap();
        let path = archive(dir.path(), |w| put(w, "chair/images/ä b.txt", b"hello"));
        let root = unpacked(&path, &ArchiveLimits::default()).unwrap();
        assert_eq!(std::fs::read(root.join("images/ä b.txt")).unwrap(), b"hello");
        assert_eq!(unpacked(&path, &ArchiveLimits::default()).unwrap(), root);
        std::fs::write(&path, b"another").unwrap();
        assert!(unpacked(&path, &ArchiveLimits::default()).unwrap_err().to_string().contains("move it away"));
    }

    #[test]
    fn slips_links_bombs_and_crowds_leave_nothing() {
        let refused = |expected: &str, limits: ArchiveLimits, fill: &dyn Fn(&mut zip::ZipWriter<File>)| {
            let dir = tempfile::tempdir().unwrap();
            let path = archive(dir.path(), fill);
            let e = unpacked(&path, &limits).unwrap_err();
            assert!(e.is_input() && e.to_string().contains(expected), "{e}");
            assert_eq!(dir.path().read_dir().unwrap().count(), 1, "something was left behind");
        };
        let usual = ArchiveLimits::default();
        for name in ["../x", "a/../../x", "/etc/x", "C:\\x", "..\\x"] {
            refused("leads out", usual, &|w| put(w, name, b"x"));
        }
        refused("is a link", usual, &|w| w.add_symlink("l", "/etc/passwd", SimpleFileOptions::default()).unwrap());
        refused("a bomb", usual, &|w| put(w, "b", &vec![0; 8 << 20]));
        refused("more than the limit of 1 MiB", ArchiveLimits { bytes: 1 << 20, ratio: 1 << 40, ..usual }, &|w| {
            put(w, "b", &vec![0; 2 << 20])
        });
        refused("more than the limit of 2", ArchiveLimits { entries: 2, ..usual }, &|w| (0..3).for_each(|i| put(w, &format!("{i}"), b"")));
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("c.zip");
        std::fs::write(&path, b"PK\x03\x04 cut").unwrap();
        assert!(unpacked(&path, &usual).unwrap_err().is_input());
    }
}
