//! Atomic file writes: temporary file, fsync, rename, fsync of the folder. A file appears complete or not at all.

use crate::error::{DataError, Result};
use std::fs::File;
use std::io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

const SUFFIX: &str = ".partial";

/// Writes `path` through `fill`. On any error the old file stays and the temporary file is removed.
pub fn write_with(path: &Path, fill: impl FnOnce(&mut BufWriter<File>) -> std::io::Result<()>) -> Result<()> {
    let temporary = temporary_name(path);
    let attempt = || -> std::io::Result<()> {
        let mut w = BufWriter::with_capacity(1 << 20, File::create(&temporary)?);
        fill(&mut w)?;
        let file = w.into_inner().map_err(|e| e.into_error())?;
        file.sync_all()?;
        std::fs::rename(&temporary, path)?;
        sync_folder(path)
    };
    attempt().map_err(|e| {
        let _ = std::fs::remove_file(&temporary);
        DataError::io(path, "write")(e)
    })
}

/// [`write_with`] for bytes that are already in memory; where the system has no room for them, the error says how many they are.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    write_with(path, |w| w.write_all(bytes)).map_err(|e| with_size(e, bytes.len()))
}

/// An error of too little room with the bytes that were to be written.
fn with_size(e: DataError, bytes: usize) -> DataError {
    match e {
        DataError::Io { path, doing, source } if matches!(source.kind(), StorageFull | QuotaExceeded | FileTooLarge) => {
            let source = std::io::Error::new(source.kind(), format!("{source}; {bytes} bytes were to be written"));
            DataError::Io { path, doing, source }
        }
        other => other,
    }
}

/// Removes temporary files that interrupted writes left in a folder.
pub fn sweep(folder: &Path) -> Result<()> {
    let entries = std::fs::read_dir(folder).map_err(DataError::io(folder, "read"))?;
    for entry in entries.flatten() {
        if entry.file_name().to_string_lossy().ends_with(SUFFIX) {
            let path = entry.path();
            std::fs::remove_file(&path).map_err(DataError::io(&path, "remove"))?;
        }
    }
    Ok(())
}

fn temporary_name(path: &Path) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(SUFFIX);
    path.with_file_name(name)
}

fn sync_folder(path: &Path) -> std::io::Result<()> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // Some systems cannot open folders; only the rename must not fail.
    match File::open(folder) {
        Ok(f) => f.sync_all().or(Ok(())),
        Err(_) => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_keeps_the_old_file_and_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a");
        write(&path, b"old").unwrap();
        let failed = write_with(&path, |w| {
            w.write_all(b"half of the new")?;
            Err(std::io::Error::other("disk full"))
        });
        assert!(failed.unwrap_err().to_string().contains("disk full"));
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_is_told_with_the_bytes_that_have_no_room() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a");
        write(&path, b"old").unwrap();
        // Each write to this device finds no space.
        std::os::unix::fs::symlink("/dev/full", temporary_name(&path)).unwrap();
        let e = write(&path, &[7; 5000]).unwrap_err().to_string();
        assert!(e.contains("cannot write: No space left") && e.contains("5000 bytes were to be written"), "{e}");
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn sweeping_removes_leftovers_only() {
        let dir = tempfile::tempdir().unwrap();
        write(&dir.path().join("kept"), b"x").unwrap();
        std::fs::write(dir.path().join("lost.partial"), b"x").unwrap();
        sweep(dir.path()).unwrap();
        assert!(dir.path().join("kept").exists() && !dir.path().join("lost.partial").exists());
    }
}
